"""How a video's frames are turned and mirrored before they are shown, by the display matrix of their file.

The matrix maps stored to shown pixels: x' = a x + c y, y' = b x + d y (ISO/IEC 14496-12, 8.5.2; FFmpeg's
``libavutil/display.h``). Cameras write multiples of a quarter turn, with or without a mirror.
"""

from __future__ import annotations

import dataclasses
import math
import struct

import av
import numpy as np
from av.sidedata.sidedata import SideData, Type

_ASKEW = 1.0  # degrees off a quarter turn that are told


@dataclasses.dataclass(frozen=True)
class Orientation:
    """Quarter turns, then a mirror.

    Attributes:
        turns: quarters, counter-clockwise.
        mirrored: whether left and right change places after the turn.
        askew: degrees by which the matrix turns further, which is left out.
    """

    turns: int = 0
    mirrored: bool = False
    askew: float = 0.0

    def apply(self, image: np.ndarray) -> np.ndarray:
        """The picture [H, W, 3] as it is shown."""
        shown = np.rot90(image, self.turns) if self.turns else image
        shown = shown[:, ::-1] if self.mirrored else shown
        return np.ascontiguousarray(shown)

    @property
    def note(self) -> str:
        """The line that says what is done; empty where nothing is."""
        done = []
        if self.turns:
            done.append(f"turned by {90 * self.turns} degrees counter-clockwise")
        if self.mirrored:
            done.append("mirrored")
        if abs(self.askew) > _ASKEW:
            done.append(f"not turned by the {self.askew:.0f} degrees that are no quarter")
        return f"frames are {', '.join(done)}, as its display matrix says" if done else ""


def orientation_of(frame: av.VideoFrame) -> Orientation:
    """The orientation that a frame's display matrix asks for; upright where it has none."""
    for item in frame.side_data:
        if isinstance(item, SideData) and item.type == Type.DISPLAYMATRIX and len(bytes(item)) >= 36:
            a, b, _, c, d, *_ = struct.unpack("=9i", bytes(item)[:36])
            return from_matrix(a, b, c, d)
    return Orientation()


def from_matrix(a: float, b: float, c: float, d: float) -> Orientation:
    """The nearest orientation to a matrix, of any scale.

    >>> from_matrix(0, 1, -1, 0)
    Orientation(turns=3, mirrored=False, askew=0.0)
    >>> from_matrix(-1, 0, 0, 1).mirrored
    True
    """
    mirrored = a * d - b * c < 0
    if mirrored:
        a, c = -a, -c
    if not math.hypot(a + d, b - c):
        return Orientation()
    angle = math.degrees(math.atan2(c - b, a + d))
    turns = round(angle / 90)
    return Orientation(turns % 4, mirrored, angle - 90 * turns)
