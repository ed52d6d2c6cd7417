"""Cameras from files, from the background's motion, and for a clip whose camera stands still."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
import torch
from scipy.spatial.transform import Rotation

from pipeline.clip.camera import Camera, facing_camera, project
from pipeline.clip.frames import read_frame, write_frame, write_mask
from pipeline.clip.keypoints import empty_keypoints, read_keypoints
from pipeline.clip.records import read_cameras, read_footage, write_cameras
from pipeline.errors import UserError
from stages.ingest.cameras.background_motion import MOVING
from stages.ingest.cameras.calibration import CalibratedCamera, Calibration, frames_of_views, pinhole_lens
from stages.ingest.cameras.calibration_files import open_calibration
from stages.ingest.cameras.distortion import (
    distortion_pixels,
    for_stored_frames,
    undistort_frames,
    undistort_points,
    without_distortion,
)
from stages.ingest.cameras.extrinsics import FACING, interpolate_gaps, to_upright_world
from stages.ingest.display_matrix import Orientation
from stages.ingest.run import run
from stages.ingest.video import Clip
from tests.made.room import (
    centres_in_first,
    rotation_error,
)
from tests.made.videos import ingest_context, walking_blob, write_clip, write_images, write_points

COUNT = 8
SIZE = (128, 96)


@pytest.fixture
def material(tmp_path: Path) -> Path:
    """A folder with clip.mp4, keypoints/ and masks/: eight frames of 128 x 96."""
    frames, masks = walking_blob(COUNT)
    write_clip(tmp_path / "clip.mp4", frames)
    write_images(tmp_path / "masks", masks)
    write_points(tmp_path / "keypoints", range(COUNT))
    return tmp_path


def ingest(material: Path, name: str = "run", **settings: object) -> Path:
    given = {"keypoints": str(material / "keypoints"), "masks": str(material / "masks"), **settings}
    context = ingest_context(material / name, material / "clip.mp4", **given)
    run(context)
    return context.output


def clip_of(path: Path = Path("clip.mp4"), size: tuple[int, int] = SIZE, **fields: object) -> Clip:
    return Clip(path, *size, 25.0, COUNT, **fields)  # type: ignore[arg-type]


def poses(count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """A camera that goes sideways and turns, world-to-camera."""
    turns = Rotation.from_euler("yx", [[4 * k, 2 * k] for k in range(count)], degrees=True).as_matrix()
    return [(turns[k], np.array([0.1 * k, 0.02 * k, 1.0])) for k in range(count)]


def write_json_cameras(folder: Path, names: list[str], focal: float = 150.0) -> Path:
    folder.mkdir(exist_ok=True)
    for name, (rotation, translation) in zip(names, poses(len(names)), strict=True):
        value = {
            "R": rotation.tolist(),
            "t": translation.tolist(),
            "focal": [focal, focal],
            "princpt": [64, 48],
        }
        (folder / f"{name}.json").write_text(json.dumps(value))
    return folder


def write_colmap(folder: Path, names: list[str], binary: bool = False, model: str = "PINHOLE") -> Path:
    """A model of pictures of 256 x 192, twice the clip's size."""
    folder.mkdir(parents=True, exist_ok=True)
    extra = "" if model == "PINHOLE" else " 0.5 0 0 0"
    (folder / "cameras.txt").write_text(f"1 {model} 256 192 300 300 130 100{extra}\n")
    lines = []
    for number, (name, (rotation, translation)) in enumerate(zip(names, poses(len(names)), strict=True), 1):
        x, y, z, w = Rotation.from_matrix(rotation).as_quat()
        numbers = " ".join(repr(float(v)) for v in (w, x, y, z, *translation))
        lines.append(f"{number} {numbers} 1 {name}\n\n")
    (folder / "images.txt").write_text("".join(lines))
    (folder / "points3D.txt").write_text("")
    if binary:
        model_read = pycolmap.Reconstruction(str(folder))
        for file in folder.iterdir():
            file.unlink()
        model_read.write_binary(str(folder))
    return folder


# The default


def test_a_camera_that_stands_still_is_what_it_always_was(material: Path) -> None:
    output = ingest(material)
    camera = facing_camera(*SIZE, 1.2 * 128)
    write_cameras(material / "expected.parquet", dict.fromkeys(range(COUNT), camera))
    assert (output / "cameras.parquet").read_bytes() == (material / "expected.parquet").read_bytes()
    record = read_footage(output / "footage.json").camera
    assert record["source"] == "pinhole" and 0 <= record["displacement"] < MOVING


