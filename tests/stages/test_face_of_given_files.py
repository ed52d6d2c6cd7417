"""The face's losses on the paper's own inputs: files of 133 points, and fits that came with the footage.

Ingest, fit, plan and a few steps of training, each stage's own run, under the paper preset's settings of the
face. Without them lambda_face and L_sface would vanish, and only a number in a log would say so.
"""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from pipeline.clip.curves import read_curve
from pipeline.clip.keypoints import read_keypoints
from pipeline.clip.plan import read_plan, write_plan
from pipeline.config.settings import read_toml
from pipeline.config.workspace import REPOSITORY
from stages.fit.run import run as run_fit
from stages.fit.settings import FitSettings
from stages.ingest.run import run as run_ingest
from stages.plan.run import run as run_plan
from stages.plan.settings import PlanSettings
from stages.train.run import run as run_train
from stages.train.settings import TrainSettings
from tests.made import layouts
from tests.made.context import stage_context
from tests.made.layout_footage import COUNT, footage
from tests.made.plans import plan_of
from tests.made.videos import ingest_context

PRESET = read_toml(REPOSITORY / "data" / "presets" / "paper.toml")
STEPS = 3
SMALL = {
    "iterations": STEPS, "subdivisions": 0, "plane_channels": 4, "plane_resolution": 16, "width": 16,
    "residual_width": 16, "lpips": 0.0, "residual_from": 0.4, "residual_ramp": 0.0, "gate": False,
    "held_out_every": STEPS, "held_out_frames": 1, "checkpoint_every": 100, "device": "cpu", "threads": 1,
}  # fmt: skip

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def shown():
    return footage("head")


def followed(folder, source, ingest, fit):
    """The four stages; returns the context of each by its name."""
    contexts = {"ingest": ingest_context(folder / "ingest", source, **ingest)}
    run_ingest(contexts["ingest"])
    outputs = {"ingest": contexts["ingest"].output}
    chosen = {
        "fit": (run_fit, FitSettings(**{**PRESET["fit"], **fit})),
        "plan": (run_plan, PlanSettings(**PRESET["plan"])),
        "train": (run_train, TrainSettings(**{**PRESET["train"], **SMALL})),
    }
    for name, (run, settings) in chosen.items():
        contexts[name] = stage_context(name, settings, folder / name, dict(outputs))
        run(contexts[name])
        outputs[name] = contexts[name].output
    return contexts


def says(context, pattern):
    """What a pattern's group matched in the line of the log that it is in."""
    found = [re.search(pattern, line) for line in context.logged]
    return [match[1] for match in found if match]


def require_face_loss(contexts):
    """The face loss has its weight in the log, and a value in every point of the curve."""
    plan = read_plan(contexts["plan"].output / "plan.json")
    assert plan.on("face_registration") and plan.on("face_loss")
    assert says(contexts["train"], r"^objective: .*\bface ([\d.]+)") == ["0.8"]
    curve = read_curve(contexts["train"].output / "curve.parquet", "run training again")
    values = np.array([value for _, value in curve["face"]])
    assert len(values) and np.isfinite(values).all() and (values > 0).all()


def require_named(contexts):
    """What the preset asks for and cannot have here stands in the log, with what to write."""
    assert says(contexts["fit"], r"(fit\.flame_model)")
    assert says(contexts["fit"], r"^fits 16 betas .*(all that the body has)")
    assert says(contexts["plan"], r"^set, not decided by the clip: .*(face loss)")
    assert says(contexts["train"], r"^(no scene|scene)") and says(contexts["train"], r"^computes on (cpu)")
    assert says(contexts["train"], r"^learns from \d+ captured and (\d+) generated") == ["0"]


def require_named_without_face_loss(trained, folder):
    """Where the plan has none of it, the log says that lambda_face does nothing."""
    plan = folder / "other" / "plan"
    plan.mkdir(parents=True)
    write_plan(plan / "plan.json", plan_of(face_loss=False))
    inputs = {**trained.inputs, "plan": plan}
    context = stage_context("train", trained.settings, folder / "other" / "train", inputs)
    run_train(context)
    assert says(context, r"^no face loss, though train.face is ([\d.]+)") == ["0.8"]
    assert not says(context, r"^objective: .*\bface ([\d.]+)")
    assert "face" not in read_curve(context.output / "curve.parquet", "run training again")


def test_files_of_133_points_alone(tmp_path, shown):
    folder, take = tmp_path / "clip", shown.still
    names = [f"{row}.png" for row in range(COUNT)]
    layouts.pictures(folder / "frames", take.images, names)
    layouts.pictures(folder / "masks", take.masks, names)
    layouts.keypoint_files(folder / "points", take.keypoints, range(COUNT))
    given = {"keypoints": str(folder / "points"), "masks": str(folder / "masks")}
    contexts = followed(tmp_path, folder / "frames", given, {"iterations": 30})
    found = read_keypoints(contexts["ingest"].output / "keypoints.parquet")
    assert not found.face_mesh.any() and not found.hands.any()
    assert says(contexts["fit"], r"face first \((\w+)\): fitted") == ["points"]
    sface = says(contexts["fit"], r"^objective in the end: .*\bsface ([\d.e+-]+)")
    assert len(sface) == 1 and float(sface[0]) > 0
    require_face_loss(contexts)
    require_named(contexts)


def test_fits_that_came_with_the_footage(tmp_path, shown):
    every = list(range(COUNT))
    lists = {"all": every, "train": every[:-1], "test": every[-1:]}
    source = layouts.prepared(tmp_path / "me", shown, lists)
    contexts = followed(tmp_path, source, {}, {"given": "keep"})
    record = json.loads((contexts["fit"].output / "face.json").read_text(encoding="utf-8"))
    assert record == {"source": "given", "frames": COUNT, "registered": COUNT}
    require_face_loss(contexts)
    require_named_without_face_loss(contexts["train"], tmp_path)
