"""Footage that hardly is any: one frame, two pixels, darkness, nobody, lenses that nobody has."""

import json
import math

import numpy as np
import pycolmap
import pytest

from pipeline.clip.frames import read_frame, read_mask
from pipeline.clip.keypoints import read_keypoints
from pipeline.clip.records import read_cameras, read_split
from pipeline.errors import UserError
from stages.ingest.cameras.distortion import distortion_pixels, undistort_frames, undistort_points
from stages.ingest.mask_smoothing import smooth_masks
from stages.ingest.masks import fill_holes, follow_edges, fuse, main_component, overlap, selfie_share
from stages.ingest.run import run
from tests.made.videos import body_points, ingest_context, walking_blob, write_images


def material(folder, frames, masks, points=None):
    """A folder of pictures, with masks and keypoints beside it, which lie on the person."""
    write_images(folder / "clip", frames)
    write_images(folder / "masks", masks)
    (folder / "keypoints").mkdir()
    for number in range(len(frames)):
        value = points(number) if points else body_points(*middle_of(masks[number]))
        (folder / "keypoints" / f"{number}.json").write_text(json.dumps(value))
    return folder


def middle_of(mask):
    """The middle of a mask, or of its picture where it is empty, less half of what the points extend."""
    rows, columns = np.nonzero(mask if mask.any() else mask == 0)
    return columns.mean() - 3, rows.mean() - 2


def ingest(folder, **settings):
    given = {"keypoints": str(folder / "keypoints"), "masks": str(folder / "masks"), **settings}
    context = ingest_context(folder / "run", folder / "clip", **given)
    run(context)
    return context.output


def blob(count, height=48, width=64):
    return walking_blob(count, height, width)


def test_a_clip_of_one_frame_is_refused(tmp_path):
    with pytest.raises(UserError, match=r"gave 1 frame: an avatar needs a clip of at least 2"):
        ingest(material(tmp_path / "one", *blob(1)))


def test_two_frames_are_one_to_learn_from_and_one_held_out(tmp_path):
    split = read_split(ingest(material(tmp_path / "two", *blob(2))) / "split.json")
    assert (split.train, split.test) == ((0,), (1,))


def test_a_split_that_leaves_nothing_names_both_settings(tmp_path):
    with pytest.raises(UserError, match=r"lower ingest\.test_frames or ingest\.test_fraction"):
        ingest(material(tmp_path / "all", *blob(2)), test_fraction=0.9)


@pytest.mark.parametrize("size", [(2, 2), (1, 1), (1, 400), (3, 2)])
def test_pictures_of_a_few_pixels_are_ingested_or_refused(tmp_path, size):
    frames, masks = [np.full((*size, 3), 90, np.uint8)] * 4, [np.full(size, 255, np.uint8)] * 4
    folder = material(tmp_path / "tiny", frames, masks, lambda number: body_points(0.5, 0.5))
    try:
        output = ingest(folder)
    except UserError as error:
        assert "pixels" in str(error)
        return
    cameras = read_cameras(output / "cameras.parquet")
    assert all(camera.intrinsics.isfinite().all() for camera in cameras.values())
    assert read_frame(output / "frames", 0).shape == (*size, 3)


@pytest.mark.parametrize("value", [0, 255], ids=["black", "white"])
def test_flat_frames_have_a_static_camera(tmp_path, value):
    """No corner to follow: nothing is known of the camera's motion."""
    frames, masks = [np.full((48, 64, 3), value, np.uint8)] * 6, blob(6)[1]
    output = ingest(material(tmp_path / "flat", frames, masks))
    cameras = list(read_cameras(output / "cameras.parquet").values())
    assert all(np.array_equal(camera.rotation, cameras[0].rotation) for camera in cameras)
    assert all(camera.intrinsics.isfinite().all() for camera in cameras)


def test_masks_empty_everywhere_are_refused_with_the_count(tmp_path):
    folder = material(tmp_path / "masks", blob(4)[0], [np.zeros((48, 64), np.uint8)] * 4)
    with pytest.raises(UserError, match=r"no person in any of 4 frames \(mask too small: 4\): give a clip"):
        ingest(folder)


def test_an_empty_mask_among_good_ones_drops_its_frame(tmp_path):
    frames, masks = blob(5)
    masks[2] = np.zeros_like(masks[2])
    output = ingest(material(tmp_path / "masks", frames, masks))
    assert read_keypoints(output / "keypoints.parquet").frames.tolist() == [0, 1, 3, 4]


def test_masks_full_everywhere_are_published_as_they_are(tmp_path):
    output = ingest(material(tmp_path / "masks", blob(4)[0], [np.full((48, 64), 255, np.uint8)] * 4))
    assert (read_mask(output / "masks", 2) == 255).all()


def test_a_clip_in_which_nobody_is_scored_is_refused(tmp_path):
    folder = material(tmp_path / "nobody", *blob(4), lambda number: body_points(30.0, 20.0, 0.0))
    with pytest.raises(UserError, match="person"):
        ingest(folder)


