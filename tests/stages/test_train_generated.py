"""Training with generated frames beside captured ones."""

import dataclasses

import numpy as np
import pytest
import torch

from pipeline.body import Poses, read_poses, write_poses
from pipeline.clip.camera import Camera
from pipeline.clip.frames import write_frame, write_mask
from pipeline.clip.records import read_cameras, write_cameras
from pipeline.errors import UserError
from pipeline.files.json_files import write_json
from pipeline.files.tables import read_table
from stages.train import run as stage
from stages.train.generated import GeneratedFrames, read_generated
from stages.train.visibility_gate import SCHEMA
from tests.made.portrait import context_for, data_for

FIRST = 100_000


@pytest.fixture(scope="module")
def generated(subject, tmp_path_factory):
    """Three green frames of another size, of the subject turned by half, as auxiliary publishes them."""
    made, count = tmp_path_factory.mktemp("auxiliary"), 3
    for kind in ("frames", "masks", "trust"):
        (made / kind).mkdir(parents=True, exist_ok=True)
    poses = read_poses(subject / "fit" / "poses.parquet")
    camera: Camera = read_cameras(subject / "ingest" / "cameras.parquet")[0].resized(36, 48)
    rotation = poses.rotation[:count].clone()
    rotation[:, 0] = torch.tensor([0.0, torch.pi, 0.0])
    numbers = tuple(FIRST + k for k in range(count))
    write_poses(
        made / "poses.parquet", Poses(numbers, rotation, poses.expression[:count], poses.transl[:count])
    )
    write_cameras(made / "cameras.parquet", dict.fromkeys(numbers, camera))
    for frame in numbers:
        write_frame(made / "frames", frame, np.full((48, 36, 3), (0, 255, 0), np.uint8))
        write_mask(made / "masks", frame, np.full((48, 36), 255, np.uint8))
        write_mask(made / "trust", frame, np.full((48, 36), 255, np.uint8))
    write_json(made / "auxiliary.json", {"kept": count})
    return made


@pytest.fixture(scope="module")
def objective(subject, generated, tmp_path_factory):
    context = context_of(subject, generated, tmp_path_factory.mktemp("o") / "out", face=0.8, pose_change=1.0)
    return stage.build_trainer(data_for(context), context.settings).objective


def context_of(subject, generated, output, **changes):
    context = context_for(subject, output, **changes)
    return dataclasses.replace(context, inputs={**context.inputs, "auxiliary": generated})


def test_frames_have_their_own_size_camera_and_trust(subject, generated, tmp_path):
    data = data_for(context_of(subject, generated, tmp_path / "out"))
    view = data.view(FIRST)
    assert view.generated and view.color.shape == (48, 36, 3) and view.camera.width == 36
    assert view.trust is not None and bool((view.trust == 1).all())
    captured = data.view(0)
    assert not captured.generated and captured.trust is None and captured.color.shape != view.color.shape
    assert data.sources == (tuple(range(5)), (FIRST, FIRST + 1, FIRST + 2))


def test_poses_of_generated_frames_never_move(objective):
    drawn = [objective.draw(position).frame for position in range(20)]
    assert sum(frame >= FIRST for frame in drawn) == 4  # one in five
    assert str(FIRST) not in objective.poses.rotation and "0" in objective.poses.rotation
    position = next(k for k, frame in enumerate(drawn) if frame >= FIRST)
    terms = objective(position, 0, True)
    assert "face" not in terms and "pose_change" not in terms and torch.isfinite(sum(terms.values()))


def test_what_is_not_trusted_costs_nothing(objective, monkeypatch):
    position = next(k for k in range(20) if objective.draw(k).frame >= FIRST)
    trusted = objective(position, 0, False)
    read = GeneratedFrames.view

    def doubted(generated, frame):
        view = read(generated, frame)
        return dataclasses.replace(view, trust=torch.zeros_like(view.alpha))

    monkeypatch.setattr(GeneratedFrames, "view", doubted)
    untrusted = objective(position, 0, False)
    assert trusted["l1"].item() > 0.01 and untrusted["l1"].item() == pytest.approx(0, abs=1e-7)
    assert untrusted["ssim"].item() == pytest.approx(0, abs=1e-5)


def test_initial_colours_of_the_unseen_side_are_the_generated_ones(objective):
    with_them = objective.avatar
    back = with_them.surfaces[-1].canonical.frames[:, 2, 2] < -0.9
    colors = torch.sigmoid(with_them.base_color[back])
    assert (colors[:, 1] > 0.9).float().mean() > 0.3
    front = with_them.surfaces[-1].canonical.frames[:, 2, 2] > 0.9
    assert (torch.sigmoid(with_them.base_color[front])[:, 1] > 0.9).float().mean() < 0.2


def test_a_run_publishes_captured_poses_only_and_counts_apart(subject, generated, tmp_path):
    context = context_of(subject, generated, tmp_path / "out")
    stage.run(context)
    assert read_poses(context.output / "poses.parquet").frames == tuple(range(6))
    table = read_table(context.output / "visibility.parquet", SCHEMA, "")
    assert table["captured"].max() > 0 and table["generated"].max() > 0
    assert not np.array_equal(table["captured"], table["generated"])


def test_nothing_published_is_nothing_read(subject, tmp_path):
    poses = read_poses(subject / "fit" / "poses.parquet")
    assert read_generated(None, poses) is None and read_generated(tmp_path, poses) is None


def test_frames_of_another_fit_are_refused(subject, generated):
    poses = read_poses(subject / "fit" / "poses.parquet")
    other = Poses(poses.frames, poses.rotation, torch.zeros(len(poses), 9), poses.transl)
    with pytest.raises(UserError, match="another fit"):
        read_generated(generated, other)
