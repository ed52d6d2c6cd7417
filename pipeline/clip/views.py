"""Frames as tensors with the camera that took them; renderings are compared with these."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pipeline.clip.boxes import Box
from pipeline.clip.camera import Camera
from pipeline.clip.composite import composite
from pipeline.clip.foreground import read_person
from pipeline.errors import UserError

CACHED_BYTES = 2**30  # frames beyond this are read again whenever they are asked for


@dataclasses.dataclass(frozen=True)
class View:
    """One frame, or a box cut out of it.

    Attributes:
        color: [H, W, 3] in [0, 1], the whole picture, not only the person; where alpha is between 0 and 1 the
            person's own colour, without the background that shines through.
        alpha: [H, W] in [0, 1], the person's soft mask.
        camera: of the picture.
        generated: whether a model made the picture; its losses then weigh less.
        trust: [H, W] in [0, 1], how far each pixel is to be learnt from; None where all of them are.
    """

    color: Tensor  # [H, W, 3]
    alpha: Tensor  # [H, W]
    camera: Camera
    generated: bool = False
    trust: Tensor | None = None  # [H, W]

    def composite(self, background: Tensor) -> Tensor:
        """The person over a plain background, [3] -> [H, W, 3]."""
        return composite(self.color, self.alpha, background)


class ViewCache:
    """Numbered frames of a folder, kept in memory as far as it is reasonable.

    Attributes:
        folder: with ``frames`` and ``masks``.
        cameras: of every frame.
        box: the part of each frame that is returned; the whole frame if None.
    """

    def __init__(self, folder: Path, cameras: Mapping[int, Camera], box: Box | None = None) -> None:
        """Reads nothing yet."""
        self.folder, self.cameras, self.box = folder, cameras, box
        camera = next(iter(cameras.values()))
        pixels = box.width * box.height if box else camera.width * camera.height
        self._cached = functools.lru_cache(maxsize=max(1, CACHED_BYTES // (4 * pixels)))(self._pictures)

    def __getitem__(self, frame: int) -> View:
        """Frame number ``frame``.

        Raises:
            UserError: a picture is missing or damaged, or frame, mask and camera differ in size.
        """
        color, alpha = self._cached(frame)
        picture, mask = torch.from_numpy(color).float() / 255, torch.from_numpy(alpha).float() / 255
        return View(picture, mask, self.camera(frame))

    def camera(self, frame: int) -> Camera:
        """The camera of a frame's box; the frame itself is not read."""
        return cropped(self.cameras[frame], self._part(frame))

    def _part(self, frame: int) -> Box | None:
        """The box within a frame: cameras of one rig may differ in size."""
        camera = self.cameras[frame]
        return self.box.clipped(camera.width, camera.height) if self.box else None

    def _pictures(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Colours and mask, [H, W, 3] and [H, W] uint8."""
        color, alpha = read_person(self.folder, frame)
        camera, box = self.cameras[frame], self._part(frame)
        if color.shape[:2] != alpha.shape or alpha.shape != (camera.height, camera.width):
            raise UserError(
                f"{self.folder}: frame, mask and camera {frame} differ in size; run the ingest stage again"
            )
        if box is None:
            return color, alpha
        return np.ascontiguousarray(color[box.slices]), np.ascontiguousarray(alpha[box.slices])


def cropped(camera: Camera, box: Box | None) -> Camera:
    """The camera of a box of the picture; the camera itself for None."""
    if box is None:
        return camera
    return camera.cropped(box.left, box.top, box.width, box.height)
