"""The GPU's benchmark: refused where there is none, and run on a pretended device."""

import dataclasses
import importlib
import json

import pytest
import torch

from benchmarks import gpu, step
from benchmarks.avatars import avatar_of
from pipeline.avatar import Architecture
from pipeline.clip.plan import read_plan
from pipeline.device import moved
from pipeline.splat import render
from stages.train import held_out, objective
from stages.train.settings import apply_plan
from tests.made.portrait import context_for, data_for
from tests.pretend_device import DEVICE, Elsewhere, pretend_device

SMALL = {"plane_resolution": 8, "plane_channels": 2, "width": 16, "groups": 4}


def drawn_elsewhere(gaussians, camera, backend="auto"):
    """Stands for gsplat where the Gaussians are on the pretended device."""
    if not isinstance(gaussians.means, Elsewhere):
        return render(gaussians, camera, backend)
    return moved(render(gaussians.to("cpu"), camera.to("cpu")), DEVICE)


@pytest.fixture
def elsewhere(monkeypatch):
    for module in (gpu, step, objective, held_out, importlib.import_module("pipeline.splat.render")):
        monkeypatch.setattr(module, "render", drawn_elsewhere)
    plain = torch.optim.Adam
    monkeypatch.setattr(torch.optim, "Adam", lambda *given, fused, **more: plain(*given, **more))
    monkeypatch.setattr(
        gpu, "avatar_of", lambda count: avatar_of(count, Architecture(**SMALL), half_precision=False)
    )


def mannequin(folder, output, representation):
    """Stands for the mannequin of ``fitted_mannequin``, which stages make in half a minute."""
    context = context_for(folder, output, representation=representation, face=0.0)
    settings = apply_plan(context.settings, read_plan(context.inputs["plan"] / "plan.json"))
    return data_for(context), dataclasses.replace(settings, **gpu.ALL_FROM_THE_START)


def test_without_a_gpu_it_says_so_in_a_line(monkeypatch, capsys):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert gpu.main(["--quick"]) == 1
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1 and "GPU" in said[0] and "nvidia-smi" in said[0]


def test_without_gsplat_it_names_the_command(monkeypatch, capsys):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(gpu.importlib.util, "find_spec", lambda name: None)
    assert gpu.main([]) == 1
    assert "pip install -e '.[gpu]'" in capsys.readouterr().err


@pytest.mark.slow
def test_on_a_pretended_device_both_agree_and_all_is_timed(elsewhere, subject, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(gpu, "require_gpu", lambda: DEVICE)
    monkeypatch.setattr(gpu, "fetch_assets", lambda job: None)
    monkeypatch.setattr(
        gpu, "fitted_mannequin", lambda words, name: mannequin(subject, tmp_path / name, name)
    )
    monkeypatch.setattr(
        gpu, "trained", lambda job, name: {"subject": "none", "representation": name, "wall s": 1.0}
    )
    monkeypatch.setattr(gpu, "BATCHES", (1, 2))
    monkeypatch.setattr(gpu, "QUICK_STEPS", 2)
    path = tmp_path / "gpu.json"
    with pretend_device():
        words = ["--quick", "--gaussians", "300", "--size", "32", "--json", str(path)]
        assert gpu.main(words) == 0
    assert "the devices agree" in capsys.readouterr().out.splitlines()[-1]
    tables = json.loads(path.read_text())
    assert [row["representation"] for row in tables["apart"]] == ["bases", "triplane"]
    for row in tables["apart"]:
        assert row["agree"] and row["Gaussians"] > 0 and row["each"]["poses"] < 0.05
    cases = {(row["representation"], row["what"], row["batch"]) for row in tables["times"]}
    kinds = (("step", 1), ("step", 2), ("frame", 1))
    assert cases == {(name, *kind) for name in gpu.REPRESENTATIONS for kind in kinds}
    assert len(tables["times"]) == 6 and all(row["ms"] > 0 for row in tables["times"])


def test_devices_that_differ_are_seen(elsewhere, subject, tmp_path, monkeypatch):
    """A renderer that is a little off on the other device alone."""
    data, settings = mannequin(subject, tmp_path / "out", "bases")

    def off(gaussians, camera, backend="auto"):
        rendering = drawn_elsewhere(gaussians, camera, backend)
        if not isinstance(gaussians.means, Elsewhere):
            return rendering
        return dataclasses.replace(rendering, color=0.9 * rendering.color)

    for module in (gpu, objective):
        monkeypatch.setattr(module, "render", off)
    with pretend_device():
        row = gpu.compare(data, settings, DEVICE, steps=1)
    assert not row["agree"] and row["picture"] > gpu.LIMITS["picture"]
    assert row["gradients"] > gpu.LIMITS["gradients"]