@pytest.mark.parametrize("value", ["NaN", "Infinity", "1e40", "null"])
def test_keypoints_that_are_not_finite_are_refused_by_file(tmp_path, value):
    folder = material(tmp_path / "points", *blob(4))
    path = folder / "keypoints" / "2.json"
    path.write_text(path.read_text().replace("0.9", value, 1))
    with pytest.raises(UserError, match=r"2\.json"):
        ingest(folder)


def test_keypoints_far_outside_the_picture_are_kept_finite(tmp_path):
    folder = material(tmp_path / "far", *blob(4), lambda number: body_points(-9e3, 9e3))
    try:
        points = read_keypoints(ingest(folder) / "keypoints.parquet")
    except UserError:
        return
    assert np.isfinite(points.whole_body).all()


# Lenses

LENSES = {
    "barrel": ("OPENCV", [60, 60, 32, 24, -5.0, 30.0, 0, 0]),
    "pincushion": ("OPENCV", [60, 60, 32, 24, 50.0, 500.0, 0, 0]),
    "tangential": ("OPENCV", [60, 60, 32, 24, 0, 0, 3.0, -3.0]),
    "absurd": ("OPENCV", [60, 60, 32, 24, 1e8, -1e12, 1e5, 1e5]),
    "fisheye": ("OPENCV_FISHEYE", [20, 20, 32, 24, 2.0, -3.0, 4.0, 5.0]),
    "folding": ("SIMPLE_RADIAL", [60, 32, 24, -3.0]),
    "needle focus": ("OPENCV", [1e-3, 1e-3, 32, 24, 0.1, 0, 0, 0]),
    "telescope": ("OPENCV", [1e7, 1e7, 32, 24, 0.1, 0, 0, 0]),
}


def lens_of(case):
    model, params = LENSES[case]
    return pycolmap.Camera(model=model, width=64, height=48, params=[float(value) for value in params])


@pytest.mark.parametrize("case", LENSES)
def test_any_lens_has_a_measure_and_leaves_pictures_and_points_finite(tmp_path, case):
    lens = lens_of(case)
    assert distortion_pixels(lens) >= 0 and not math.isnan(distortion_pixels(lens))
    folder = material(tmp_path / "lens", *blob(2))
    output = ingest(folder, test_fraction=0.5)
    points = read_keypoints(output / "keypoints.parquet")
    moved = undistort_frames(output, {0: lens, 1: lens}, points)
    for name in ("whole_body", "pose_image", "face_mesh", "hands"):
        assert np.isfinite(getattr(moved, name)).all(), name
    lost = moved.whole_body[..., 2] == 0
    assert not moved.whole_body[lost].any()
    assert read_frame(output / "frames", 0).shape == (48, 64, 3)
    assert read_mask(output / "masks", 0).shape == (48, 64)


def test_a_point_that_no_ray_reaches_is_not_a_number_and_never_published():
    found = undistort_points(lens_of("folding"), np.array([[0.0, 0.0], [32.0, 24.0], [1e6, 1e6]]))
    assert np.isfinite(found[1]).all()


# Masks


FLAT = {value: np.full((24, 20), value, np.float32) for value in (0.0, 0.5, 1.0)}


@pytest.mark.parametrize("value", FLAT)
def test_masks_without_an_edge_stay_shares(value):
    alpha, image = FLAT[value], np.zeros((24, 20, 3), np.uint8)
    none = np.zeros((0, 2))
    for mask in (
        fuse(alpha, alpha, 0.5),
        main_component(alpha, none),
        fill_holes(alpha),
        follow_edges(alpha, image, 1.0),
    ):
        assert np.isfinite(mask).all() and mask.min() >= 0 and mask.max() <= 1 + 1e-6
    steadied = list(smooth_masks([(image, alpha)] * 3, 2))
    assert len(steadied) == 3 and all(np.isfinite(mask).all() for mask in steadied)


def test_two_empty_segmentations_overlap_by_nothing_and_are_not_divided():
    assert overlap(FLAT[0.0], FLAT[0.0]) == 0
    assert 0 <= selfie_share([0.0]) <= 1 and 0 <= selfie_share([1.0, 1.0]) <= 1


def test_one_flickering_pixel_and_salt_and_pepper_stay_shares():
    noise = np.random.default_rng(0).integers(0, 2, (24, 20)).astype(np.float32)
    image = np.random.default_rng(1).integers(0, 256, (24, 20, 3)).astype(np.uint8)
    pixel = np.zeros((24, 20), np.float32)
    pixel[3, 4] = 1
    for alpha in (noise, pixel):
        for mask in (
            main_component(alpha, np.array([[4.0, 3.0]])),
            fill_holes(alpha),
            follow_edges(0.5 * alpha, image, 1.0),
        ):
            assert np.isfinite(mask).all() and -1e-6 <= mask.min() and mask.max() <= 1 + 1e-6
