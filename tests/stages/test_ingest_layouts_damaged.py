"""Damaged and hostile datasets: one line that names the file, before anything is published."""

from __future__ import annotations

import json
import os
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest

from pipeline.errors import UserError
from stages.ingest.datasets import LAYOUTS, layout_of, open_recording
from stages.ingest.settings import IngestSettings
from tests.made import layouts as writers
from tests.made.layout_footage import COUNT, footage

WRITERS = {
    "neuman": lambda folder, shown: writers.neuman(folder, shown, 0.4, True),
    "prepared": lambda folder, shown: writers.prepared(folder, shown, {"all": list(range(COUNT))}),
    "zju": lambda folder, shown: writers.zju(folder, shown, np.zeros(5)),
    "wildavatar": writers.wildavatar,
    "talkshow": writers.talkshow,
    "insta": writers.insta,
    "xhumans": writers.xhumans,
    "persona": writers.persona,
    "pose2sim": writers.pose2sim,
}
SETTINGS = {"zju": {"camera_name": "0"}}


@pytest.fixture(scope="module")
def shown():
    return footage()


@pytest.fixture(params=sorted(WRITERS))
def layout(request, tmp_path, shown):
    return request.param, WRITERS[request.param](tmp_path / "folder", shown)


def read(name: str, folder: Path):
    return open_recording(folder, IngestSettings(**SETTINGS.get(name, {})))


def test_every_layout_is_recognised_and_has_a_writer(layout):
    name, folder = layout
    assert layout_of(folder) == name and read(name, folder).layout == name
    assert set(LAYOUTS) == {*WRITERS, "plain"}


def change_json(path: Path, change) -> None:
    value = json.loads(path.read_text())
    change(value)
    path.write_text(json.dumps(value))


class Evil:
    def __reduce__(self):
        return os.system, ("touch /tmp/flexiavatar-was-here",)


def spoil_npy(path: Path, change) -> None:
    value = np.load(path, allow_pickle=True).item()
    change(value)
    np.save(path, value, allow_pickle=True)


def spoil_pickle(path: Path, change) -> None:
    value = pickle.loads(path.read_bytes())
    change(value)
    path.write_bytes(pickle.dumps(value))


def fitted(folder: Path, name: str) -> Path:
    return folder / "smplx_optimized" / name


def put(folder: Path, name: str, text: str) -> None:
    (folder / name).write_text(text)


def text_heads(folder: Path, text: str) -> None:
    """Expressions as text files in the place of the tracker's, one of which says ``text``."""
    shutil.rmtree(folder / "checkpoint")
    for number in range(1, COUNT + 1):
        path = folder / "flame" / "exp" / f"{number:05d}.txt"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text if number == 3 else "0.5\n" * 100)


FAULTS = {  # (layout, file that must be named) -> what is done to the folder
    ("insta", "transforms.json"): lambda f: change_json(
        f / "transforms.json", lambda v: v["frames"][1].update(file_path="../../../etc/passwd1.png")
    ),
    ("insta", "transforms.json names no"): lambda f: change_json(
        f / "transforms.json", lambda v: v.update(frames=[])
    ),
    ("insta", "00003.txt"): lambda f: text_heads(f, "one two"),
    ("insta", "transforms_test.json"): lambda f: (f / "transforms_test.json").write_text('{"frames": 3}'),
    ("insta", "00002.frame"): lambda f: (f / "checkpoint" / "00002.frame").write_bytes(pickle.dumps(Evil())),
    ("wildavatar", "metadata.json"): lambda f: change_json(
        f / "metadata.json", lambda v: v["000001"].update(poses=[0.0] * 71)
    ),
    ("zju", "annots.npy"): lambda f: spoil_npy(
        f / "annots.npy", lambda v: v["ims"][0].update(ims=["../../x/0.jpg"] * 3)
    ),
    ("zju", "5.npy"): lambda f: spoil_npy(f / "smpl_params" / "5.npy", lambda v: v.pop("Th")),
    ("neuman", "train_split.txt"): lambda f: (f / "train_split.txt").write_text("../../00001.png\n"),
    ("neuman", "sparse"): lambda f: (f / "sparse" / "images.txt").write_text("1 2 three\n"),
    ("neuman", "shape_param.json"): lambda f: fitted(f, "shape_param.json").write_text("[NaN]"),
    ("prepared", "joint_offset.json"): lambda f: fitted(f, "joint_offset.json").write_text("[1]"),
    ("prepared", "frame_list_all.txt"): lambda f: (f / "frame_list_all.txt").write_text("one\n"),
    ("prepared", "2.json"): lambda f: change_json(
        f / "cam_params" / "2.json", lambda v: v.update(R=[[1, 2, 3]] * 3)
    ),
    ("talkshow", ".pkl"): lambda f: spoil_pickle(
        f / "212-00_00_00.pkl", lambda v: v.update(global_orient=np.zeros((2, 3)))
    ),
    ("xhumans", "cameras.npz"): lambda f: np.savez(
        f / "render" / "cameras.npz", intrinsic=np.eye(3), extrinsic=np.zeros((3, 3))
    ),
    ("xhumans", "mesh-f00003_smplx.pkl"): lambda f: spoil_pickle(
        f / "SMPLX" / "mesh-f00003_smplx.pkl", lambda v: v.pop("transl")
    ),
    ("persona", "frame_idx_list.txt"): lambda f: put(f / "captured", "frame_idx_list.txt", "1e9\n"),
    ("pose2sim", "Calib.toml"): lambda f: put(f / "calibration", "Calib.toml", "[cam_01]\nmatrix = 3\n"),
}  # fmt: skip


@pytest.mark.parametrize("name, file", sorted(FAULTS))
def test_a_damaged_file_names_itself(tmp_path, shown, name, file):
    folder = WRITERS[name](tmp_path / "folder", shown)
    FAULTS[name, file](folder)
    with pytest.raises(UserError) as caught:
        read(name, folder)
    assert file in str(caught.value) and "\n" not in str(caught.value)
    assert not Path("/tmp/flexiavatar-was-here").exists()


def test_what_is_no_dataset_is_said(tmp_path):
    (tmp_path / "notes.txt").write_text("nothing here")
    with pytest.raises(UserError, match="holds no pictures"):
        open_recording(tmp_path, IngestSettings())
    with pytest.raises(UserError, match="does not exist"):
        open_recording(tmp_path / "gone", IngestSettings())
    for name in LAYOUTS:
        with pytest.raises(UserError):
            open_recording(tmp_path, IngestSettings(layout=name))


def test_settings_that_are_for_one_camera(tmp_path, shown):
    folder = writers.zju(tmp_path / "folder", shown, np.zeros(5))
    with pytest.raises(UserError, match="is for one camera"):
        open_recording(folder, IngestSettings(camera_name="0", test_cameras=("others",), cameras="pinhole"))
    with pytest.raises(UserError, match="cameras 0 to 2"):
        open_recording(folder, IngestSettings(camera_name="7"))
