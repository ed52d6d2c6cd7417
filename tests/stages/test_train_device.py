"""Training off the CPU: with plain torch in the kernels' place, and on a pretended device. No GPU is here."""

import importlib

import pytest
import torch

from pipeline.avatar import head as heads
from pipeline.avatar import holes, load_avatar, spared
from pipeline.avatar import skinning_tables as posing
from pipeline.body import Pose
from pipeline.clip import curves
from pipeline.device import moved
from pipeline.files.tables import read_table
from pipeline.splat import render
from stages.train import held_out, objective
from stages.train import run as stage
from tests.made.body import open_body
from tests.made.portrait import context_for, data_for, run_counted
from tests.pretend_device import DEVICE, Elsewhere, pretend_device

ALL_ON = {
    "pose_heads_from": 0.0, "residual_from": 0.0, "refine_from": 0.0, "half_precision": False, "batch": 2,
    "subdivisions": 1, "subdivide_from": 0.4, "skinning": "nearest",
    "skin_every": 3, "unseen": "base", "arm_color": 0.1, "hand_color": 0.1, "hand_normal": 0.1,
    "scale_size": 0.1, "pose_change": 0.1, "time_dropout": 0.5,
    "iterations": 6, "held_out_every": 3, "checkpoint_every": 2, "gate_threshold": 0.2, "gate_from": 0.3,
}  # fmt: skip
RENDERERS = (objective, held_out, holes, spared, importlib.import_module("pipeline.splat.render"))


def without_kernels(monkeypatch):
    for module in (posing, heads, importlib.import_module("pipeline.metrics.ssim")):
        monkeypatch.setattr(module, "kernels_serve", lambda tensor: False)


def steps(subject, output, count: int = 3) -> tuple[list[dict[str, float]], dict[str, torch.Tensor]]:
    """The loss terms of some steps, and the gradients of the last one."""
    context = context_for(subject, output, **ALL_ON)
    trainer = stage.build_trainer(data_for(context), context.settings)
    avatar = trainer.avatar
    generator = torch.Generator().manual_seed(5)
    for parameter in avatar.parameters():  # no head is silent
        parameter.data += 0.02 * torch.randn(parameter.shape, generator=generator)
    values = [trainer.step() for _ in range(count)]
    named = {**dict(avatar.named_parameters()), **dict(trainer.poses.named_parameters())}
    return values, {name: one.grad for name, one in named.items() if one.grad is not None}


@pytest.mark.slow
def test_steps_in_plain_torch_are_those_of_the_kernels(subject, tmp_path, monkeypatch):
    terms, gradients = steps(subject, tmp_path / "kernels")
    without_kernels(monkeypatch)
    plain_terms, plain_gradients = steps(subject, tmp_path / "plain")
    for ours, plain in zip(terms, plain_terms, strict=True):
        assert ours == pytest.approx(plain, rel=1e-3, abs=5e-6)  # 1 - SSIM is a difference of near ones
    assert gradients.keys() == plain_gradients.keys()
    networks = {"representation.triplane.planes", "representation.pose_geometry.first.weight"}
    assert networks <= gradients.keys()
    for name, ours in gradients.items():
        plain = plain_gradients[name]
        assert (ours - plain).norm() <= 1e-2 * plain.norm() + 1e-7, name


def rendered_on_the_cpu(gaussians, camera, backend="auto"):
    """Stands for gsplat: what the Gaussians' device shows, computed on the CPU."""
    assert isinstance(gaussians.means, Elsewhere) and isinstance(camera.rotation, Elsewhere)
    rendering = render(gaussians.to("cpu"), camera.to("cpu"))
    return moved(rendering, DEVICE)


def pretend(monkeypatch):
    monkeypatch.setattr(stage, "resolve", lambda word: DEVICE)
    for module in RENDERERS:
        monkeypatch.setattr(module, "render", rendered_on_the_cpu)
    plain = torch.optim.Adam
    monkeypatch.setattr(torch.optim, "Adam", lambda *given, fused, **more: plain(*given, **more))


def curve_of(output) -> dict[tuple[int, str], float]:
    rows = read_table(output / "curve.parquet", curves.SCHEMA, "")
    return {
        (step, name): value
        for step, name, value in zip(rows["iteration"], rows["name"], rows["value"], strict=True)
    }


@pytest.mark.slow
def test_a_run_elsewhere_leaves_nothing_on_the_cpu_and_is_the_same(subject, tmp_path, monkeypatch):
    here = context_for(subject, tmp_path / "here", **ALL_ON)
    stage.run(here)
    pretend(monkeypatch)
    there = context_for(subject, tmp_path / "there", **ALL_ON)
    with pretend_device():
        stage.run(there)
    ours, theirs = curve_of(here.output), curve_of(there.output)
    assert theirs == pytest.approx(ours, rel=2e-2)
    avatars = [load_avatar(one.output / "avatar.safetensors", open_body()) for one in (here, there)]
    assert all(tensor.device.type == "cpu" for tensor in avatars[1].state_dict().values())
    assert torch.equal(avatars[0].active, avatars[1].active)
    still = Pose(torch.zeros(55, 3), torch.zeros(5), torch.zeros(3))
    with torch.no_grad():
        colors = [avatar.gaussians(still).colors for avatar in avatars]
    torch.testing.assert_close(*colors, rtol=0, atol=0.03)


@pytest.mark.slow
def test_a_checkpoint_from_elsewhere_is_gone_on_from_on_the_cpu(subject, tmp_path, monkeypatch):
    pretend(monkeypatch)
    context = context_for(subject, tmp_path / "out", **ALL_ON)
    with pretend_device():
        run_counted(context, monkeypatch, kill_at=3)
    monkeypatch.undo()
    assert run_counted(context, monkeypatch) == list(range(2, 6))
    assert (context.output / "avatar.safetensors").exists()


def test_the_pretended_device_refuses_what_cuda_refuses():
    with pretend_device() as device:
        values = torch.ones(3, device=device)
        assert float((2 * values * torch.tensor(2.0)).sum()) == 12
        with pytest.raises(RuntimeError, match="left on the CPU"):
            values + torch.ones(3)
        with pytest.raises((RuntimeError, TypeError)):
            values.numpy()
