"""The methods beside the avatar, and the further metrics: faces, other cameras, protocols, flicker."""

import dataclasses
import json

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

from pipeline.body import Poses, write_poses
from pipeline.clip.frames import read_mask
from pipeline.clip.records import read_cameras, write_cameras
from pipeline.errors import UserError
from pipeline.metrics.face_identity import RecognizedFace
from stages.evaluate import statistics
from stages.evaluate.report.tables import camera_table
from stages.evaluate.scores import TableRow, score_table
from stages.evaluate.second_mask import SecondMask, edge, estimated, independent, person_box, second_mask
from stages.evaluate.settings import EvaluateSettings
from stages.evaluate.statistics import bounds, differences, intervals
from stages.evaluate.textured_mesh import nearest_known
from tests.made.blob import HEIGHT, TEST, WIDTH, make_clip, moving_poses, stand_in


@pytest.fixture
def clip(tmp_path):
    return make_clip(tmp_path, soft=True)


def summary_of(output):
    return json.loads((output / "summary.json").read_text())


def edges_of(clip):
    evaluated = clip.clip()
    masks = {frame: edge(evaluated.mask(frame)) for frame in TEST[:2]}
    return SecondMask(evaluated, masks, "the same, 1 px smaller")


# The ceiling


def test_the_truth_under_another_mask_is_the_ceiling_and_no_contestant(clip):
    output = clip.evaluate(second=edges_of(clip))
    summary, report = summary_of(output), (output / "report.html").read_text()
    ceiling = summary["means"]["test"]["second_mask"]
    assert 15 < ceiling["psnr"] < summary["means"]["test"]["avatar"]["psnr"]  # this avatar made the masks
    assert ceiling["psnr_interior"] > ceiling["psnr"] + 3
    rows = pq.read_table(output / "metrics.parquet").to_pylist()
    assert {row["frame"] for row in rows if row["method"] == "second_mask"} == set(TEST[:2])
    assert f"<b>{ceiling['psnr']:.2f}</b>" not in report
    assert "the same, 1 px smaller (2 frames)" in report
    assert summary["frames_with_second_mask"] == 2
    assert f"{ceiling['psnr']:.1f} dB" in " ".join(summary["verdict"])


def test_the_edge_is_one_pixel_further_in_and_open_at_the_border():
    mask = np.zeros((8, 9), np.uint8)
    mask[3:, 2:7] = 255
    expected = np.zeros_like(mask)
    expected[4:, 3:6] = 255
    assert np.array_equal(edge(mask), expected)


def test_masks_of_others_are_read_by_frame_number_and_refused_where_they_do_not_fit(clip, tmp_path):
    evaluated, folder = clip.clip(), tmp_path / "theirs"
    folder.mkdir()
    for frame, name in zip(TEST, ("000018.png", "00020.png", "22.png"), strict=True):
        assert int(name[:-4]) == frame
        cv2.imwrite(str(folder / name), np.full((HEIGHT, WIDTH), frame, np.uint8))
    context = clip.context(second_mask=str(folder))
    found = second_mask(context, evaluated)
    assert {frame: int(mask[0, 0]) for frame, mask in found.masks.items()} == {one: one for one in TEST}
    assert found.source == "theirs"
    cv2.imwrite(str(folder / "22.png"), np.zeros((4, 4), np.uint8))
    with pytest.raises(UserError, match=r"22\.png: not a grey picture of 64 x 48"):
        second_mask(context, evaluated)
    (folder / "22.png").unlink()
    with pytest.raises(UserError, match=r"second_mask=.*no 000022\.png or 22\.png"):
        second_mask(context, evaluated)


def test_of_the_estimators_two_segmentations_the_agreeing_one_is_taken(clip):
    evaluated = clip.clip()

    @dataclasses.dataclass
    class Seen:
        body_mask: np.ndarray
        selfie_mask: np.ndarray

    class Stub:
        def __init__(self):
            self.frames = iter(TEST)

        def estimate(self, image):
            frame = next(self.frames)
            if frame == TEST[2]:
                return None
            true = read_mask(clip.inputs["ingest"] / "masks", frame) / np.float32(255)
            blurred = np.kron(cv2.blur(true, (9, 9)), np.ones((3, 3), np.float32))
            return Seen(np.ones_like(blurred), blurred)

    counted = []
    found = estimated(Stub(), evaluated, TEST, lambda: counted.append(1))
    assert set(found.masks) == set(TEST[:2]) and len(counted) == 3
    assert "selfie" in found.source and found.masks[TEST[0]].shape == (HEIGHT, WIDTH)
    assert not second_mask(clip.context(second_mask="off"), evaluated).masks