def test_pinhole_is_not_measured(material: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record = read_footage(ingest(material, cameras="pinhole") / "footage.json").camera
    assert record == {"source": "pinhole", "displacement": None, "metres_per_unit": None}
    assert "background" not in capsys.readouterr().out


# Files


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("place", ["", "sparse", "sparse/0"])
def test_a_colmap_model_is_read_scaled_and_set_upright(material: Path, binary: bool, place: str) -> None:
    write_colmap(material / "model" / place, [f"image{k}.jpg" for k in range(COUNT)], binary)
    output = ingest(material, cameras=str(material / "model"), camera_scale=2.0)
    cameras = read_cameras(output / "cameras.parquet", torch.float64)
    assert (cameras[0].width, cameras[0].height) == SIZE
    np.testing.assert_allclose(cameras[3].intrinsics, [[150, 0, 65], [0, 150, 50], [0, 0, 1]], atol=1e-9)
    truth = poses(COUNT)
    found = np.stack([cameras[k].rotation.numpy() for k in range(COUNT)])
    places = np.stack([cameras[k].translation.numpy() for k in range(COUNT)])
    assert rotation_error(found, np.stack([r for r, _ in truth])).max() < 1e-4
    expected = 2 * centres_in_first(np.stack([r for r, _ in truth]), np.stack([t for _, t in truth]))
    np.testing.assert_allclose(centres_in_first(found, places), expected, atol=1e-6)
    np.testing.assert_allclose(cameras[0].centre, 0, atol=1e-9)
    up = np.mean([-rotation[1] for rotation in found], axis=0)
    np.testing.assert_allclose(up / np.linalg.norm(up), [0, 1, 0], atol=1e-6)
    assert read_footage(output / "footage.json").camera["metres_per_unit"] == 2.0


def test_pictures_that_count_from_one(material: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_colmap(material / "model", [f"frames/{k:05d}.png" for k in range(1, COUNT + 1)])
    output = ingest(material, cameras=str(material / "model"), camera_scale=1.0)
    cameras = read_cameras(output / "cameras.parquet", torch.float64)
    np.testing.assert_allclose(cameras[0].centre, 0, atol=1e-9)  # the first picture is frame 0
    assert "counted from 1" in capsys.readouterr().out


def test_pictures_of_another_clip_are_refused(material: Path) -> None:
    write_colmap(material / "model", [f"{k}.png" for k in range(3, COUNT + 3)])
    with pytest.raises(UserError, match="is of no frame of clip.mp4"):
        ingest(material, cameras=str(material / "model"), camera_scale=1.0)


def test_frames_without_a_camera_are_dropped_and_counted(material: Path) -> None:
    names = [str(k) for k in range(COUNT) if k not in (2, 5)]
    output = ingest(material, cameras=str(write_json_cameras(material / "cam_params", names)))
    assert read_footage(output / "footage.json").dropped == {"no camera": 2}
    kept = [0, 1, 3, 4, 6, 7]
    np.testing.assert_array_equal(read_keypoints(output / "keypoints.parquet").frames, kept)
    assert sorted(read_cameras(output / "cameras.parquet")) == kept
    for folder in ("frames", "masks"):
        assert sorted(int(file.stem) for file in (output / folder).iterdir()) == kept
    assert len(read_footage(output / "footage.json").seconds) == len(kept)


def test_peers_virtual_camera_is_a_static_pinhole(material: Path) -> None:
    folder = material / "cam_params"
    folder.mkdir()
    for k in range(COUNT):
        value = {"R": np.eye(3).tolist(), "t": [0, 0, 0], "focal": [200, 200], "princpt": [64, 48]}
        (folder / f"{k}.json").write_text(json.dumps(value))
    cameras = read_cameras(ingest(material, cameras=str(folder)) / "cameras.parquet")
    expected = facing_camera(*SIZE, 200.0)
    for camera in cameras.values():
        torch.testing.assert_close(camera.rotation, expected.rotation)
        torch.testing.assert_close(camera.translation, expected.translation)
        torch.testing.assert_close(camera.intrinsics, expected.intrinsics)


def test_our_own_cameras_come_back_as_they_are(material: Path) -> None:
    first = ingest(material, "first", cameras=str(write_json_cameras(material / "c", list("01234567"))))
    again = ingest(material, "again", cameras=str(first / "cameras.parquet"))
    before, after = (read_cameras(folder / "cameras.parquet", torch.float64) for folder in (first, again))
    for frame in before:
        torch.testing.assert_close(after[frame].world_to_camera, before[frame].world_to_camera)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{}", "'R' is not"),
        ('{"R": [[1,0,0],[0,1,0],[0,0,2]], "t": [0,0,0], "focal": [1,1], "princpt": [0,0]}', "rotation"),
        ('{"R": [[1,0,0],[0,1,0],[0,0,1]], "t": [0,0,0], "focal": [0,1], "princpt": [0,0]}', "positive"),
        ("[", "not readable JSON"),
    ],
)
def test_damaged_camera_files_are_named(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "7.json").write_text(content)
    with pytest.raises(UserError, match=message) as caught:
        open_calibration(str(tmp_path), "", clip_of())
    assert "7.json" in str(caught.value)


