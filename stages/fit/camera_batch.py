"""The clip's cameras as one batch."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from pipeline.clip.camera import Camera


@dataclasses.dataclass(frozen=True)
class CameraBatch:
    """A pinhole a frame; conventions as in ``pipeline.clip.camera``.

    Attributes:
        rotation: [T, 3, 3], world-to-camera.
        translation: [T, 3], world-to-camera, metres.
        focal: [T, 2], pixels.
        centre: [T, 2], the principal point, pixels.
        size: [T, 2], width and height, pixels.
    """

    rotation: Tensor
    translation: Tensor
    focal: Tensor
    centre: Tensor
    size: Tensor

    def rows(self, rows: slice) -> CameraBatch:
        """The cameras of some frames."""
        return CameraBatch(*(getattr(self, field.name)[rows] for field in dataclasses.fields(self)))

    def to_camera(self, points: Tensor) -> Tensor:
        """World points in the camera's axes: [T, N, 3] -> [T, N, 3], metres."""
        return points @ self.rotation.mT + self.translation[:, None]

    def to_world(self, points: Tensor) -> Tensor:
        """The inverse of ``to_camera``."""
        return (points - self.translation[:, None]) @ self.rotation

    def to_pixels(self, in_camera: Tensor, nearest: float = 1e-2) -> Tensor:
        """Points in the camera's axes as pixels: [T, N, 3] -> [T, N, 2].

        Depths under ``nearest`` metres are raised to it, which keeps values and gradients finite.
        """
        depth = in_camera[..., 2:].clamp_min(nearest)
        return in_camera[..., :2] / depth * self.focal[:, None] + self.centre[:, None]


def stack(cameras: Sequence[Camera]) -> CameraBatch:
    """The cameras of T frames as one batch, float32."""
    intrinsics = torch.stack([camera.intrinsics for camera in cameras]).float()
    return CameraBatch(
        rotation=torch.stack([camera.rotation for camera in cameras]).float(),
        translation=torch.stack([camera.translation for camera in cameras]).float(),
        focal=intrinsics[:, [0, 1], [0, 1]],
        centre=intrinsics[:, :2, 2],
        size=torch.tensor([[camera.width, camera.height] for camera in cameras], dtype=torch.float32),
    )
