"""The rasterizer's benchmark, on a scene so small that its figures mean nothing."""

import json

import torch

from benchmarks import raster
from benchmarks.scenes import body_camera, body_scene
from pipeline.splat import render


def test_it_prints_a_table_and_a_headline_and_writes_every_time(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(raster, "QUICK_SCENES", ((40, 24), (50, 24)))
    assert raster.main(["--quick", "--repeats", "2", "--json", str(tmp_path / "raster.json")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1].startswith("raster: 50 Gaussians at 24²: ") and "dense takes" in lines[-1]
    rows = json.loads((tmp_path / "raster.json").read_text())["rows"]
    found = [(row["gaussians"], row["size"], row["backend"]) for row in rows]
    assert found == [(count, 24, name) for count in (40, 50) for name in ("numba", "dense")]
    assert all(len(row["forward"]) == len(row["backward"]) == 2 for row in rows)
    assert sum(line.startswith("| 40 ") or line.startswith("| 50 ") for line in lines) == 4


def test_what_does_not_fit_in_memory_is_not_run(monkeypatch, capsys):
    monkeypatch.setattr(raster, "QUICK_SCENES", ((40, 24),))
    monkeypatch.setattr(raster, "free_memory", lambda: 0.0)
    raster.main(["--quick", "--repeats", "1"])
    assert "needs 0 GiB" in capsys.readouterr().out


def test_the_body_is_whole_in_the_image_and_opaque():
    rendering = render(body_scene(4000), body_camera(64))
    border = torch.cat([rendering.alpha[[0, -1]].flatten(), rendering.alpha[:, [0, -1]].flatten()])
    assert not border.any()
    assert rendering.alpha.max() > 0.99
    assert 0.1 < rendering.alpha.gt(0.5).float().mean() < 0.2
