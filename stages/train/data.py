"""The training frames, which the losses compare renderings with."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pipeline.camera import Camera
from pipeline.errors import UserError
from pipeline.frames import read_frame, read_mask
from pipeline.person import Box

CACHED_BYTES = 2**30  # frames beyond this are read again whenever they are drawn


@dataclasses.dataclass(frozen=True)
class View:
    """One frame's crop around the person.

    Attributes:
        color: [H, W, 3] in [0, 1], the whole picture, not only the person.
        alpha: [H, W] in [0, 1], the person's soft mask.
        camera: of the crop.
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
        alpha = self.alpha[..., None]
        return self.color * alpha + (1 - alpha) * background


class Frames:
    """Crops of numbered frames, kept in memory as far as it is reasonable."""

    def __init__(
        self,
        folder: Path,
        cameras: Mapping[int, Camera],
        box: Box | None = None,
        generated: frozenset[int] = frozenset(),
    ):
        """A reader of crops; reads no file yet.

        Args:
            folder: what ingest published.
            cameras: of every frame.
            box: the part of each frame to return; the whole frame if None.
            generated: the frames that a model made.
        """
        self.folder, self.cameras, self.box, self.generated = folder, cameras, box, generated
        camera = next(iter(cameras.values()))
        pixels = (box.right - box.left) * (box.bottom - box.top) if box else camera.width * camera.height
        self._read = functools.lru_cache(maxsize=max(1, CACHED_BYTES // (4 * pixels)))(self._load)

    def __getitem__(self, frame: int) -> View:
        """The crop of frame number ``frame``."""
        color, alpha = self._read(frame)
        picture, mask = torch.from_numpy(color).float() / 255, torch.from_numpy(alpha).float() / 255
        return View(picture, mask, self.camera(frame), frame in self.generated)

    def camera(self, frame: int) -> Camera:
        """The crop's camera; the frame itself is not read."""
        box, camera = self.box, self.cameras[frame]
        if box is None:
            return camera
        return camera.cropped(box.left, box.top, box.right - box.left, box.bottom - box.top)

    def _load(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        color, alpha = read_frame(self.folder / "frames", frame), read_mask(self.folder / "masks", frame)
        camera = self.cameras[frame]
        if color.shape[:2] != alpha.shape or alpha.shape != (camera.height, camera.width):
            raise UserError(
                f"{self.folder}: frame, mask and camera {frame} differ in size; run the ingest stage again"
            )
        if self.box is None:
            return color, alpha
        rows, columns = slice(self.box.top, self.box.bottom), slice(self.box.left, self.box.right)
        return np.ascontiguousarray(color[rows, columns]), np.ascontiguousarray(alpha[rows, columns])
