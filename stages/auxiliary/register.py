"""Registration of generated frames: a few steps from the driving pose to the keypoints that were found.

A generator follows its skeleton, but not to the pixel: heads sink, arms drift. Every frame's place, its
root and its body joints may move a little; identity and expression are the subject's, fingers the
driving pose's. All frames are fitted at once.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from torch import Tensor

from pipeline.body import (
    Landmarks,
    Poses,
    joint_transforms,
    linear_blend_skinning,
    locate,
    posed_joints,
    rest_joints,
    rest_vertices,
)
from pipeline.body.joints import BODY_POSE
from pipeline.clip.camera import Camera, project
from pipeline.clip.fitted_clip import FittedClip

POINTS = slice(0, 23)  # body and feet
STEPS, RATE = 120, 0.01
TRUSTED = 0.3
PRIOR_BODY, PRIOR_ROOT, PRIOR_PLACE = 4.0, 1.0, 4.0  # of squared radians and metres
SOFT = 2.0  # percent of the person's height, where an error begins to count linearly

MIRRORED = np.array([0, 2, 1, 4, 3, 6, 5, 8, 7, 10, 9, 12, 11, 14, 13, 16, 15, 20, 21, 22, 17, 18, 19])
"""The points of ``POINTS`` with left and right exchanged."""


def register(
    clip: FittedClip,
    landmarks: Landmarks,
    poses: Poses,
    cameras: list[Camera],
    found: np.ndarray,  # [T, 23, 3]
) -> Poses:
    """The poses, moved to the found keypoints.

    Args:
        poses: the T driving poses.
        found: pixels and scores, in the order of ``POINTS``.
    """
    points = landmarks.whole_body[POINTS]
    ids, compact = points.compact()
    joints = rest_joints(clip.body, clip.identity)
    rest = rest_vertices(clip.body, clip.identity)[ids]
    weights = clip.body.skinning_weights[ids]
    target, score = (
        torch.from_numpy(found[..., :2].copy()).float(),
        torch.from_numpy(found[..., 2].copy()).float(),
    )
    score = torch.where(score >= TRUSTED, score, 0.0)
    moved = {
        "root": torch.zeros(len(poses), 3, requires_grad=True),
        "body": torch.zeros(len(poses), BODY_POSE.stop - BODY_POSE.start, 3, requires_grad=True),
        "place": torch.zeros(len(poses), 3, requires_grad=True),
    }
    optimizer = torch.optim.Adam(moved.values(), lr=RATE)

    def posed() -> tuple[Tensor, Tensor]:
        rotation = poses.rotation.clone()
        rotation[:, 0] = rotation[:, 0] + moved["root"]
        rotation[:, BODY_POSE] = rotation[:, BODY_POSE] + moved["body"]
        return rotation, poses.transl + moved["place"]

    heights = _heights(found)
    for _ in range(STEPS):
        rotation, transl = posed()
        transforms = joint_transforms(rotation, joints, clip.body.parents)
        vertices = linear_blend_skinning(transforms, weights, rest) + transl[:, None]
        places = locate(
            compact, posed_joints(rotation, joints, clip.body.parents) + transl[:, None], vertices
        )
        pixels = torch.stack([project(camera, place) for camera, place in zip(cameras, places, strict=True)])
        error = 100 * (pixels - target).norm(dim=-1) / heights[:, None]
        data = score * torch.nn.functional.huber_loss(
            error, torch.zeros_like(error), reduction="none", delta=SOFT
        )
        prior = (
            PRIOR_ROOT * moved["root"].square().sum()
            + PRIOR_BODY * moved["body"].square().sum()
            + PRIOR_PLACE * moved["place"].square().sum()
        )
        optimizer.zero_grad()
        (data.sum(1) / score.sum(1).clamp_min(1)).sum().add(prior).backward()
        optimizer.step()
    with torch.no_grad():
        rotation, transl = posed()
    return dataclasses.replace(poses, rotation=rotation, transl=transl)


def _heights(found: np.ndarray) -> Tensor:
    """The height of the trusted points in each frame, pixels, at least 1: [T]."""
    tall = []
    for points in found:
        rows = points[points[:, 2] >= TRUSTED, 1]
        tall.append(max(1.0, float(np.ptp(rows))) if len(rows) else 1.0)
    return torch.tensor(tall)
