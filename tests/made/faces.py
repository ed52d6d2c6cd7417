"""Faces whose truth is known: the open body's face seen by a pinhole, and a head in FLAME's schema."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import roma
import torch

from pipeline.body import is_part, mean_identity, rest_joints
from pipeline.clip.camera import facing_camera
from stages.fit.camera_batch import CameraBatch, stack
from stages.fit.face.target import FaceModel

SIZE, FOCAL = 256, 500.0


@dataclasses.dataclass(frozen=True)
class FaceClip:
    """Face meshes [T, F, 3] of a person, their camera, and the truth behind them."""

    mesh: torch.Tensor
    views: CameraBatch
    neutral: torch.Tensor
    expression: torch.Tensor
    jaw: torch.Tensor
    orientation: torch.Tensor


def make_faces(model: FaceModel, count: int, noise: float, seed: int = 0) -> FaceClip:
    """Somebody with a face of their own who looks about, opens the mouth and smiles now and then.

    Args:
        model: the body's face.
        count: T.
        noise: pixels, standard deviation of x and y; z has three times as much and is exaggerated.
        seed: of person, motion and noise.
    """
    draw = torch.Generator().manual_seed(seed)
    phase = torch.linspace(0, 6.0, count)
    wave = torch.tensor([0.3, -0.5, 0.8]) * 40
    neutral = model.mean + 0.003 * torch.sin(model.mean @ wave[:, None] + torch.tensor([0.0, 1.0, 2.0]))
    expression = torch.zeros(count, model.expression.shape[2])
    expression[:, 0] = (1.5 * torch.sin(1.7 * phase)).clamp_min(0)
    expression[:, 2] = (1.2 * torch.sin(2.3 * phase + 1)).clamp_min(0)
    jaw = (0.3 * torch.sin(3.1 * phase)).clamp_min(0)
    turn = torch.stack([0.2 * torch.sin(phase), 0.5 * torch.sin(1.3 * phase), 0.1 * torch.cos(phase)], dim=1)
    orientation = roma.rotvec_to_rotmat(turn)
    shaped = neutral + (expression @ model.expression.flatten(0, 1).mT).unflatten(1, neutral.shape)
    swing = roma.rotvec_to_rotmat(torch.stack([jaw, 0 * jaw, 0 * jaw], dim=1))
    opened = (shaped - model.jaw_joint) @ swing.mT + model.jaw_joint
    weight = model.jaw_weight[:, None]
    world = ((1 - weight) * shaped + weight * opened) @ orientation.mT + torch.tensor([0.02, 0.0, -1.0])
    views = stack([facing_camera(SIZE, SIZE, FOCAL)] * count)
    in_camera = views.to_camera(world)
    depth = in_camera[..., 2:] - in_camera[..., 2:].mean(1, keepdim=True)
    mesh = torch.cat([views.to_pixels(in_camera), 1.15 * FOCAL * depth], dim=-1)
    mesh = mesh + noise * torch.tensor([1.0, 1.0, 3.0]) * torch.randn(mesh.shape, generator=draw)
    return FaceClip(mesh, views, neutral, expression, jaw, orientation)


def flame_arrays(body, expressions: int = 100, seed: int = 0) -> dict[str, np.ndarray]:
    """The open body's head as FLAME stores a head: elsewhere, turned a little, 10% smaller, other bases.

    Its expression k is 0.8 of the body's k plus 0.3 of the body's next one, so that what the body should
    make of it is known.
    """
    rng = np.random.default_rng(seed)
    chosen = is_part(body, "head", "face")
    kept = torch.nonzero(chosen)[:, 0]
    new = torch.full((len(chosen),), -1).scatter(0, kept, torch.arange(len(kept)))
    faces = new[body.faces]
    turn = roma.rotvec_to_rotmat(torch.tensor([0.05, -0.08, 0.03]))

    def placed(points: torch.Tensor) -> torch.Tensor:
        return 0.9 * points @ turn.mT + torch.tensor([0.01, -0.3, 0.02])

    template = placed(body.v_template[kept]).double().numpy()
    joints = placed(rest_joints(body, mean_identity(body))[[12, 15, 22, 23, 24]]).double().numpy()
    # Some weights that sum to one and give the joints: the smallest.
    lifted = np.concatenate([template, np.ones((len(template), 1))], axis=1)
    regressor = np.concatenate([joints, np.ones((5, 1))], axis=1) @ np.linalg.pinv(lifted)
    own = body.expression_directions[kept]
    mixed = 0.9 * torch.einsum("ab,vbk->vak", turn, 0.8 * own + 0.3 * own.roll(-1, dims=2)).numpy()
    directions = np.zeros((len(kept), 3, 300 + expressions))
    directions[..., 0] = 0.01 * template[:, :1] * rng.normal(size=3)
    directions[..., 300 : 300 + min(expressions, mixed.shape[2])] = mixed[..., :expressions]
    return {
        "v_template": template,
        "f": faces[(faces >= 0).all(1)].numpy().astype(np.uint32),
        "shapedirs": directions,
        "J_regressor": regressor,
    }


def write_deca(folder: Path, frames: Mapping[int, bool], shape: int = 10) -> Path:
    """DECA's files of frames, number -> whether a face was found; the expression grows with the number."""
    (folder / "flame_params").mkdir(parents=True)
    (folder / "shape_param.json").write_text(json.dumps([0.5] * shape))
    for frame, valid in frames.items():
        values = {"expr": [0.1 * frame] * 50, "jaw_pose": [0.2, 0.0, 0.0]} if valid else {}
        blank = dict.fromkeys(("root_pose", "neck_pose", "jaw_pose", "leye_pose", "reye_pose", "expr"))
        content = {**blank, **values, "is_valid": valid}
        (folder / "flame_params" / f"{frame}.json").write_text(json.dumps(content))
    return folder