def test_what_is_no_calibration_is_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "cameras.txt").write_text("1 PINHOLE many\n")
    (tmp_path / "empty").mkdir()
    (tmp_path / "rig.qca.txt").write_text("not xml")
    for name, message in (
        ("nowhere", "does not exist"), ("notes.txt", "no calibration that is known"), ("empty", "neither"),
        ("model", "COLMAP model"), ("rig.qca.txt", "no Qualisys"),
    ):  # fmt: skip
        with pytest.raises(UserError, match=message):
            open_calibration(str(tmp_path / name), "", clip_of())
    assert open_calibration("auto", "", clip_of()) is None


# Rigs

_QUALISYS = """<calibration><cameras>
<camera serial="A"><fov_video left="8" right="107" top="0" bottom="199"/>
<transform x="1000" y="-2000" z="1500" r11="1" r12="0" r13="0"
 r21="0" r22="0" r23="1" r31="0" r32="-1" r33="0"/>
<intrinsic focalLengthU="9600" focalLengthV="9600" centerPointU="3712" centerPointV="6400"
 radialDistortion1="{k1}" radialDistortion2="0" tangentalDistortion1="0" tangentalDistortion2="0"/></camera>
<camera serial="B"/></cameras></calibration>"""


def test_a_qualisys_camera_sees_the_lab_where_it_is(tmp_path: Path) -> None:
    path = tmp_path / "rig.qca.txt"
    path.write_text(_QUALISYS.format(k1="0.0"))
    given = open_calibration(str(path), "A", clip_of(size=(100, 200)))
    assert given is not None and given.metric and given.upright
    view = given.views[""]
    # It stands at (1, -2, 1.5) m with Z up and looks along the lab's +Y: 3 m ahead lies (1, 1, 1.5).
    camera = Camera(100, 200, *(torch.tensor(np.asarray(a)) for a in
                    (view.lens.calibration_matrix(), view.rotation, view.translation)))  # fmt: skip
    ahead = torch.tensor([1.0, 1.5, -1.0]).double()  # the same in a world with Y up
    torch.testing.assert_close(project(camera, ahead), torch.tensor([50.0, 100.0]).double())
    above_right = ahead + torch.tensor([0.3, 0.6, 0.0])
    torch.testing.assert_close(project(camera, above_right), torch.tensor([65.0, 70.0]).double())
    with pytest.raises(UserError, match="ingest.camera_name to one of A, B"):
        open_calibration(str(path), "", clip_of())
    with pytest.raises(UserError, match="'B' has no 'transform'"):
        open_calibration(str(path), "B", clip_of())


