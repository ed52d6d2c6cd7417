"""The output of every generator: pictures of the person in known poses before known cameras."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping

import numpy as np

from pipeline.body import Poses
from pipeline.clip.camera import Camera


@dataclasses.dataclass(frozen=True)
class GeneratedPicture:
    """One generated frame.

    Attributes:
        frame: its number.
        image: [H, W, 3] uint8 RGB, of its camera's size.
        mask: [H, W] uint8; None where the generator knows none.
        keypoints: [133, 3], pixels and score; None where it knows none.
    """

    frame: int
    image: np.ndarray
    mask: np.ndarray | None = None
    keypoints: np.ndarray | None = None


@dataclasses.dataclass(frozen=True)
class GeneratorOutput:
    """A generator's frames.

    Attributes:
        poses: the driving poses.
        cameras: frame number -> camera.
        pictures: in order; some frames of ``poses`` may be missing.
        exact: whether the pictures were painted onto these very poses, so that there is nothing to
            detect, to check or to register.
    """

    poses: Poses
    cameras: Mapping[int, Camera]
    pictures: Iterator[GeneratedPicture]
    exact: bool = False