def test_an_independent_model_sees_the_persons_box_alone(clip):
    evaluated, shown = clip.clip(), []

    def model(image):
        shown.append(image)
        return np.full(image.shape[:2], 0.5, np.float32)

    counted = []
    found = independent(model, evaluated, TEST, lambda: counted.append(1))
    assert set(found.masks) == set(TEST) and len(counted) == len(TEST) and "U2-Net" in found.source
    for frame, image in zip(TEST, shown, strict=True):
        mask = found.masks[frame]
        assert (mask[evaluated.mask(frame) > 127] == 128).all()
        assert (mask > 0).sum() == image.shape[0] * image.shape[1] < mask.size


def test_the_box_of_a_person_has_a_margin_and_ends_at_the_picture():
    inside = np.zeros((20, 30), bool)
    assert person_box(inside, 0.1) is None
    inside[2:12, 0:20] = True
    assert person_box(inside, 0.1) == (slice(1, 13), slice(0, 22))


# Protocols


def noisy(pose, time):
    """The blob with a speck beside it, which no mask holds."""
    right = stand_in(pose, time)
    means = right.means.clone()
    means[0] = pose.transl + torch.tensor([0.5, 0.3, 0.0])
    colors = right.colors.clone()
    colors[0] = 1.0
    return dataclasses.replace(right, means=means, colors=colors)


def test_the_truths_mask_on_both_pictures_forgives_and_says_so(clip):
    own = clip.evaluate(noisy, name="own")
    both = clip.evaluate(noisy, name="both", render_mask="truth")
    strict, kind = (summary_of(one)["means"]["test"]["avatar"] for one in (own, both))
    assert kind["psnr"] > strict["psnr"] + 1
    # What the protocol chose is among the composites that are always shown.
    for one in (strict, kind):
        assert one["psnr_black_own"] == strict["psnr"] and one["psnr_black_truth"] == kind["psnr"]
    named = EvaluateSettings(protocol="paper_black").choices
    changed = EvaluateSettings(render_mask="truth", refine_test_poses="off", edge_colors="photograph").choices
    assert named == changed and named != EvaluateSettings().choices
    assert summary_of(own)["protocol"] != summary_of(both)["protocol"]


# Faces


class Faces:
    """Embeds a picture by its mean colour, and sees no face in dark ones."""

    def read(self, image, box=None):
        inside = box.clipped(image.shape[1], image.shape[0])
        mean = image[inside.slices].reshape(-1, 3).mean(0)
        return RecognizedFace(box, mean / 255) if mean.sum() > 60 else None


def test_faces_are_compared_frame_by_frame(clip):
    summary = summary_of(clip.evaluate(embedder=Faces()))
    means = summary["means"]["test"]
    assert 10 * means["avatar"]["identity_distance"] < means["nearest_frame"]["identity_distance"]
    assert means["avatar"]["identity_cosine"] >= means["nearest_frame"]["identity_cosine"]
    assert means["avatar"]["identity_found"] == 1 and "identity_found" not in means["mean_frame"]


def test_a_face_that_the_render_lacks_is_counted(clip):
    def invisible(pose, time):
        right = stand_in(pose, time)
        return dataclasses.replace(right, opacities=torch.full((40,), 0.01))

    means = summary_of(clip.evaluate(invisible, embedder=Faces()))["means"]["test"]["avatar"]
    assert means["identity_found"] == 0 and "identity_distance" not in means


class Colours:
    """Embeds a picture by its mean colour around the points."""

    def embed(self, image, points):
        (left, top), (right, bottom) = points.min(0).astype(int), points.max(0).astype(int) + 1
        return image[top:bottom, left:right].reshape(-1, 3).mean(0) + 1.0


def test_faces_are_compared_as_the_paper_does(clip):
    output = clip.evaluate(arcface=Colours())
    means = summary_of(output)["means"]["test"]
    assert -1 <= means["nearest_frame"]["arcface_cosine"] < means["avatar"]["arcface_cosine"] <= 1
    assert "arcface_cosine" not in means["mean_frame"]
    assert f"{means['avatar']['arcface_cosine']:.4f}" in (output / "report.html").read_text()


# Other cameras


