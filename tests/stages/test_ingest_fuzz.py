"""Damaged footage and damaged files beside it: ingested or refused in a line, no hang, nothing executed."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from pipeline.clip.camera import facing_camera
from pipeline.clip.records import read_cameras, read_footage, read_split, write_cameras
from stages.ingest.datasets import open_recording
from stages.ingest.run import run
from stages.ingest.settings import IngestSettings
from stages.ingest.video import open_clip, read_clip
from tests.made.damage import fuzz
from tests.made.layout_footage import footage
from tests.made.videos import ingest_context, walking_blob, write_images
from tests.stages.test_given_detections import CLIPS, FORMS, scattered
from tests.stages.test_ingest_cameras import _QUALISYS, write_colmap, write_json_cameras
from tests.stages.test_ingest_layouts_damaged import SETTINGS, WRITERS
from tests.stages.test_ingest_rig_files import TABLES

pytestmark = pytest.mark.slow
FILES = 40  # of each kind
FEW = 3  # frames
FRAMES, MASKS = walking_blob(FEW)
NUMBERS = range(FEW)


def write_good(folder: Path, form: Callable[[np.ndarray], object] = FORMS["a list"]) -> Path:
    """frames/, masks/ and keypoints/ of three frames of 128 x 96."""
    write_images(folder / "frames", FRAMES)
    write_images(folder / "masks", MASKS)
    (folder / "keypoints").mkdir()
    for number in NUMBERS:
        (folder / "keypoints" / f"{number:04d}.json").write_text(json.dumps(form(scattered(number))))
    return folder


def ingest(folder: Path, **given: object) -> None:
    """The whole stage, and what it published is whole."""
    parts = {"keypoints": str(folder / "keypoints"), "masks": str(folder / "masks"), **given}
    shutil.rmtree(folder.parent / "run", ignore_errors=True)
    context = ingest_context(folder.parent / "run", folder / "frames", **parts)
    run(context)
    frames = read_split(context.output / "split.json")
    kept = sorted((*frames.train, *frames.test))
    assert sorted(read_cameras(context.output / "cameras.parquet")) == kept
    assert read_footage(context.output / "footage.json").kept == len(kept)


def check(outcomes: dict[str, int], capsys: pytest.CaptureFixture[str]) -> None:
    assert outcomes["refused"] > 0, outcomes  # else the damage is too little to tell anything
    assert "executed" not in capsys.readouterr().out


@pytest.mark.parametrize("form", FORMS)
def test_damaged_keypoints_of_a_frame(tmp_path, capsys, form: str) -> None:
    good = write_good(tmp_path / "good", FORMS[form])
    check(fuzz(f"keypoints {form}", good, ingest, tmp_path, 12, ["keypoints/*"]), capsys)


@pytest.mark.parametrize("form", CLIPS)
def test_damaged_keypoints_of_a_clip(tmp_path, capsys, form: str) -> None:
    good = write_good(tmp_path / "good")
    content = CLIPS[form]()
    few = dict(list(content.items())[:FEW]) if "table" in form else content
    if isinstance(few, list):
        few = few[:FEW]
    elif "instance_info" in few:
        few["instance_info"] = few["instance_info"][:FEW]
    shutil.rmtree(good / "keypoints")
    (good / "keypoints").mkdir()
    (good / "keypoints" / "results.json").write_text(json.dumps(few))
    check(fuzz(f"clip {form}", good, ingest, tmp_path, 12, ["keypoints/*"]), capsys)


def palette(mask: np.ndarray) -> Image.Image:
    picture = Image.fromarray((mask > 127).astype(np.uint8), "P")
    picture.putpalette([0, 0, 0, 200, 30, 30])
    return picture


PICTURES: dict[str, Callable[[Path, np.ndarray], object]] = {
    ".png": lambda path, mask: Image.fromarray(mask).save(path),
    ".jpg": lambda path, mask: Image.fromarray(mask).save(path, quality=90),
    "palette.png": lambda path, mask: palette(mask).save(path),
    "alpha.png": lambda path, mask: Image.fromarray(np.dstack([mask] * 4)).save(path),
    "16.png": lambda path, mask: cv2.imwrite(str(path), mask.astype(np.uint16) * 257),
    ".webp": lambda path, mask: Image.fromarray(mask).save(path),
    ".bmp": lambda path, mask: Image.fromarray(mask).save(path),
    ".tiff": lambda path, mask: Image.fromarray(mask).save(path),
}


@pytest.mark.parametrize("kind", PICTURES)
@pytest.mark.parametrize("folder", ["masks", "frames"])
def test_damaged_pictures(tmp_path, capsys, kind: str, folder: str) -> None:
    good = write_good(tmp_path / "good")
    shutil.rmtree(good / folder)
    (good / folder).mkdir()
    name = kind.replace("alpha", "").replace("palette", "").replace("16", "")
    for number in NUMBERS:
        PICTURES[kind](good / folder / f"{number:04d}{name}", MASKS[number])
    outcomes = fuzz(f"{folder} {kind}", good, ingest, tmp_path, 15, [f"{folder}/*"])
    if kind not in (".bmp", ".tiff"):  # in which most bytes are pixels
        check(outcomes, capsys)


def write_qualisys(folder: Path) -> None:
    text = _QUALISYS.format(k1="0.0").replace('right="107"', 'right="135"').replace('"199"', '"95"')
    (folder / "rig.qca.txt").write_text(text)


def write_toml(folder: Path) -> None:
    body = (
        "size = [128, 96]\nmatrix = [[150, 0, 60], [0, 151, 50], [0, 0, 1]]\n"
        "distortions = [-0.2, 0.05, 0.001, -0.002]\nrotation = [1.2, -0.4, 0.3]\n"
        "translation = [0.1, 0.2, 3.0]"
    )
    (folder / "rig.toml").write_text(TABLES["a table a camera"].format(body=body))


def write_own(folder: Path) -> None:
    camera = facing_camera(128, 96, 150.0).to(torch.float64)
    write_cameras(folder / "cameras.parquet", dict.fromkeys(NUMBERS, camera))


CALIBRATIONS: dict[str, tuple[Callable[[Path], object], str, dict[str, object]]] = {
    "COLMAP text": (lambda f: write_colmap(f, [f"{n:04d}.png" for n in NUMBERS]), "", {}),
    "COLMAP binary": (lambda f: write_colmap(f, [f"{n:04d}.png" for n in NUMBERS], True), "", {}),
    "COLMAP distorted": (
        lambda f: write_colmap(f, [f"{n:04d}.png" for n in NUMBERS], model="OPENCV"), "", {}
    ),
    "cam_params": (lambda f: write_json_cameras(f, [f"{n}" for n in NUMBERS]), "", {}),
    "Qualisys": (write_qualisys, "rig.qca.txt", {"camera_name": "A"}),
    "TOML": (write_toml, "rig.toml", {}),
    "cameras.parquet": (write_own, "cameras.parquet", {}),
}  # fmt: skip


@pytest.mark.parametrize("kind", CALIBRATIONS)
def test_damaged_cameras(tmp_path, capsys, kind: str) -> None:
    good = write_good(tmp_path / "good")
    write, name, settings = CALIBRATIONS[kind]
    (good / "cameras").mkdir()
    write(good / "cameras")

    def read(folder: Path) -> None:
        ingest(folder, cameras=str(folder / "cameras" / name), camera_scale=1.0, **settings)

    check(fuzz(f"cameras {kind}", good, read, tmp_path, FILES, ["cameras/*"]), capsys)


@pytest.mark.parametrize("name", sorted(WRITERS))
def test_damaged_datasets(tmp_path, capsys, name: str) -> None:
    """Every file of a dataset's layout, pictures and videos left alone: they have tests of their own."""
    WRITERS[name](tmp_path / "good", footage())
    kinds = [f"**/*{kind}" for kind in (".json", ".npy", ".npz", ".pkl", ".frame", ".txt", ".toml", ".bin")]
    settings = IngestSettings(**SETTINGS.get(name, {}), layout=name)
    read = lambda folder: open_recording(folder, settings)  # noqa: E731
    check(fuzz(f"dataset {name}", tmp_path / "good", read, tmp_path, FILES, kinds), capsys)


CODECS = {"mp4": "libx264", "mkv": "libx264", "webm": "libvpx-vp9", "avi": "mpeg4", "mov": "mjpeg"}


@pytest.mark.parametrize("container", CODECS)
def test_damaged_videos(tmp_path, capsys, container: str) -> None:
    good = tmp_path / f"clip.{container}"
    with av.open(str(good), "w") as file:
        stream = file.add_stream(CODECS[container], 25)
        stream.height, stream.width = 96, 128
        stream.pix_fmt = "yuvj420p" if container == "mov" else "yuv420p"
        for image in walking_blob(6)[0]:
            file.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        file.mux(stream.encode())

    def read(path: Path) -> None:
        for frame in read_clip(open_clip(path), damaged="skip"):
            assert frame.image.dtype == np.uint8

    check(fuzz(f"video {container}", good, read, tmp_path, FILES), capsys)
