"""The one camera of the project: a pinhole with OpenCV axes.

Frames of reference: the camera looks along +Z, X runs right, Y runs down. Pixels are measured from
the image's top-left corner, so that the centre of the first pixel is (0.5, 0.5). Extrinsics are
world-to-camera: ``x_camera = rotation @ x_world + translation``, in metres.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor


@dataclasses.dataclass(frozen=True)
class Camera:
    """A pinhole camera.

    Attributes:
        width, height: the image's size in pixels.
        intrinsics: ``K``, [3, 3], focal lengths and principal point in pixels, no skew.
        rotation: [3, 3], world-to-camera.
        translation: [3], world-to-camera, metres.
    """

    width: int
    height: int
    intrinsics: Tensor  # [3, 3]
    rotation: Tensor  # [3, 3]
    translation: Tensor  # [3]

    @property
    def world_to_camera(self) -> Tensor:
        """The extrinsics as one matrix, [4, 4]."""
        matrix = torch.eye(4, dtype=self.rotation.dtype, device=self.rotation.device)
        matrix[:3, :3] = self.rotation
        matrix[:3, 3] = self.translation
        return matrix

    @property
    def centre(self) -> Tensor:
        """The centre of projection in world coordinates, [3], metres."""
        return -self.rotation.mT @ self.translation

    def cropped(self, left: int, top: int, width: int, height: int) -> Camera:
        """The camera of the sub-image whose top-left corner is (left, top)."""
        intrinsics = self.intrinsics.clone()
        intrinsics[0, 2] -= left
        intrinsics[1, 2] -= top
        return dataclasses.replace(self, width=width, height=height, intrinsics=intrinsics)

    def resized(self, width: int, height: int) -> Camera:
        """The camera of the same view resampled to ``width`` x ``height`` pixels."""
        intrinsics = self.intrinsics.clone()
        intrinsics[0] *= width / self.width
        intrinsics[1] *= height / self.height
        return dataclasses.replace(self, width=width, height=height, intrinsics=intrinsics)

    def to(self, *args, **kwargs) -> Camera:
        """The same camera with its tensors moved or cast as by ``Tensor.to``."""
        return dataclasses.replace(
            self,
            intrinsics=self.intrinsics.to(*args, **kwargs),
            rotation=self.rotation.to(*args, **kwargs),
            translation=self.translation.to(*args, **kwargs),
        )


def facing_camera(width: int, height: int, focal: float) -> Camera:
    """The camera that a clip without calibration is given.

    It stands at the world's origin, whose Y axis points up, and looks along the world's -Z axis:
    a body of the SMPL-X schema in its rest pose, moved to z < 0, faces it upright.

    Args:
        width, height: pixels.
        focal: pixels, the same for both axes; the principal point is the image's centre.
    """
    intrinsics = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Camera(width, height, intrinsics, torch.diag(torch.tensor([1.0, -1.0, -1.0])), torch.zeros(3))


def to_camera(camera: Camera, points: Tensor) -> Tensor:
    """World points in the camera's frame of reference: [..., 3] -> [..., 3], metres."""
    return points @ camera.rotation.mT + camera.translation


def project(camera: Camera, points: Tensor, nearest: float = 1e-2) -> Tensor:
    """World points as pixels: [..., 3] -> [..., 2].

    Depths under ``nearest`` metres are raised to it, so that a point at or behind the camera gives
    a finite pixel and a finite gradient.

    >>> camera = facing_camera(640, 480, focal=500.0)
    >>> project(camera, torch.tensor([0.1, 0.2, -1.0]))  # a metre before the camera, to the right and up
    tensor([370., 140.])
    """
    in_camera = to_camera(camera, points)
    depth = in_camera[..., 2:].clamp_min(nearest)
    focal = torch.stack([camera.intrinsics[0, 0], camera.intrinsics[1, 1]])
    return in_camera[..., :2] / depth * focal + camera.intrinsics[:2, 2]
