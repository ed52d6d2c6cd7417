"""The rasterizer's benchmark, on a scene so small that its figures mean nothing."""

import json

import torch

from benchmarks import raster
from benchmarks.scenes import body_camera, body_scene
from pipeline.splat import render


def test_it_prints_a_table_and_a_headline_and_writes_every_time(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(raster, "_QUICK_SCENES", ((40, 24), (50, 24)))
    raster.main(["--quick", "--repeats", "2", "--json", str(tmp_path / "raster.json")])
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[:3] for line in lines[2:-1]] == [
        [count, "24²", name] for count in ("40", "50") for name in ("numba", "dense")
    ]
    assert lines[-1].startswith("raster: 50 Gaussians at 24²: ") and "dense takes" in lines[-1]
    timings = json.loads((tmp_path / "raster.json").read_text())["timings"]
    assert len(timings) == 4 and all(len(timing["forward"]) == 2 for timing in timings)


def test_what_does_not_fit_in_memory_is_not_run(monkeypatch, capsys):
    monkeypatch.setattr(raster, "_QUICK_SCENES", ((40, 24),))
    monkeypatch.setattr(raster, "_free_memory", lambda: 1000)
    raster.main(["--quick", "--repeats", "1"])
    assert "needs 0 GiB" in capsys.readouterr().out


def test_the_body_is_whole_in_the_image_and_opaque():
    rendering = render(body_scene(4000), body_camera(64))
    border = torch.cat([rendering.alpha[[0, -1]].flatten(), rendering.alpha[:, [0, -1]].flatten()])
    assert not border.any()
    assert rendering.alpha.max() > 0.99
    assert 0.1 < rendering.alpha.gt(0.5).float().mean() < 0.2
