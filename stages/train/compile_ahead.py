"""The kernels of training, compiled by one step on a tiny picture (``Stage.compile_ahead``).

What is called here is what training and the evaluation after it call, so that the kernels are compiled for
the types that they really get. The mesh is the repository's: types do not depend on the body model.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from pipeline.avatar import Architecture, Avatar, ClipConditions, pose_features
from pipeline.avatar.bake import bake
from pipeline.avatar.density import project_surface
from pipeline.body import Pose, draw_mesh, load_body, mean_identity
from pipeline.clip.camera import Camera, facing_camera
from pipeline.config.workspace import open_workspace
from pipeline.metrics import ssim_loss
from pipeline.splat import picture_sums, render

SIDE = 16  # pixels
TRANSL = (0.0, 0.4, -3.0)  # metres: before the camera


def compile_bases() -> None:
    """Compiles what ``train.representation=bases`` calls."""
    take_step(Architecture(representation="bases", bases=1, subdivisions=0))


def compile_triplane() -> None:
    """Compiles what ``train.representation=triplane`` calls."""
    small = Architecture(
        plane_resolution=4, plane_channels=2, width=16, groups=2, residual_width=16, subdivisions=0,
        residual_parts=("face",),
    )  # fmt: skip
    take_step(small)


def take_step(sizes: Architecture) -> None:
    """Poses an avatar, draws it, compares and goes back; then poses it as a finished avatar is posed."""
    body = load_body(open_workspace().body_file)
    avatar = Avatar(body, mean_identity(body), torch.arange(len(body.v_template)), sizes)
    rotation, expression = 0.01 * torch.ones(2, 55, 3), torch.zeros(2, body.expression_directions.shape[-1])
    rotation[1] *= 2  # bases need a clip that moves
    theta = torch.stack([pose_features(one) for one in rotation])
    avatar.representation.set_clip(ClipConditions(theta, expression, (0.0, 1.0)))
    pose, camera = Pose(rotation[0], expression[0], torch.tensor(TRANSL)), facing_camera(SIDE, SIDE, SIDE)
    project_surface(avatar.surface(), [(pose, camera)])  # normals, as for the density and the evidence
    for rows in (None, torch.arange(100)):  # of all Gaussians, and of those that a frame shows
        learn(avatar, pose, camera, rows)
    with torch.no_grad():
        baked = bake(avatar.eval())
        for animate in (avatar.gaussians, baked.gaussians):
            render(animate(pose, 0.5), camera)
        picture_sums(baked.gaussians(pose), camera, torch.zeros(SIDE, SIDE, 4))  # as evidence asks them


def learn(avatar: Avatar, pose: Pose, camera: Camera, rows: Tensor | None) -> None:
    """The gradients of a picture with respect to avatar and pose."""
    learnt = Pose(*(one.clone().requires_grad_() for one in (pose.rotation, pose.expression, pose.transl)))
    decoded = avatar.decode()
    gaussians = avatar.pose(decoded, learnt, time=0.5, rows=rows).gaussians
    image = render(gaussians, camera).color
    ssim_loss(image, torch.full_like(image, 0.5)).backward()
    picture = np.zeros((SIDE, SIDE, 3), np.uint8)
    draw_mesh(picture, camera, gaussians.means, decoded.surface.canonical.faces)
