"""Damaged files of every kind but footage: read or refused in a line, no hang, nothing executed."""

from __future__ import annotations

import json
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.avatar import load_avatar, save_avatar
from pipeline.body import load_body, load_landmarks, mean_identity, read_poses
from pipeline.body.identity import read_identity
from pipeline.clip.camera import facing_camera
from pipeline.clip.keypoints import empty_keypoints, read_keypoints
from pipeline.clip.plan import read_plan
from pipeline.clip.records import read_cameras, read_footage, read_split
from pipeline.config.request import Request
from pipeline.config.subjects import load_subject
from pipeline.config.workspace import REPOSITORY, open_workspace
from pipeline.pose_files import read_smplx_json
from pipeline.pose_files.initial_poses import InitialPoses, read_initial_poses, write_initial_poses
from pipeline.run.job import check_settings, open_job
from pipeline.run.ray_batch import resources_of
from stages.fit.face.deca import read_flame_parameters
from stages.fit.face.flame_model import load_flame
from tests.made.body import BODY_FILE, BODY_FOLDER, open_body
from tests.made.damage import fuzz
from tests.made.faces import flame_arrays
from tests.made.motions import made_up, write_folder
from tests.made.portrait import moving_poses, painted_avatar
from tests.made.published import publish, simple_footage

pytestmark = pytest.mark.slow
FILES = 40  # of each kind


def check(outcomes: dict[str, int], capsys: pytest.CaptureFixture[str]) -> None:
    assert outcomes["refused"] > 0, outcomes  # else the damage is too little to tell anything
    assert "executed" not in capsys.readouterr().out


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("trained")
    poses, picture = moving_poses(), np.full((24, 32, 3), 90, np.uint8)
    fit = (open_body(), mean_identity(open_body()), poses)
    pictures = [(picture, picture[..., 0])] * len(poses)
    cameras = dict.fromkeys(poses.frames, facing_camera(32, 24, 30.0))
    footage = simple_footage(32, 24, 10.0, len(poses))
    publish(folder, pictures, cameras, fit, footage, keypoints=empty_keypoints(np.arange(len(poses))))
    (folder / "train").mkdir()
    poses = InitialPoses(
        frames=(0, 1), rotation=torch.zeros(2, 55, 3), expression=torch.zeros(2, 4), betas=torch.zeros(5),
        transl=torch.zeros(2, 3), valid=torch.ones(2, dtype=torch.bool), hands="flat",
    )  # fmt: skip
    write_initial_poses(folder / "ingest" / "initial_poses.safetensors", poses)
    save_avatar(folder / "train" / "avatar.safetensors", painted_avatar())
    return folder


def posed(path: Path) -> None:
    """An avatar that is read can be posed."""
    avatar = load_avatar(path, open_body())
    assert len(avatar) > 0 and avatar.eval() is avatar


PUBLISHED: dict[str, Callable[[Path], object]] = {
    "ingest/split.json": read_split,
    "ingest/footage.json": lambda path: read_footage(path).all_frames,
    "ingest/cameras.parquet": read_cameras,
    "ingest/keypoints.parquet": read_keypoints,
    "ingest/initial_poses.safetensors": read_initial_poses,
    "fit/poses.parquet": read_poses,
    "fit/identity.safetensors": lambda path: read_identity(path, open_body()),
    "plan/plan.json": read_plan,
    "train/avatar.safetensors": posed,
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_damaged_files_of_stages(tmp_path, capsys, trained: Path, name: str) -> None:
    check(fuzz(name, trained / name, PUBLISHED[name], tmp_path, FILES), capsys)


DEFINITIONS = {"subjects": "oliver", "presets": "quick", "datasets": "insta"}


@pytest.mark.parametrize("kind", DEFINITIONS)
def test_damaged_definitions(tmp_path, capsys, kind: str) -> None:
    """A subject's, a preset's and a dataset's TOML, as ``doit run`` reads them."""
    good, name = tmp_path / "data" / kind, DEFINITIONS[kind]
    good.mkdir(parents=True)
    shutil.copy(REPOSITORY / "data" / kind / f"{name}.toml", good / f"{name}.toml")

    def read(folder: Path) -> None:
        workspace = open_workspace(data=folder.parent)
        subject = name if kind == "subjects" else "me"
        source = None if kind == "subjects" else folder / f"{name}.toml"
        request = Request(
            workspace=workspace, subjects=(subject,), source=source,
            preset=name if kind == "presets" else "quick",
            datasets=(name,) if kind == "datasets" else (),
        )  # fmt: skip
        check_settings(request)
        resources_of(request)
        load_subject(workspace, subject, source, request.dataset)
        if source is not None:
            open_job(subject, request)

    check(fuzz(kind, good, read, tmp_path, FILES), capsys)


def test_damaged_pose_files(tmp_path, capsys) -> None:
    rotation, way = made_up(3)
    good = write_folder(tmp_path / "poses", rotation, way, torch.zeros(3).double(), BODY_FILE)
    read = lambda folder: read_smplx_json(folder, [4, 5, 6], torch.zeros(30, 3))  # noqa: E731
    check(fuzz("pose_init", good, read, tmp_path, FILES), capsys)


def test_damaged_flame_parameters(tmp_path, capsys) -> None:
    good = tmp_path / "flame_init"
    (good / "flame_params").mkdir(parents=True)
    (good / "shape_param.json").write_text(json.dumps([0.1] * 20))
    for frame in range(3):
        values = {"expr": [0.1] * 10, "jaw_pose": [0.1, 0, 0], "neck_pose": [0, 0, 0], "is_valid": True}
        (good / "flame_params" / f"{frame}.json").write_text(json.dumps(values))
    read = lambda folder: read_flame_parameters(folder, np.arange(3))  # noqa: E731
    check(fuzz("DECA", good, read, tmp_path, FILES), capsys)


@pytest.mark.parametrize("kind", ["npz", "pkl"])
def test_damaged_flame_model(tmp_path, capsys, kind: str) -> None:
    arrays = flame_arrays(open_body(), expressions=1)
    few = {"v_template": arrays["v_template"][:9], "shapedirs": arrays["shapedirs"][:9],
           "f": np.array([[0, 1, 2]], np.uint32), "J_regressor": arrays["J_regressor"][:, :9]}  # fmt: skip
    good = tmp_path / f"flame.{kind}"
    if kind == "npz":
        np.savez(good, **few)
    else:
        good.write_bytes(pickle.dumps(few))
    check(fuzz(f"FLAME {kind}", good, load_flame, tmp_path, FILES), capsys)


def test_damaged_landmarks(tmp_path, capsys) -> None:
    body = open_body()
    good = tmp_path / "body"
    good.mkdir()
    for file in BODY_FOLDER.glob("landmarks_*.npz"):
        shutil.copy(file, good)
    check(fuzz("landmarks", good, lambda folder: load_landmarks(body, folder), tmp_path, FILES), capsys)


def test_damaged_body_model(tmp_path, capsys) -> None:
    check(fuzz("body", BODY_FILE, lambda path: mean_identity(load_body(path)), tmp_path, 10), capsys)
