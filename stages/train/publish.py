"""The published files of the stage: the avatar, its poses, and the curve and visibility of its training."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
import torch

from pipeline.avatar import save_avatar
from pipeline.body import BodyModel, Identity, draw_mesh, rest_vertices, write_poses
from pipeline.clip.camera import facing_camera
from pipeline.clip.curves import Curve
from pipeline.clip.frames import write_png
from stages.train.frame_evidence import settle_unseen
from stages.train.gated_colors import color_unseen
from stages.train.loop import Trainer
from stages.train.visibility_gate import VisibilityGate, write_ungated

SIZE = 360  # pixels, of each of the two pictures
PAPER = 255


def publish(trainer: Trainer, curve: Curve, gate: VisibilityGate | None, output: Path) -> None:
    """Writes the finished avatar, its poses, curve and visibility.

    Args:
        trainer: that has taken its last step.
        curve: of its run.
        gate: the visibility gate, if there was one.
        output: the folder.
    """
    avatar, clip = trainer.avatar, trainer.data.clip
    evidence = settle_unseen(avatar, trainer.poses, trainer.data, trainer.settings)
    avatar.unseen = "base" if trainer.settings.unseen == "base" else "nothing"
    if avatar.unseen == "base":
        color_unseen(avatar)
    save_avatar(output / "avatar.safetensors", avatar)
    write_poses(output / "poses.parquet", trainer.poses.refined(clip.poses.frames))
    curve.write(output / "curve.parquet")
    if gate is None:
        write_ungated(output, len(clip.body.v_template), evidence)
    else:
        scores, kept = gate.write(output, evidence)
        write_png(output / "visibility.png", score_picture(clip.body, avatar.identity, scores, kept))


def score_picture(
    body: BodyModel,
    identity: Identity,
    scores: np.ndarray,  # [V] in [0, 1]
    kept: np.ndarray,  # [V] bool
) -> np.ndarray:
    """The rest pose from the front and from behind, coloured by visibility score; [360, 720, 3] uint8 RGB.

    Args:
        body: the body model.
        identity: the subject's.
        scores: of visibility.
        kept: the vertices that have a Gaussian in the end; the others are grey.
    """
    with torch.no_grad():
        vertices = rest_vertices(body, identity)
    colors = 255 * matplotlib.colormaps["viridis"](scores)[:, :3]
    colors[~kept] = 0.35 * colors[~kept] + 0.65 * 150
    low, high = vertices.amin(0), vertices.amax(0)
    middle, extent = (low + high) / 2, float((high - low)[:2].max())
    camera = facing_camera(SIZE, SIZE, 4.0 * SIZE)
    pictures = []
    for side in (1.0, -1.0):
        turned = (vertices - middle) * torch.tensor([side, 1.0, side])
        placed = turned - torch.tensor([0.0, 0.0, 4.2 * extent])
        blank = np.full((SIZE, SIZE, 3), PAPER, np.uint8)
        pictures.append(draw_mesh(blank, camera, placed, body.faces, colors))
    return np.concatenate(pictures, axis=1)
