"""A tiny subject for the animate stage: the open body with an awake avatar, as the stages publish it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import torch

from pipeline.avatar import Architecture, Avatar, save_avatar
from pipeline.body import mean_identity, read_poses
from pipeline.clip.keypoints import empty_keypoints, write_keypoints
from stages.animate.run import run
from stages.animate.settings import AnimateSettings
from tests.made.body import open_body
from tests.made.context import RecordedContext, stage_context
from tests.made.portrait import write_subject

SMALL = {"width": 48, "height": 64, "turntable_frames": 4, "turntable_fps": 8.0}


def awake_avatar(gated: bool = False) -> Avatar:
    """An avatar whose every head has a say; ``gated``: nothing below the waist was ever seen."""
    body = open_body()
    sizes = Architecture(
        plane_resolution=8, plane_channels=4, width=16, groups=4, residual_width=16, subdivisions=0,
        residual_parts=("face",),
    )  # fmt: skip
    avatar = Avatar(body, mean_identity(body), torch.arange(len(body.v_template)), sizes, seed=2).eval()
    generator = torch.Generator().manual_seed(1)
    for name, parameter in sorted(avatar.named_parameters()):
        amount = 0.3 if name.startswith("triplane") else 0.05
        parameter.data += amount * torch.randn(parameter.shape, generator=generator)
    avatar.base_color.copy_(2 * torch.sin(9 * body.v_template))
    if gated:
        avatar.gate(body.v_template[:, 1] > -0.2)
    return avatar


@dataclasses.dataclass(frozen=True)
class Studio:
    """Where the subject lies; ``animate`` runs the stage on it."""

    root: Path

    def animate(self, name: str = "out", loans=None, **settings) -> RecordedContext:
        settings = AnimateSettings(**{**SMALL, **settings})
        inputs = {stage: self.root / stage for stage in ("ingest", "fit", "train")}
        context = stage_context(
            "animate", settings, self.root / name, inputs, subject="doll", loans=loans or {}
        )
        run(context)
        return context


def make_studio(root: Path, gated: bool = False) -> Studio:
    """Writes the subject, and its avatar."""
    write_subject(root)
    (root / "train").mkdir()
    save_avatar(root / "train" / "avatar.safetensors", awake_avatar(gated))
    frames = read_poses(root / "fit" / "poses.parquet").frames
    write_keypoints(root / "ingest" / "keypoints.parquet", empty_keypoints(frames))
    return Studio(root)