def test_a_pose2sim_camera_agrees_with_opencv(tmp_path: Path) -> None:
    turn, shift = [1.2, -0.4, 0.3], [0.1, 0.2, 3.0]
    (tmp_path / "Calib.toml").write_text(
        '[cam_01]\nname = "cam_01"\nsize = [128.0, 96.0]\nmatrix = [[150.0, 0.0, 60.0], [0.0, 151.0, 50.0], '
        "[0.0, 0.0, 1.0]]\ndistortions = [-0.2, 0.05, 0.001, -0.002]\n"
        f"rotation = {turn}\ntranslation = {shift}\n"
        "[metadata]\nadjusted = false\n"
    )
    given = open_calibration(str(tmp_path / "Calib.toml"), "", clip_of())
    assert given is not None
    view = given.views[""]
    point = np.array([0.2, -0.3, 0.5])  # Z up
    matrix = np.array([[150.0, 0, 60], [0, 151.0, 50], [0, 0, 1]])
    bend = np.array([-0.2, 0.05, 0.001, -0.002])
    expected = cv2.projectPoints(point[None], np.array(turn), np.array(shift), matrix, bend)[0][0, 0]
    there = view.rotation @ np.array([0.2, 0.5, 0.3]) + view.translation
    np.testing.assert_allclose(view.lens.img_from_cam(there), expected + 0.5, atol=1e-9)


# Lenses


def test_a_lens_is_turned_and_scaled_with_the_frames(tmp_path: Path) -> None:
    """A point keeps its place in the picture when picture and camera are turned alike."""
    lens = pinhole_lens(200, 100, (150.0, 160.0), (90.0, 55.0))
    rotation, translation = poses(4)[3]
    point = rotation.T @ (np.array([0.2, -0.1, 2.0]) - translation)
    x, y = np.asarray(lens.img_from_cam(rotation @ point + translation))
    for turns, expected in ((1, (y, 200 - x)), (3, (100 - y, x))):
        clip = clip_of(size=(100, 200), orientation=Orientation(turns))
        view = for_stored_frames(CalibratedCamera(lens, rotation, translation), clip, 50, 100, tmp_path)
        found = view.lens.img_from_cam(view.rotation @ point + view.translation)
        np.testing.assert_allclose(found, np.array(expected) / 2, atol=1e-9)
        assert np.linalg.det(view.rotation) == pytest.approx(1)
    with pytest.raises(UserError, match="made for pictures of 200x100"):
        for_stored_frames(
            CalibratedCamera(lens, rotation, translation), clip_of(size=(100, 100)), 50, 50, tmp_path
        )


def test_distortion_is_taken_out_of_frames_masks_and_points_alike(tmp_path: Path) -> None:
    lens = pycolmap.Camera(model="OPENCV", width=160, height=120, params=[150, 150, 80, 60, -0.3, 0.1, 0, 0])
    assert distortion_pixels(without_distortion(lens)) == 0 and 4 < distortion_pixels(lens) < 20
    straight = np.array([[30.0, 30.0], [130.0, 90.0], [80.0, 20.0]])  # where the pinhole sees three dots
    rays = np.concatenate([(straight - [80, 60]) / 150, np.ones((3, 1))], axis=1)
    bent = np.asarray(lens.img_from_cam(rays))
    assert np.linalg.norm(bent - straight, axis=1).max() > 2
    np.testing.assert_allclose(undistort_points(lens, bent), straight, atol=1e-6)
    y, x = np.mgrid[0:120, 0:160] + 0.5
    spots = np.exp(-np.square(np.stack([x, y], -1)[None] - bent[:, None, None]).sum(-1) / 8).sum(0)
    for folder in ("frames", "masks"):
        (tmp_path / folder).mkdir()
    write_frame(tmp_path / "frames", 0, np.repeat((spots * 255).astype(np.uint8)[..., None], 3, 2))
    write_mask(tmp_path / "masks", 0, (spots * 255).astype(np.uint8))
    keypoints = empty_keypoints(np.array([0]))
    keypoints.whole_body[0, :3] = [[*point, 0.9] for point in bent]
    result = undistort_frames(tmp_path, {0: lens}, keypoints)
    np.testing.assert_allclose(result.whole_body[0, :3, :2], straight, atol=1e-4)
    assert (result.whole_body[0, 3:] == 0).all() and (result.hands == 0).all()
    image = read_frame(tmp_path / "frames", 0)[..., 0].astype(float)
    for centre in straight:
        near = np.square(x - centre[0]) + np.square(y - centre[1]) < 64
        weight = image * near
        found = [(weight * x).sum() / weight.sum(), (weight * y).sum() / weight.sum()]
        np.testing.assert_allclose(found, centre, atol=0.25)