def test_held_out_frames_of_another_camera_stand_apart(clip):
    path = clip.inputs["ingest"] / "cameras.parquet"
    cameras = read_cameras(path)
    turn = torch.tensor([[0.0, 0.0, -1.0], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0]])
    aside = dataclasses.replace(cameras[TEST[0]], rotation=turn, translation=torch.tensor([-2.0, 0.0, 2.0]))
    write_cameras(path, {**cameras, TEST[0]: aside})
    assert clip.clip().other_cameras == {TEST[0]}
    output = clip.evaluate()
    summary = summary_of(output)
    assert summary["frames_of_other_cameras"] == 1
    apart = summary["cameras"]
    assert set(apart) == {"training camera", "other camera"}
    assert (
        apart["training camera"]["test"]["avatar"]["psnr"]
        > 50
        > apart["other camera"]["test"]["avatar"]["psnr"]
    )
    shown = f"{apart['other camera']['test']['avatar']['psnr']:.2f}"
    assert shown in (output / "report.html").read_text()


def test_a_mannequins_cameras_are_shown_by_name(clip):
    rows = [
        TableRow(2, "views", "avatar", metric, value, "back")
        for metric, value in (("psnr", 20.0), ("psnr_unseen", 12.0), ("psnr_seen", 25.0))
    ]
    output = clip.evaluate(other_cameras=rows)
    shown = camera_table(summary_of(output))
    assert [row.label for row in shown.rows] == ["back: avatar"]
    assert [cell.text for cell in shown.rows[0].cells] == ["20.00", "25.00", "12.00"]
    assert "12.00" in (output / "report.html").read_text()
    rows = pq.read_table(output / "metrics.parquet").to_pylist()
    assert {row["view"] for row in rows} == {"", "back"}


# The mesh and what is made of the scores


def test_unknown_colours_are_the_nearest_known_ones():
    places = np.array([[0.0, 0, 0], [1, 0, 0], [5, 0, 0]])
    color = np.array([[10.0, 0, 0], [0, 0, 0], [30, 0, 0]], np.float32)
    found = nearest_known(color, np.array([True, False, True]), places)
    assert found[:, 0].tolist() == [10, 10, 30]
    assert (nearest_known(color, np.zeros(3, bool), places) == 128).all()


def test_differences_are_taken_frame_by_frame():
    values = {
        "avatar": (20.0, 30.0, 25.0),
        "nearest_frame": (18.0, 27.0, 24.0),
        "second_mask": (None, 29.0, None),
    }
    scores = [
        TableRow(frame, "test", method, "psnr", value)
        for method, each in values.items()
        for frame, value in enumerate(each)
        if value is not None
    ]
    settings = EvaluateSettings(second_mask="edge")
    table = score_table(scores)
    over = differences(table, ["psnr"], settings)
    assert over["nearest_frame"]["psnr"]["mean"] == pytest.approx(2.0)
    assert over["nearest_frame"]["psnr"]["low"] < 1 < 3 < over["nearest_frame"]["psnr"]["high"]
    assert over["second_mask"]["psnr"] == {"mean": 1.0, "low": 1.0, "high": 1.0}
    wild = [TableRow(frame, "test", "avatar", "ssim", value) for frame, value in enumerate((0.5, 0.9, 0.98))]
    assert intervals(score_table(wild), settings)["test"]["avatar"]["ssim"][1] == 1.0  # and no more
    assert bounds("lpips_alex_face")[0] == bounds("flicker")[0] == 0
    low, high = intervals(table, settings)["test"]["avatar"]["psnr"]
    assert low < statistics.means(table, ["psnr"])["test"]["avatar"]["psnr"] < high


def test_intervals_stand_beside_every_mean(clip):
    summary = summary_of(clip.evaluate())
    for method, means in summary["means"]["test"].items():
        assert set(summary["intervals"]["test"][method]) == set(means)
    assert summary["confidence"] == 0.95
    assert summary["differences"]["nearest_frame"]["psnr"]["low"] > 0


def test_flicker_of_a_trembling_avatar_is_larger(clip):
    poses = moving_poses()
    steady = summary_of(clip.evaluate(name="steady"))["means"]["test"]
    shaken = poses.transl.clone()
    shaken[::2, 0] += 0.02
    trembling = Poses(poses.frames, poses.rotation, poses.expression, shaken)
    write_poses(clip.inputs["fit"] / "poses.parquet", trembling)
    shaken = summary_of(clip.evaluate(name="shaken"))["means"]["test"]
    assert shaken["avatar"]["flicker"] > steady["avatar"]["flicker"] + 3
    # A still picture lacks the whole motion.
    assert steady["mean_frame"]["flicker"] > shaken["avatar"]["flicker"]
