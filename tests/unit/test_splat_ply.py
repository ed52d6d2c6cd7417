"""Gaussians to a .ply."""

import dataclasses

import numpy as np
import pytest
import torch

from pipeline.splat import Gaussians, render, write_ply
from tests.made.splat_scene import scene
from tests.ply_reader import read_ply

PROPERTIES = [
    *"x y z nx ny nz f_dc_0 f_dc_1 f_dc_2".split(),
    *(f"f_rest_{k}" for k in range(45)),
    *"opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split(),
]


def test_the_round_trip_renders_the_same_picture(tmp_path):
    gaussians, camera = scene(60, 40, 30, torch.float32)
    write_ply(tmp_path / "avatar.ply", gaussians)
    again = read_ply(tmp_path / "avatar.ply")
    assert torch.equal(again.means, gaussians.means)
    assert torch.allclose(render(again, camera).color, render(gaussians, camera).color, atol=1e-5)


def test_the_file_is_laid_out_as_viewers_expect(tmp_path):
    gaussians, _ = scene(5, 8, 8, torch.float32)
    write_ply(tmp_path / "avatar.ply", gaussians)
    header, body = (tmp_path / "avatar.ply").read_bytes().split(b"end_header\n", 1)
    lines = header.decode().splitlines()
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 5"]
    assert lines[3:] == [f"property float {name}" for name in PROPERTIES]
    first = dict(zip(PROPERTIES, np.frombuffer(body, "<f4")[:62].tolist(), strict=True))
    assert all(first[f"f_rest_{k}"] == 0 for k in range(45))
    assert first["scale_1"] == pytest.approx(np.log(gaussians.scales[0, 1]))
    assert 1 / (1 + np.exp(-first["opacity"])) == pytest.approx(gaussians.opacities[0].item())
    assert 0.5 + 0.28209479 * first["f_dc_2"] == pytest.approx(gaussians.colors[0, 2].item())
    unit = gaussians.quaternions[0] / gaussians.quaternions[0].norm()
    assert [first[f"rot_{k}"] for k in range(4)] == pytest.approx(unit.tolist())


@pytest.mark.parametrize(
    ("up", "axes"),
    [("y", [[1, 0, 0], [0, 1, 0], [0, 0, 1]]), ("-y", [[1, 0, 0], [0, -1, 0], [0, 0, -1]]),
     ("z", [[1, 0, 0], [0, 0, -1], [0, 1, 0]])],
)  # fmt: skip
def test_the_world_is_turned_to_the_axis_that_points_up(tmp_path, up, axes):
    """A camera turned with the world sees the same picture, so means and orientations were turned alike."""
    gaussians, camera = scene(60, 40, 30, torch.float32)
    write_ply(tmp_path / "avatar.ply", gaussians, up)
    again = read_ply(tmp_path / "avatar.ply")
    turn = torch.tensor(axes, dtype=torch.float32)
    assert torch.allclose(again.means, gaussians.means @ turn.T, atol=1e-6)
    sign = {"y": [0, 1, 0], "-y": [0, -1, 0], "z": [0, 0, 1]}[up]
    assert (turn @ torch.tensor([0.0, 1.0, 0.0])).tolist() == sign
    seen = dataclasses.replace(camera, rotation=camera.rotation @ turn.T.to(camera.rotation))
    assert torch.allclose(render(again, seen).color, render(gaussians, camera).color, atol=1e-4)


def test_the_ends_of_the_ranges_stay_finite(tmp_path):
    gaussians, camera = scene(4, 20, 20, torch.float32)
    edges = Gaussians(
        gaussians.means,
        gaussians.quaternions,
        gaussians.scales * torch.tensor([1.0, 0.0, 1.0]),
        gaussians.colors,
        torch.tensor([0.0, 1.0, 1.5, 0.5]),
    )
    write_ply(tmp_path / "avatar.ply", edges)
    again = read_ply(tmp_path / "avatar.ply")
    assert all(tensor.isfinite().all() for tensor in again.tensors())
    clamped = Gaussians(*edges.tensors()[:4], edges.opacities.clamp(max=1))
    assert torch.allclose(render(again, camera).color, render(clamped, camera).color, atol=1e-5)


def test_gaussians_that_cannot_be_drawn_are_left_out(tmp_path):
    gaussians, _ = scene(4, 8, 8, torch.float32)
    gaussians.means[1, 0] = float("nan")
    gaussians.quaternions[2] = 0
    write_ply(tmp_path / "avatar.ply", gaussians)
    assert torch.equal(read_ply(tmp_path / "avatar.ply").means, gaussians.means[[0, 3]])