def test_a_distorted_model_changes_what_is_published(
    material: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_colmap(material / "model", [f"{k}.png" for k in range(COUNT)], model="OPENCV")
    output = ingest(material, cameras=str(material / "model"), camera_scale=1.0)
    assert "taken out of the frames" in capsys.readouterr().out
    record = read_footage(output / "footage.json").camera
    assert record["undistorted"] and record["distortion_pixels"] > 1
    assert not np.array_equal(
        read_frame(output / "frames", 0), read_frame(ingest(material, "b") / "frames", 0)
    )


# Numbering, gaps, world


def matched(names: list[str], clip: Clip, total: int, path: Path) -> dict[str, int]:
    view = CalibratedCamera(pinhole_lens(4, 4, (4.0, 4.0), (2.0, 2.0)), np.eye(3), np.zeros(3))
    given = Calibration(path, "COLMAP", dict.fromkeys(names, view), metric=False, upright=False)
    return frames_of_views(given, clip, total)[0]


def test_names_of_pictures_in_a_folder_win(tmp_path: Path) -> None:
    clip = clip_of(tmp_path, pictures={0: Path("a12.png"), 1: Path("a13.png")})
    assert matched(["a13.jpg", "a12.jpg"], clip, 2, tmp_path) == {"a13.jpg": 1, "a12.jpg": 0}


def test_numbers_are_believed_where_nobody_knows_the_length(tmp_path: Path) -> None:
    assert matched(["x/90.png"], clip_of(), 0, tmp_path) == {"x/90.png": 90}
    with pytest.raises(UserError, match="both name frame 4"):
        matched(["a4.png", "b4.png"], clip_of(), 8, tmp_path)
    with pytest.raises(UserError, match="no frame number"):
        matched(["front.png"], clip_of(), 8, tmp_path)


def test_short_gaps_are_filled_and_long_ones_are_not() -> None:
    turn = Rotation.from_rotvec([0, 0.4, 0]).as_matrix()
    known = {0: (np.eye(3), np.zeros(3)), 4: (turn, -turn @ [1.0, 0, 0]), 20: (np.eye(3), np.zeros(3))}
    filled = interpolate_gaps(known, list(range(22)), longest=4)
    assert sorted(filled) == [0, 1, 2, 3, 4, 20]
    rotation, translation = filled[1]
    np.testing.assert_allclose(Rotation.from_matrix(rotation).as_rotvec(), [0, 0.1, 0], atol=1e-6)
    np.testing.assert_allclose(-rotation.T @ translation, [0.25, 0, 0], atol=1e-6)


def test_the_world_of_one_camera_is_the_facing_one() -> None:
    rotation, translation = poses(6)[5]
    rotations, translations = to_upright_world(np.stack([rotation] * 3), np.stack([translation] * 3))
    np.testing.assert_allclose(rotations, np.stack([FACING] * 3), atol=1e-12)
    np.testing.assert_allclose(translations, 0, atol=1e-12)


# Settings


def test_paths_and_words_of_the_setting(tmp_path: Path) -> None:
    from stages.ingest import STAGE
    from stages.ingest.settings import IngestSettings

    settings = IngestSettings(cameras=str(tmp_path))
    assert STAGE.demands(settings).paths == {"cameras": tmp_path}
    for word in ("auto", "pinhole", "sfm"):
        assert STAGE.demands(IngestSettings(cameras=word)).paths == {}


def test_the_sfm_setting_falls_back_where_there_is_nothing_to_follow(
    material: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    grey = [np.full((96, 128, 3), 100, np.uint8)] * COUNT
    write_clip(material / "clip.mp4", grey)
    output = ingest(material, cameras="sfm", background=False)
    assert "a static pinhole takes their place" in capsys.readouterr().out
    assert read_footage(output / "footage.json").camera["source"] == "pinhole"


def test_a_binary_model_that_says_more_than_it_holds_is_refused_at_once(tmp_path: Path) -> None:
    """pycolmap would read 2^63 entries past the end."""
    for name in ("cameras", "images", "points3D", "rigs", "frames"):
        folder = write_colmap(tmp_path / name, ["0.png", "1.png"], binary=True)
        assert open_calibration(str(folder), "", clip_of()) is not None
        path = folder / f"{name}.bin"
        path.write_bytes((2**63).to_bytes(8, "little") + path.read_bytes()[8:])
        with pytest.raises(UserError, match=rf"{name}\.bin is damaged or cut off"):
            open_calibration(str(folder), "", clip_of())
