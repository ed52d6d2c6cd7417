"""Which frames are held out."""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.errors import UserError
from pipeline.records import Split


def split_frames(frames: Sequence[int], fraction: float, last: int) -> Split:
    """Hold out the clip's end.

    Args:
        frames: the kept frames, increasing.
        fraction: the part of them that is held out, rounded, at least one frame.
        last: how many are held out instead, where it is not 0.

    Raises:
        UserError: nothing is left to learn from.
    """
    count = last or (max(1, round(len(frames) * fraction)) if fraction > 0 else 0)
    if count >= len(frames):
        raise UserError(
            f"{count} frames are to be held out of {len(frames)} that hold a person: lower ingest.test_frames"
        )
    return Split(tuple(frames[: len(frames) - count]), tuple(frames[len(frames) - count :]))
