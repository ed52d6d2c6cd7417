"""Keypoints and masks that the user gives: used, read in the form that they have, or refused by file name."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pipeline.clip.frames import read_frame, read_mask
from pipeline.clip.keypoints import BODY, COUNT, FACE, FEET, LEFT_HAND, RIGHT_HAND, read_keypoints
from pipeline.clip.records import read_footage
from pipeline.detection.mediapipe import Estimate
from pipeline.errors import UserError
from stages.ingest.keypoint_files import people_in
from stages.ingest.mask_files import MaskForm, find_form, read_given_mask
from stages.ingest.run import run
from tests.made.videos import body_points, ingest_context, walking_blob, write_clip, write_images

N, SIZE = 6, (128, 96)
FRAMES, MASKS = walking_blob(N)


def person(number: int) -> np.ndarray:
    """133 points on the blob of a frame."""
    return np.array(body_points(40.0 + 3 * number, 44.0))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_clip(tmp_path / "clip.mp4", FRAMES)
    write_images(tmp_path / "masks", MASKS)
    write_json(tmp_path / "keypoints", lambda number: person(number).tolist())
    return tmp_path


def write_json(folder: Path, value: Callable[[int], Any], name: str = "{}.json", count: int = N) -> None:
    folder.mkdir(exist_ok=True)
    for number in range(count):
        (folder / name.format(number)).write_text(json.dumps(value(number)))


def ingest(folder: Path, source: str = "clip.mp4", name: str = "run", **settings: object) -> Path:
    given = {"keypoints": str(folder / "keypoints"), "masks": str(folder / "masks"), **settings}
    context = ingest_context(folder / name, folder / source, **given)
    run(context)
    return context.output


def points_of(output: Path) -> np.ndarray:
    return read_keypoints(output / "keypoints.parquet").whole_body


# Points of this person, in these pixels.


@pytest.mark.parametrize(
    ("change", "saying"),
    [
        (
            lambda p: p * [1 / 128, 1 / 96, 1],
            r"0\.json: .*shares.*multiply x by 128 and y by 96",
        ),
        (lambda p: p * [2 / 128, 2 / 96, 1] - [1, 1, 0], r"0\.json: .*shares of the picture"),
        (lambda p: p * [0.5, 0.5, 1], r"0\.json: .*on the person's mask"),
        (lambda p: p * [2, 2, 1], r"0\.json: .*on the person's mask"),
        (lambda p: p[:, [1, 0, 2]] + [60, 0, 0], r"0\.json: .*on the person's mask"),
        (lambda p: p + [900, 900, 0], r"0\.json: .*on the person's mask"),
    ],
)
def test_points_that_are_not_the_person_s_are_refused_by_file(folder, change, saying) -> None:
    write_json(folder / "keypoints", lambda number: change(person(number)).tolist())
    with pytest.raises(UserError, match=saying):
        ingest(folder)


def test_points_of_another_size_are_told_by_their_factor(folder: Path) -> None:
    write_json(folder / "keypoints", lambda number: (scattered(number) * [0.5, 0.5, 1]).tolist())
    with pytest.raises(UserError, match=r"multiplied by (1\.[7-9]|2\.[0-3])"):
        ingest(folder)


def test_one_file_off_the_person_leaves_its_frame_out_by_name(folder: Path, capsys) -> None:
    (folder / "keypoints" / "3.json").write_text(json.dumps((person(3) + [70, 0, 0]).tolist()))
    footage = read_footage(ingest(folder) / "footage.json")
    assert (footage.kept, footage.dropped) == (N - 1, {"keypoints off the mask": 1})
    assert "3.json lies off the person's mask" in capsys.readouterr().out


def test_of_several_people_the_one_on_the_mask_is_meant(folder: Path) -> None:
    better = np.array(body_points(100.0, 10.0, 0.99))
    write_json(folder / "keypoints", lambda number: [better.tolist(), person(number).tolist()])
    np.testing.assert_allclose(points_of(ingest(folder))[2], person(2), rtol=1e-6)


def test_given_points_are_fitted_whoever_gives_the_masks(folder: Path, monkeypatch) -> None:
    """MediaPipe runs for the masks here, and none of its points is published."""
    seen = Estimate(
        pose=np.tile(np.float32([0.5, 0.5, 0, 1]), (33, 1)), world=np.ones((33, 4), np.float32), face=None,
        hands=(None, None), body_mask=MASKS[0].astype(np.float32) / 255,
        selfie_mask=MASKS[0].astype(np.float32) / 255,
    )  # fmt: skip
    pretend = type("Pretend", (), {"__init__": lambda *_, **__: None, "estimate": lambda *_: seen})
    nobody = type("Nobody", (), {"__init__": lambda *_: None, "detect": lambda *_: []})
    monkeypatch.setattr("stages.ingest.detect.Estimator", pretend)
    monkeypatch.setattr("stages.ingest.people_search.PersonDetector", nobody)
    write_json(folder / "keypoints", lambda number: person(0).tolist())
    given = {"keypoints": str(folder / "keypoints"), "masks": "mediapipe"}
    context = ingest_context(folder / "run", folder / "clip.mp4", {"mediapipe": folder}, **given)
    run(context)
    found = read_keypoints(context.output / "keypoints.parquet")
    np.testing.assert_allclose(found.whole_body[2], person(0), rtol=1e-6)
    assert not found.pose_image.any() and not found.face_mesh.any() and not found.hands.any()


# Forms.


def table(points: np.ndarray) -> dict[str, Any]:
    return {"keypoints": points[:, :2].tolist(), "keypoint_scores": points[:, 2].tolist()}


def with_neck(points: np.ndarray, openpose: bool) -> np.ndarray:
    neck = points[5:7].mean(0)
    if not openpose:
        return np.concatenate([points[:17], [neck], points[17:]])
    body = np.zeros((18, 3))
    order = (0, 15, 14, 17, 16, 5, 2, 6, 3, 7, 4, 11, 8, 12, 9, 13, 10)
    body[list(order)], body[1] = points[:17], neck
    return np.concatenate([body, points[17:]])


def openpose(points: np.ndarray, canvas: tuple[int, int] | None = None) -> dict[str, Any]:
    body = np.zeros((25, 3))
    body[[0, 16, 15, 18, 17, 5, 2, 6, 3, 7, 4, 12, 9, 13, 10, 14, 11]] = points[BODY]
    body[19:25] = points[FEET]
    parts = {"pose": body, "face": np.concatenate([points[FACE], np.zeros((2, 3))]),
             "hand_left": points[LEFT_HAND], "hand_right": points[RIGHT_HAND]}  # fmt: skip
    found = {f"{name}_keypoints_2d": part.reshape(-1).tolist() for name, part in parts.items()}
    named = {} if canvas is None else {"canvas_width": canvas[0], "canvas_height": canvas[1]}
    return {"version": 1.3, "people": [found], **named}


def scattered(number: int) -> np.ndarray:
    """133 points that all differ."""
    at = np.random.default_rng(number).uniform([30 + 3 * number, 30], [55 + 3 * number, 70], (COUNT, 2))
    return np.c_[at, np.full(COUNT, 0.75)]


FORMS: dict[str, Callable[[np.ndarray], Any]] = {
    "a list": lambda p: p.tolist(),
    "people": lambda p: [p.tolist()],
    "inferencer": lambda p: [{**table(p), "bbox": [[0, 0, 9, 9]], "bbox_score": 0.9}],
    "nested": lambda p: [[table(p)]],
    "predictions": lambda p: {"predictions": [[table(p)]]},
    "demo": lambda p: {"meta_info": {}, "instance_info": [table(p)]},
    "batch": lambda p: {"keypoints": [p[:, :2].tolist()], "scores": [p[:, 2].tolist()]},
    "flat": lambda p: {"keypoints": p.reshape(-1).tolist()},
    "134, OpenPose's order": lambda p: with_neck(p, True).tolist(),
    "134, COCO's order": lambda p: table(with_neck(p, False)),
    "OpenPose": openpose,
    "canvas": lambda p: openpose(p * [2, 2, 1], (256, 192)),
    "shares of a canvas": lambda p: openpose(p / [128, 96, 1], (128, 96)),
}


@pytest.mark.parametrize("form", FORMS)
def test_every_form_is_read(form: str) -> None:
    found = people_in(FORMS[form](scattered(1)), Path("x.json"), SIZE)
    assert found.shape == (1, COUNT, 3)
    np.testing.assert_allclose(found[0], scattered(1), rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize(
    ("value", "named"),
    [
        ([[1, 2, 0.5]] * 17, "COCO's 17"), ([[1, 2, 0.5]] * 136, "Halpe's 136"),
        ([[9, 2, 0.5]] * 308, "Sapiens' 308"), ([[1, 2]] * 133, "without scores"),
        ({"bodies": {}, "hands": [], "faces": []}, "DWPose's drawing"), ({"pose": 1}, "a table of pose"),
        ({"people": [{"pose_keypoints_2d": [0.0] * 6}]}, "2 body points"), ([], "an empty list"),
        (scattered(1).tolist() + [[1.0, 1.0, 0.9]], "134 points"),
    ],
)  # fmt: skip
def test_another_form_is_refused_by_its_name(value: Any, named: str) -> None:
    with pytest.raises(UserError, match=rf"x\.json .*{named}.*: write it again as 133"):
        people_in(value, Path("x.json"), SIZE)


CLIPS: dict[str, Callable[[], Any]] = {
    "inferencer": lambda: [{"frame_id": k, "instances": [table(person(k))]} for k in range(N)],
    "demo, from 1": lambda: {
        "meta_info": {},
        "instance_info": [{"frame_id": k + 1, "instances": [table(person(k))]} for k in range(N)],
    },
    "results by name": lambda: [
        {"image_id": f"{k}.jpg", "keypoints": person(k).reshape(-1).tolist(), "score": 1} for k in range(N)
    ],
    "canvases": lambda: [openpose(person(k), SIZE) for k in range(N)],
    "a table by name": lambda: {f"frame_{k:03d}.png": [person(k).tolist()] for k in range(N)},
}


@pytest.mark.parametrize("form", CLIPS)
@pytest.mark.parametrize("as_file", [True, False])
def test_one_file_of_the_whole_clip_is_read(folder: Path, form: str, as_file: bool) -> None:
    (folder / "one").mkdir()
    path = folder / "one" / "results.json"
    path.write_text(json.dumps(CLIPS[form]()))
    output = ingest(folder, keypoints=str(path if as_file else path.parent))
    np.testing.assert_allclose(points_of(output), np.stack([person(k) for k in range(N)]), rtol=1e-4)


@pytest.mark.parametrize(
    "name", ["clip_{:012d}_keypoints.json", "results_{}.json", "{:04d}_person1.json", "frame-{}.json"]
)
def test_names_of_other_programs_are_read(folder: Path, name: str) -> None:
    write_json(folder / "theirs", lambda number: openpose(person(number)), name)
    found = points_of(ingest(folder, keypoints=str(folder / "theirs")))
    np.testing.assert_allclose(found[4], person(4), rtol=1e-5)


# Which frame.


def test_files_counted_from_one_are_those_frames_in_any_part_of_the_clip(folder: Path, capsys) -> None:
    write_images(folder / "ones", MASKS, [f"{k + 1:04d}.png" for k in range(N)])
    for name, settings in (("all", {}), ("some", {"max_frames": 4}), ("every", {"stride": 2})):
        output = ingest(folder, name=name, masks=str(folder / "ones"), **settings)
        assert "6 files of 6 frames, matched by number, counted from 1" in capsys.readouterr().out
        frames = read_keypoints(output / "keypoints.parquet").frames.tolist()
        assert len(frames) > 1
        for frame in frames:
            np.testing.assert_array_equal(read_mask(output / "masks", frame), MASKS[frame])


def test_unpadded_pictures_keep_their_own_masks(folder: Path) -> None:
    frames, masks = walking_blob(12)
    names = [f"frame_{k}.png" for k in range(12)]
    write_images(folder / "pictures", frames, names)
    write_images(folder / "theirs", masks, names)
    write_json(folder / "points", lambda number: person(number).tolist(), "frame_{}.json", 12)
    given = {"masks": str(folder / "theirs"), "keypoints": str(folder / "points")}
    output = ingest(folder, "pictures", **given)
    for frame in range(12):
        np.testing.assert_array_equal(read_frame(output / "frames", frame), frames[frame])
        np.testing.assert_array_equal(read_mask(output / "masks", frame), masks[frame])
    names = read_footage(output / "footage.json").names
    assert names["10"] == "frame_10.png" and len(names) == 12


def test_a_file_of_no_picture_is_refused_also_in_a_part_of_the_clip(folder: Path) -> None:
    write_images(folder / "pictures", FRAMES, [f"frame_{k}.png" for k in range(N)])
    write_images(folder / "theirs", MASKS, [f"frame_{k + 1}.png" for k in range(N)])
    write_json(folder / "points", lambda number: person(number).tolist(), "frame_{}.json", N + 1)
    (folder / "points" / "frame_0.json").unlink()
    given = {"masks": str(folder / "theirs"), "keypoints": str(folder / "points"), "max_frames": 3}
    with pytest.raises(UserError, match=r"frame_6\.json .*ingest\.numbered_from"):
        ingest(folder, "pictures", **given)
    output = ingest(folder, "pictures", "again", **given, numbered_from=1)
    np.testing.assert_array_equal(read_mask(output / "masks", 0), MASKS[0])


# How masks are encoded.


def written(folder: Path, encode: Callable[[np.ndarray], np.ndarray], suffix: str = "png") -> list[Path]:
    write_images(folder / "encoded", [], [])
    for number, mask in enumerate(MASKS):
        picture = encode(mask)
        assert cv2.imwrite(str(folder / "encoded" / f"{number}.{suffix}"), picture)
    return sorted((folder / "encoded").iterdir())


def rgba(colour: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    return np.dstack([colour if colour.ndim == 3 else np.repeat(colour[..., None], 3, 2), alpha])


ENCODINGS: dict[str, tuple[Callable[[np.ndarray], np.ndarray], str]] = {
    "grey": (lambda m: m, "png"),
    "RGB": (lambda m: np.repeat(m[..., None], 3, 2), "png"),
    "jpeg": (lambda m: m, "jpg"),
    "opaque RGBA": (lambda m: rgba(m, np.full_like(m, 255)), "png"),
    "alpha": (lambda m: rgba(np.random.default_rng(0).integers(0, 256, (*m.shape, 3), np.uint8), m), "png"),
    "0 and 1": (lambda m: m // 255, "png"),
    "0 and 128": (lambda m: m // 255 * 128, "png"),
    "64 and 192": (lambda m: m // 255 * 128 + 64, "png"),
    "labels": (lambda m: np.where(m > 0, 1 + np.arange(m.shape[1]) % 9, 0).astype(np.uint8), "png"),
    "0 to 100": (lambda m: m // 255 * 100, "png"),
    "16 bit": (lambda m: m.astype(np.uint16) * 257, "png"),
    "16 bit, 0 and 1": (lambda m: m.astype(np.uint16) // 255, "png"),
    "16 bit, 0 and 255": (lambda m: m.astype(np.uint16), "png"),
    "float": (lambda m: m.astype(np.float32) / 255, "tiff"),
    "red on black": (lambda m: np.dstack([m * 0, m * 0, m // 255 * 128]), "png"),
    "half the size": (lambda m: m[::2, ::2], "png"),
    "inverted": (lambda m: 255 - m, "png"),
    "inverted, 0 and 1": (lambda m: 1 - m // 255, "png"),
}


@pytest.mark.parametrize("name", ENCODINGS)
def test_every_encoding_is_the_same_mask(folder: Path, name: str) -> None:
    written(folder, *ENCODINGS[name])
    output = ingest(folder, masks=str(folder / "encoded"))
    for frame in range(N):
        found, truth = read_mask(output / "masks", frame) > 127, MASKS[frame] > 127
        assert (found & truth).sum() / (found | truth).sum() > (0.9 if "half" in name else 0.99)
        assert name == "half the size" or set(np.unique(read_mask(output / "masks", frame))) >= {0, 255}


@pytest.mark.parametrize("colours", ["of labels", "of greys", "inverted"])
def test_palettes_are_read_by_what_they_show(folder: Path, colours: str) -> None:
    from PIL import Image

    (folder / "palette").mkdir()
    for number, mask in enumerate(MASKS):
        picture = Image.fromarray((mask > 0).astype(np.uint8), "P")
        shown = {"of labels": [0, 0, 0, 128, 0, 0], "of greys": [0, 0, 0, 255, 255, 255]}
        picture.putpalette(shown.get(colours, [255, 255, 255, 0, 0, 0]))
        picture.save(folder / "palette" / f"{number}.png")
    output = ingest(folder, masks=str(folder / "palette"))
    np.testing.assert_array_equal(read_mask(output / "masks", 2), MASKS[2])


def test_grey_with_alpha_is_read_by_the_alpha_that_varies(folder: Path) -> None:
    from PIL import Image

    for name, grey, alpha in (
        ("opaque", lambda m: m, lambda m: m * 0 + 255),
        ("alpha", lambda m: m * 0, lambda m: m),
    ):
        (folder / name).mkdir()
        for number, mask in enumerate(MASKS):
            Image.fromarray(np.dstack([grey(mask), alpha(mask)]), "LA").save(folder / name / f"{number}.png")
        output = ingest(folder, name=f"run {name}", masks=str(folder / name))
        np.testing.assert_array_equal(read_mask(output / "masks", 2), MASKS[2])


def test_somebody_who_fills_the_picture_is_not_inverted(folder: Path) -> None:
    full = [np.full((96, 128), 255, np.uint8) for _ in range(N)]
    for mask in full:
        mask[:10, :20] = 0
    write_images(folder / "full", full)
    output = ingest(folder, masks=str(folder / "full"))
    np.testing.assert_array_equal(read_mask(output / "masks", 1), full[1])


def test_soft_masks_stay_as_soft_as_they_are(folder: Path) -> None:
    soft = [cv2.GaussianBlur(mask, (0, 0), 3) for mask in MASKS]
    write_images(folder / "soft", soft)
    files = sorted((folder / "soft").iterdir())
    assert find_form(files) == MaskForm()
    np.testing.assert_array_equal(read_given_mask(files[0], *SIZE), soft[0])


@pytest.mark.parametrize(
    ("encode", "saying"),
    [
        (lambda m: m[:, :96], r"0\.png is 96x96, the frames have the proportions of 128x96"),
        (lambda m: np.ascontiguousarray(m.T), r"0\.png is 96x128.*turn it"),
        (lambda m: FRAMES[0], r"0\.png is (a picture in colours|mostly grey)"),
        (lambda m: np.random.default_rng(1).integers(60, 200, m.shape, np.uint8), r"0\.png is mostly grey"),
    ],
)
def test_what_is_no_mask_of_these_frames_is_refused_by_file(folder: Path, encode, saying: str) -> None:
    written(folder, encode)
    with pytest.raises(UserError, match=saying):
        ingest(folder, masks=str(folder / "encoded"))


def test_the_alpha_of_pictures_is_their_mask(folder: Path) -> None:
    cut = [rgba(frame, mask) for frame, mask in zip(FRAMES, MASKS, strict=True)]
    (folder / "cut").mkdir()
    for number, picture in enumerate(cut):
        cv2.imwrite(str(folder / "cut" / f"{number}.png"), picture[..., [2, 1, 0, 3]])
    output = ingest(folder, "cut", masks="auto")
    np.testing.assert_array_equal(read_mask(output / "masks", 3), MASKS[3])
    np.testing.assert_array_equal(read_frame(output / "frames", 3), FRAMES[3])
    assert read_footage(output / "footage.json").sources["masks"] == "the pictures' own alpha"
