"""The background's motion by sparse optical flow, which tells whether the camera moves.

Corners outside the widened mask are followed from one frame to another (pyramidal Lucas-Kanade, each
checked by following it back). Their median displacement over the picture's longer side is robust to what
moves in the background by itself, as long as that is less than half of it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from pipeline.clip.frames import read_frame, read_mask

GAP_SECONDS = 1.0  # between the frames of a pair, if features can be followed that far
PAIRS = 24  # looked at, evenly spread over the clip
CORNERS, FEWEST = 300, 20  # sought in a frame; fewer that can be followed say nothing
WINDOW = 0.02  # half the side of what is compared about a corner, of the longer side
MARGIN = 0.04  # by how much the mask is widened: a window that the person's edge enters follows the person
PERSON = 32  # grey level from which a mask counts
RETURN = 0.7  # pixels, the largest distance between a corner and where it was followed back to
SURVIVING = 0.4  # part of the corners that must be followed before a shorter gap is tried
MOVING = 0.03
"""Displacement in a second, of the longer side, from which the camera counts as moving.

Measured on real clips: tripods in rooms under 0.0002, the inside of a car with its windows 0.0023, a man
who holds the camera in his own hand 0.0123. Below the threshold the person's fitted motion takes up the
camera's without harm, since poses are found in the camera's axes; pans and orbits are at 0.05 and more.
"""
AT = 75  # percentile of the pairs that is compared with MOVING: a clip may stand still half of the time


@dataclasses.dataclass(frozen=True)
class BackgroundMotion:
    """The background's motion.

    Attributes:
        displacement: of the longer side in about a second, at the 75th percentile of the pairs; NaN where
            the background has too few corners to tell.
        pairs: how many pairs of frames were compared.
        frames: how far apart the frames of a pair were, median, in frames.
    """

    displacement: float
    pairs: int
    frames: float

    @property
    def moving(self) -> bool:
        """True where the camera counts as moving; False where the background cannot tell."""
        return self.displacement >= MOVING

    def __str__(self) -> str:
        if not self.pairs:
            return "background: too few corners to follow, so the camera is taken for static"
        verdict = "moves" if self.moving else "stands still"
        return (
            f"background: moves by {self.displacement:.2%} of the picture in {self.frames:.0f} frames "
            f"(threshold {MOVING:.2%}, {self.pairs} pairs): the camera {verdict}"
        )


def measure_motion(output: Path, frames: Sequence[int], fps: float) -> BackgroundMotion:
    """Measure the background's motion over a clip.

    Args:
        output: the folder with ``frames`` and ``masks``.
        frames: the kept frames, increasing.
        fps: frames a second; 0 where there is no clock, which counts as 25.
    """
    widest = min(max(1, round(GAP_SECONDS * (fps or 25.0))), max(1, len(frames) // 2))
    starts = np.unique(np.linspace(0, len(frames) - 1 - widest, PAIRS).astype(int)).tolist()
    displacements, gaps = [], []
    for start in starts if len(frames) > 1 else ():
        gap = widest
        while gap >= 1:
            before, after = track_corners(output, frames[start], frames[start + gap])
            if len(before) >= FEWEST or gap == 1:
                break
            gap //= 2
        if len(before) >= FEWEST:
            displacements.append(float(np.median(np.linalg.norm(after - before, axis=1))))
            gaps.append(gap)
    if not displacements:
        return BackgroundMotion(float("nan"), 0, 0.0)
    longer = max(read_mask(output / "masks", frames[0]).shape)
    moved = float(np.percentile(displacements, AT)) / longer
    return BackgroundMotion(moved, len(displacements), float(np.median(gaps)))


def track_corners(output: Path, first: int, second: int) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the background in one frame, and where they are in another.

    Args:
        output: the folder with ``frames`` and ``masks``.
        first, second: frame numbers.

    Returns:
        Two arrays [N, 2], pixels; empty where less than ``SURVIVING`` of the corners could be followed.
    """
    nothing = np.zeros((0, 2), np.float32)
    (grey, free), (other, other_free) = (_background(output, frame) for frame in (first, second))
    corners = cv2.goodFeaturesToTrack(grey, CORNERS, 0.01, max(4, max(grey.shape) // 64), mask=free)
    if corners is None:
        return nothing, nothing
    half = max(2, round(WINDOW * max(grey.shape)))
    how = {"winSize": (2 * half + 1, 2 * half + 1), "maxLevel": 3 if max(grey.shape) > 256 else 2}
    there, found, _ = cv2.calcOpticalFlowPyrLK(grey, other, corners, None, **how)  # type: ignore[call-overload]
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(other, grey, there, None, **how)  # type: ignore[call-overload]
    before, after = corners[:, 0], there[:, 0]
    kept = (found[:, 0] > 0) & (found_back[:, 0] > 0)
    kept &= np.linalg.norm(back[:, 0] - before, axis=1) < RETURN
    kept &= _on_background(other_free, after)
    if kept.sum() < SURVIVING * len(before):
        return nothing, nothing
    return before[kept] + 0.5, after[kept] + 0.5


def background_mask(mask: np.ndarray) -> np.ndarray:
    """[H, W] uint8, 255 where the person, widened, is not."""
    reach = 2 * max(1, round(MARGIN * max(mask.shape))) + 1
    person = cv2.dilate((mask >= PERSON).astype(np.uint8), np.ones((reach, reach), np.uint8))
    return (1 - person) * np.uint8(255)


def _background(output: Path, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """A frame in grey, and where the background is, both [H, W] uint8."""
    grey = cv2.cvtColor(read_frame(output / "frames", frame), cv2.COLOR_RGB2GRAY)
    return grey, background_mask(read_mask(output / "masks", frame))


def _on_background(free: np.ndarray, points: np.ndarray) -> np.ndarray:
    """True where points [N, 2] lie in the picture and on its background, [N] bool."""
    pixels = np.floor(points + 0.5).astype(int)
    within = ((pixels >= 0) & (pixels < free.shape[::-1])).all(1)
    pixels = np.clip(pixels, 0, np.array(free.shape[::-1]) - 1)
    return within & (free[pixels[:, 1], pixels[:, 0]] > 0)
