"""The parts of the body that a frame shows: the counts that visibility scores are made of (Section 3.4).

A score v_i is the share of the frames that show vertex i; ``otsu_threshold.py`` finds the threshold under
which a vertex is gated.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pipeline.avatar.surface import Surface
from pipeline.body import Pose, joint_transforms
from pipeline.clip.camera import Camera, project, to_camera

NEAR = 0.2  # metres: what is nearer to the camera is not in the picture, as in the authors' release


def in_frame(camera: Camera, points: Tensor) -> Tensor:
    """True for points inside the picture and in front of the camera: [N, 3] world metres -> [N] bool."""
    pixels, depth = project(camera, points), to_camera(camera, points)[:, 2]
    size = torch.tensor([camera.width, camera.height], dtype=pixels.dtype, device=pixels.device)
    return (depth > NEAR) & ((pixels >= 0) & (pixels < size)).all(1)


@torch.no_grad()
def body_in_frame(surface: Surface, pose: Pose, camera: Camera) -> Tensor:
    """True for vertices of the posed body that lie in the picture, [N] bool.

    Expressions and offsets are left out: they move a vertex by less than its distance to the next.

    Args:
        surface: of an avatar.
        pose: of the body.
        camera: of the picture.
    """
    canonical = surface.canonical
    transforms = joint_transforms(pose.rotation[None], canonical.joints, canonical.parents)[0]
    return in_frame(camera, surface.skinning_tables.place(transforms, canonical.vertices, pose.transl)[0])
