"""The pipeline's camera before the body, and the unseen ones about it."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import roma
import torch
from torch import Tensor

from pipeline.body import BodyModel, Identity, Poses, joint_index, pose_body
from pipeline.clip.camera import Camera, facing_camera
from stages.ingest.mannequin.motion import MannequinMotion
from stages.ingest.mannequin.spec import VIEWS, MannequinSpec, UnseenView

FOCAL = {"full": 1.2, "upper": 1.5, "head": 2.2}
"""Focal length over the picture's side: closer framings are filmed with longer lenses."""

WANDERING = {"full": (0.4, 1.0, 0.4), "upper": (0.1, 0.1, 0.1), "head": (0.05, 0.05, 0.05)}
"""The share of the motion's way along X, Y and Z that is kept, so that a still camera holds the body."""

_FILL = 0.93  # of the picture's height, by what is framed
_SAMPLES = 24  # frames that place the camera


@dataclasses.dataclass(frozen=True)
class FramedMotion:
    """The pipeline's camera and the motion placed before it.

    Attributes:
        camera: the one that the pipeline is given; it stands at the world's origin.
        centre: [3], metres, the middle of what is framed, about which the other cameras stand.
        poses: the motion in the world.
    """

    camera: Camera
    centre: Tensor
    poses: Poses


def frame_motion(
    spec: MannequinSpec, body: BodyModel, identity: Identity, motion: MannequinMotion
) -> FramedMotion:
    """The body's motion placed so that the camera sees what the framing asks for.

    ``full`` shows the whole body in every frame, ``upper`` what is above the waist, ``head`` what is
    above the collarbones; hands may leave the picture in the latter two.

    Framing and size of ``spec`` are read; ``identity`` is with clothes and hair.
    """
    camera = facing_camera(spec.size, spec.size, FOCAL[spec.framing] * spec.size)
    root = motion.root * torch.tensor(WANDERING[spec.framing])
    rows = torch.linspace(0, spec.frames - 1, min(spec.frames, _SAMPLES)).round().long()
    vertices, joints = pose_body(body, identity, motion.rotation[rows], motion.expression[rows], root[rows])
    half = 0.5 / FOCAL[spec.framing] * _FILL  # of the picture, at a distance of 1
    if spec.framing == "full":
        low, high = vertices.amin((0, 1)), vertices.amax((0, 1))
        middle = (low + high) / 2
        away = (vertices - middle).abs()[..., :2].amax(-1) / half + vertices[..., 2] - middle[2]
        distance = float(away.max())
    else:
        head = body.skinning_weights[:, joint_index("head")] > 0.5
        top = vertices[:, head, 1].amax(1).median()
        bottom = _height(joints, "spine1") if spec.framing == "upper" else _height(joints, "neck") - 0.12
        neck = joints[:, joint_index("neck")].median(0).values
        middle = torch.stack([neck[0], (top + bottom) / 2, neck[2]])
        distance = float(top - bottom) / 2 / half
        # What is cut off below is cut off at the picture's edge, and the margin is all above the head.
        middle[1] += (1 - _FILL) / _FILL * float(top - bottom) / 2
    centre = torch.tensor([0.0, 0.0, -distance])
    poses = Poses(tuple(range(spec.frames)), motion.rotation, motion.expression, root + (centre - middle))
    return FramedMotion(camera, centre, poses)


def unseen_camera(shot: FramedMotion, name: UnseenView) -> Camera:
    """A camera of ``VIEWS``: the pipeline's own, carried about the middle of what is framed."""
    azimuth, elevation = (math.radians(angle) for angle in VIEWS[name])
    about = roma.euler_to_rotmat("YX", [azimuth, -elevation])
    rotation = shot.camera.rotation @ about.mT
    place = shot.centre + about @ (shot.camera.centre - shot.centre)
    return dataclasses.replace(shot.camera, rotation=rotation, translation=-rotation @ place)


def in_picture(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """True where pixels [..., 2] lie in the picture, [...] bool."""
    return np.logical_and.reduce((pixels >= 0) & (pixels < [camera.width, camera.height]), axis=-1)


def _height(joints: Tensor, name: str) -> Tensor:
    """The median height of a joint over frames; joints [T, 55, 3]."""
    return joints[:, joint_index(name), 1].median()
