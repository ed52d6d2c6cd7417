"""The whole stage on footage whose keypoints and masks come from folders; it needs no asset."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pipeline.clip.frames import read_frame, read_mask
from pipeline.clip.keypoints import FACE, NAMES, read_keypoints
from pipeline.clip.records import Split, read_cameras, read_footage, read_split
from pipeline.errors import UserError
from stages.ingest.detect import NO_BODY
from stages.ingest.run import run
from tests.made.videos import (
    body_points,
    ingest_context,
    walking_blob,
    write_clip,
    write_images,
    write_points,
)

COUNT = 10


@pytest.fixture
def material(tmp_path: Path) -> Path:
    """A folder with clip.mp4, keypoints/ and masks/ for ten frames of 128 x 96."""
    frames, masks = walking_blob(COUNT)
    write_clip(tmp_path / "clip.mp4", frames)
    write_images(tmp_path / "masks", masks)
    write_points(tmp_path / "keypoints", range(COUNT))
    return tmp_path


def ingest(material: Path, name: str = "run", source: str = "clip.mp4", **settings: object) -> Path:
    given = {"keypoints": str(material / "keypoints"), "masks": str(material / "masks"), **settings}
    context = ingest_context(material / name, material / source, **given)
    run(context)
    return context.output


def test_everything_is_published(material: Path) -> None:
    output = ingest(material)
    expected = {"frames", "masks", "foreground", "keypoints.parquet", "cameras.parquet", "split.json",
                "footage.json", "preview.png"}  # fmt: skip
    assert {path.name for path in output.iterdir()} == expected
    truth, masks = walking_blob(COUNT)
    for index in range(COUNT):
        assert np.abs(read_frame(output / "frames", index).astype(int) - truth[index]).mean() < 6
        np.testing.assert_array_equal(read_mask(output / "masks", index), masks[index])
    assert read_split(output / "split.json") == Split(tuple(range(9)), (9,))
    points = read_keypoints(output / "keypoints.parquet")
    np.testing.assert_array_equal(points.frames, np.arange(COUNT))
    np.testing.assert_allclose(points.whole_body[2], np.array(body_points(46.0, 44.0)), rtol=1e-6)
    for empty in (points.face_mesh, points.pose_image, points.pose_world, points.hands):
        assert (empty == 0).all()
    camera = read_cameras(output / "cameras.parquet")[4]
    assert (camera.width, camera.height) == (128, 96)
    assert camera.intrinsics[0, 0] == pytest.approx(1.2 * 128) and camera.intrinsics[0, 2] == 64
    footage = read_footage(output / "footage.json")
    assert (footage.kept, footage.read, footage.dropped, footage.fps) == (COUNT, COUNT, {}, 25.0)
    np.testing.assert_allclose(footage.seconds, np.arange(COUNT) / 25, atol=1e-5)


def test_equal_runs_give_equal_bytes(material: Path) -> None:
    first, second = ingest(material, "first"), ingest(material, "second")
    files = sorted(path.relative_to(first) for path in first.rglob("*") if path.is_file())
    assert len(files) == 3 * COUNT + 5
    for file in files:
        assert (first / file).read_bytes() == (second / file).read_bytes(), file


def test_footage_is_reduced_and_points_with_it(material: Path) -> None:
    output = ingest(material, long_side=64, focal=1.5)
    assert read_frame(output / "frames", 0).shape == (48, 64, 3)
    assert read_mask(output / "masks", 0).shape == (48, 64)
    points = read_keypoints(output / "keypoints.parquet")
    np.testing.assert_allclose(points.whole_body[0, :, :2], np.array(body_points(40, 44))[:, :2] / 2)
    camera = read_cameras(output / "cameras.parquet")[0]
    assert (camera.width, camera.height, float(camera.intrinsics[0, 0])) == (64, 48, 96.0)
    assert read_footage(output / "footage.json").scale == 0.5


def test_frames_that_are_skipped_keep_their_numbers(material: Path) -> None:
    output = ingest(material, stride=3, test_frames=2)
    assert read_split(output / "split.json") == Split((0, 3), (6, 9))


def test_a_folder_of_pictures_is_footage(material: Path) -> None:
    write_images(material / "pictures", walking_blob(COUNT)[0])
    output = ingest(material, source="pictures")
    np.testing.assert_array_equal(read_frame(output / "frames", 3), walking_blob(COUNT)[0][3])


def test_frames_without_a_person_are_dropped_and_counted(material: Path) -> None:
    write_points(material / "keypoints", (2, 3), score=0.05)
    (material / "keypoints" / "5.json").unlink()
    (material / "masks" / "0006.png").unlink()
    write_images(material / "masks", [np.zeros((96, 128), np.uint8)], ["0007.png"])
    output = ingest(material)
    footage = read_footage(output / "footage.json")
    assert (footage.read, footage.kept) == (10, 5)
    assert footage.dropped == {
        "mask too small": 1, "no keypoint file": 1, "no mask file": 1, "no person found": 2,
    }  # fmt: skip
    assert sorted(int(path.stem) for path in (output / "frames").iterdir()) == [0, 1, 4, 8, 9]
    assert sorted(int(path.stem) for path in (output / "masks").iterdir()) == [0, 1, 4, 8, 9]
    np.testing.assert_array_equal(read_keypoints(output / "keypoints.parquet").frames, [0, 1, 4, 8, 9])


def test_dropped_frames_are_told(material: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_points(material / "keypoints", (2, 3), score=0.05)
    ingest(material)
    assert "8 of 10 frames of 128x96 kept, 1 of them held out (no person found: 2)" in capsys.readouterr().out


def test_points_of_the_face_alone_are_told_apart_from_nobody(material: Path) -> None:
    for number in (2, 3):
        points = np.array(body_points(40, 44))
        points[:, 2] = 0.0
        if number == 3:
            points[FACE, 2] = 1.0
        (material / "keypoints" / f"{number}.json").write_text(json.dumps(points.tolist()))
    assert read_footage(ingest(material) / "footage.json").dropped == {NO_BODY: 1, "no person found": 1}


def test_points_outside_the_picture_lose_their_score(material: Path) -> None:
    points = body_points(40, 44)
    points[0], points[1] = [-3.0, 10.0, 0.9], [10.0, 97.0, 0.9]
    (material / "keypoints" / "0.json").write_text(json.dumps(points))
    whole = read_keypoints(ingest(material) / "keypoints.parquet").whole_body[0]
    assert (whole[:2] == 0).all() and whole[2, 2] > 0


def test_mmpose_results_are_read(material: Path) -> None:
    for path in (material / "keypoints").iterdir():
        path.unlink()
    for number in range(COUNT):
        near, far = np.array(body_points(40, 44)), np.array(body_points(90, 20, 0.4))
        people = [
            {"keypoints": one[:, :2].tolist(), "keypoint_scores": one[:, 2].tolist()} for one in (far, near)
        ]
        file = material / "keypoints" / f"results_{number:05d}.json"
        file.write_text(json.dumps({"meta_info": {}, "instance_info": people}))
    whole = read_keypoints(ingest(material) / "keypoints.parquet").whole_body
    np.testing.assert_allclose(whole[3], np.array(body_points(40, 44)), rtol=1e-6)


def test_an_mmpose_frame_without_anyone_is_dropped(material: Path) -> None:
    (material / "keypoints" / "4.json").write_text(json.dumps({"instance_info": []}))
    assert read_footage(ingest(material) / "footage.json").dropped == {"no person found": 1}


# Bad input.


def refuses(material: Path, message: str, **settings: object) -> None:
    with pytest.raises(UserError, match=message) as caught:
        ingest(material, "refused", **settings)
    assert "\n" not in str(caught.value)


def test_no_person_in_any_frame(material: Path) -> None:
    write_points(material / "keypoints", range(COUNT), score=0.0)
    refuses(material, r"clip\.mp4 shows no person in any of 10 frames \(no person found: 10\): give a clip")


def test_a_person_in_one_frame_only(material: Path) -> None:
    write_points(material / "keypoints", range(1, COUNT), score=0.0)
    refuses(material, r"clip\.mp4 shows a person in 1 of 10 frames only")


def test_one_frame(material: Path) -> None:
    write_clip(material / "short.mp4", walking_blob(1)[0])
    for folder in ("keypoints", "masks"):
        for path in (material / folder).iterdir():
            if int(path.stem):
                path.unlink()
    refuses(material, r"short\.mp4 gave 1 frame: an avatar needs a clip of at least 2", source="short.mp4")


@pytest.mark.parametrize("folder", ["keypoints", "masks"])
def test_a_file_for_a_frame_that_is_not_there(material: Path, folder: str) -> None:
    first = next((material / folder).iterdir())
    (material / folder / f"77{first.suffix}").write_bytes(first.read_bytes())
    refuses(material, r"77\.(json|png) is for frame 77, which the clip does not have")


def test_a_part_of_the_clip_needs_no_part_of_the_files(material: Path) -> None:
    assert read_footage(ingest(material, max_frames=4) / "footage.json").kept == 4


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999", "1e30"])
def test_numbers_that_are_not_finite(material: Path, number: str) -> None:
    text = json.dumps(body_points(40.0, 44.0)).replace("40.0", number, 1)
    (material / "keypoints" / "3.json").write_text(text)
    refuses(material, r"3\.json.*(finite number|is not finite).*write it again")


@pytest.mark.parametrize(
    "value",
    [[], [[1, 2, 0.5]] * 132, [[1, 2]] * 133, [[1, 2, None]] * 133, [["a", "b", "c"]] * 133, {"person": []},
     {"instance_info": 3}, {"instance_info": [{"keypoints": [[1, 2]] * 133}]},
     {"instance_info": [{"keypoints": [[1, 2]] * 20, "keypoint_scores": [1] * 20}]}],
)  # fmt: skip
def test_malformed_keypoint_files(material: Path, value: object) -> None:
    (material / "keypoints" / "3.json").write_text(json.dumps(value))
    refuses(material, r"3\.json.*: write it again as 133")


def test_a_keypoint_file_that_is_not_json(material: Path) -> None:
    (material / "keypoints" / "3.json").write_text("[[1, 2")
    refuses(material, r"3\.json is not readable JSON")


def test_two_files_for_one_frame(material: Path) -> None:
    (material / "keypoints" / "frame_3.json").write_text("[]")
    refuses(material, r"both name frame 3: keep one")


def test_a_damaged_mask(material: Path) -> None:
    (material / "masks" / "0003.png").write_bytes(b"no picture")
    refuses(material, r"0003\.png is not a readable picture")


@pytest.mark.parametrize("name", ["keypoints", "masks"])
def test_a_folder_that_is_not_there(material: Path, name: str) -> None:
    refuses(
        material, rf"nowhere is not a folder: ingest\.{name} must be", **{name: str(material / "nowhere")}
    )


def test_an_empty_folder(material: Path) -> None:
    (material / "empty").mkdir()
    refuses(material, r"empty holds no numbered \.json file", keypoints=str(material / "empty"))


def test_an_unreadable_picture_in_a_folder(material: Path) -> None:
    folder = write_images(material / "pictures", walking_blob(COUNT)[0])
    (folder / "0004.png").write_bytes(b"no picture")
    refuses(material, r"0004\.png is not a readable picture: replace it", source="pictures")


def test_no_source(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="names no footage: add source="):
        run(ingest_context(tmp_path, None))


def test_mediapipe_is_not_there(material: Path) -> None:
    refuses(material, r"MediaPipe is not in data/assets: fetch it", keypoints="mediapipe")


def test_the_published_points_have_names(material: Path) -> None:
    assert read_keypoints(ingest(material) / "keypoints.parquet").whole_body.shape[1] == len(NAMES)
