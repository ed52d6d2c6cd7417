"""The mannequin's random identity: betas, joint offsets and face offsets."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from pipeline.body import BodyModel, Identity, is_face, joint_index
from pipeline.body.eyes import with_eyeballs

BETA, BETA_LIMIT = 0.8, 1.8
JOINT_OFFSET = 0.006  # metres, standard deviation in each direction
FACE_OFFSET = 0.004  # metres, about the largest
_FACE_EDGE = 0.03  # metres over which the face's offsets fade out


def make_identity(body: BodyModel, seed: int) -> Identity:
    """A person of the body's family.

    Joint offsets are those of the large limbs, mirrored from left to right; face offsets are smooth,
    symmetric, and zero outside the face, as the method supposes them (sections 3.1 and A).
    Equal seeds give equal people.
    """
    rng = np.random.default_rng([seed, 2])
    betas = np.clip(rng.normal(0, BETA, body.shape_directions.shape[2]), -BETA_LIMIT, BETA_LIMIT)
    joint_offset = np.zeros((len(body.parents), 3))
    for part in ("hip", "knee", "ankle", "shoulder", "elbow", "wrist"):
        offset = rng.normal(0, JOINT_OFFSET, 3)
        joint_offset[joint_index(f"left_{part}")] = offset
        joint_offset[joint_index(f"right_{part}")] = offset * [-1, 1, 1]
    return with_eyeballs(
        body,
        Identity(
            torch.from_numpy(betas).float(), torch.from_numpy(joint_offset).float(), _face_offset(body, rng)
        ),
    )


def _face_offset(body: BodyModel, rng: np.random.Generator) -> Tensor:
    """[V, 3], metres: a few long waves through space, faded out towards the face's edge."""
    points = body.v_template.double().numpy()
    face = is_face(body).numpy()
    fade = np.clip(cKDTree(points[~face]).query(points)[0] / _FACE_EDGE, 0, 1) * face
    mirrored = points * [0, 1, 1] + np.abs(points[:, :1]) * [1, 0, 0]
    total = np.zeros_like(points)
    for _ in range(6):
        wave = rng.normal(0, 1, 3)
        wave *= 2 * np.pi / rng.uniform(0.06, 0.15) / np.linalg.norm(wave)
        total += rng.normal(0, 1, 3) * np.sin(mirrored @ wave + rng.uniform(0, 2 * np.pi))[:, None]
    total[:, 0] *= np.tanh(points[:, 0] / 0.01)  # sideways offsets mirror, and vanish on the midline
    return torch.from_numpy(total * (FACE_OFFSET / 4) * (fade * fade * (3 - 2 * fade))[:, None]).float()
