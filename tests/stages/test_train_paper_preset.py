"""The paper preset's avatar at the real template's sizes: every term at once, on a tiny clip."""

import dataclasses
import math

import pytest
import torch

from pipeline.body import mean_identity
from pipeline.clip.camera import facing_camera
from pipeline.config.settings import read_toml
from pipeline.config.workspace import REPOSITORY
from pipeline.metrics import Lpips
from stages.train.data import read_training_data
from stages.train.objective import TERMS
from stages.train.run import build_trainer
from stages.train.settings import TrainSettings, apply_plan
from tests.made.plans import plan_of
from tests.made.portrait import FRAMES, HEIGHT, WIDTH, moving_poses, pictures
from tests.made.published import publish, simple_footage
from tests.made.smplx_sized import smplx_sized_body

STEPS = 4
PRESET = REPOSITORY / "data" / "presets" / "paper.toml"
SHORT = {  # the same phases within a few steps: all heads from the second, the gate after the third
    "iterations": STEPS, "residual_from": 0.25, "residual_ramp": 0.25, "gate_from": 0.75, "gate_every": 1,
    "held_out_every": 100, "checkpoint_every": 100, "skin_every": 2, "device": "cpu", "color_frames": 2,
}  # fmt: skip
NEVER_HERE = {"scale_shrink", "scale_growth", "pose_change"}  # without a weight in the preset


@pytest.mark.slow
def test_every_term_of_the_preset_at_smplx_sizes(tmp_path, assets_folder):
    if not (assets_folder / "lpips" / "vgg16.ckpt").is_file():
        pytest.skip("LPIPS's weights are not here")
    body, poses = smplx_sized_body(), moving_poses()
    poses = dataclasses.replace(poses, expression=0.1 * torch.ones(FRAMES, 50))
    cameras = dict.fromkeys(poses.frames, facing_camera(WIDTH, HEIGHT, 1.2 * HEIGHT))
    footage = simple_footage(WIDTH, HEIGHT, 10.0, FRAMES, start=0.5)
    fit = (body, mean_identity(body), poses)
    inputs = publish(tmp_path, pictures(), cameras, fit, footage, plan=plan_of())
    settings = apply_plan(TrainSettings(**{**read_toml(PRESET)["train"], **SHORT}), plan_of())
    data = read_training_data(inputs["ingest"], inputs["fit"], None, body, settings.crop_margin)
    trainer = build_trainer(data, settings, "cpu", Lpips(assets_folder / "lpips", settings.lpips_network))
    avatar = trainer.avatar
    assert len(avatar) == 167_390 and settings.lpips_network == "vgg"
    before = {name: value.clone() for name, value in avatar.state_dict().items()}
    seen: dict[str, float] = {}
    for _ in range(STEPS):
        seen |= trainer.step()
    assert set(seen) == {term.name for term in TERMS} - NEVER_HERE
    assert all(math.isfinite(value) for value in seen.values())
    after = avatar.state_dict()
    for name in (
        "representation.triplane.planes", "identity_change.betas", "identity_change.joint_offset",
        "opacity_logit", "representation.pose_geometry.last.weight",
        "representation.residuals.heads.face.last.weight",
    ):  # fmt: skip
        assert not torch.equal(before[name], after[name]), name
        assert bool(torch.isfinite(after[name]).all()), name
    assert bool((before["representation.triplane.planes"] == 0).all())
    assert 0 < len(avatar) < 167_390  # the gate has closed
    trainer.require_finite()
