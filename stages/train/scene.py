"""The scene behind the person, where the camera stands still: the clip's own background plate.

ExAvatar's masking strategy, which the paper takes over (Section 4.1): the person is also compared over the
scene, so that what the mask has wrong is learnt from the picture. There the scene is learnt as Gaussians of
its own; here it is each pixel's mean colour over the frames in which the person was elsewhere. Frames of a
moving camera are compared over drawn colours alone.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator

import numpy as np
import torch
from torch import Tensor

from pipeline.clip.background import learn_background
from pipeline.clip.boxes import Box
from pipeline.clip.camera import Camera
from pipeline.clip.fitted_clip import FittedClip

_INSTEAD = ": train.scene_share does nothing, and frames are compared over drawn colours alone"


@dataclasses.dataclass(frozen=True)
class BackgroundPlate:
    """The background of the crop that all training frames share.

    Attributes:
        color: [H, W, 3] in [0, 1].
        confidence: [H, W] in [0, 1], 0 where the clip never showed it, or where it moves.
    """

    color: Tensor
    confidence: Tensor

    def to(self, device: torch.device | str) -> BackgroundPlate:
        """The same on another device."""
        return BackgroundPlate(self.color.to(device), self.confidence.to(device))


def read_scene(
    clip: FittedClip, box: Box | None, log: Callable[[str], None] = lambda line: None
) -> BackgroundPlate | None:
    """The scene in a box of the training frames; None where the camera moves, or no pixel of it is known.

    Args:
        clip: the frames.
        box: that training crops from each; None for whole frames.
        log: for a line on how much of it is known, or why it is none.
    """
    frames = clip.split.train
    cameras = [clip.camera(frame) for frame in frames]
    if not all(_same(camera, cameras[0]) for camera in cameras):
        log(f"no scene, for the camera moves{_INSTEAD}")
        return None

    def pairs() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for frame in frames:
            yield clip.frame(frame), clip.mask(frame).astype(np.float32) / 255

    found = learn_background(pairs())
    assert found is not None  # there are training frames
    rows = (slice(None), slice(None)) if box is None else box.slices
    color, confidence = found.mean[rows] / 255, found.confidence[rows]
    if not confidence.any():
        log(f"no scene, for too few frames show what is behind the person{_INSTEAD}")
        return None
    log(f"scene: {confidence.mean():.0%} of the crop is known behind the person")
    return BackgroundPlate(torch.from_numpy(color.copy()), torch.from_numpy(confidence.copy()))


def _same(camera: Camera, other: Camera) -> bool:
    """True where two cameras stand and look alike."""
    values = [[getattr(one, field.name) for field in dataclasses.fields(Camera)] for one in (camera, other)]
    return all(torch.equal(torch.as_tensor(a), torch.as_tensor(b)) for a, b in zip(*values, strict=True))
