"""The split of the kept frames into those learnt from and those held out."""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.clip.records import Split
from pipeline.errors import UserError
from stages.ingest.datasets import Recording


def split_frames(frames: Sequence[int], fraction: float, last: int) -> Split:
    """The clip's end held out.

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
            f"{count} frames are to be held out of {len(frames)} that hold a person: "
            "lower ingest.test_frames or ingest.test_fraction"
        )
    return Split(tuple(frames[: len(frames) - count]), tuple(frames[len(frames) - count :]))


def split_recording(recording: Recording, frames: Sequence[int], fraction: float, last: int) -> Split:
    """The dataset's own split of the kept frames, else the clip's end held out.

    Arguments and errors as those of :func:`split_frames`; ``last`` replaces a single camera's own split.
    """
    if recording.train is None or recording.test is None or (last and len(recording.shots) == 1):
        return split_frames(frames, fraction, last)
    train = tuple(frame for frame in frames if frame in recording.train)
    if not train:
        raise UserError(
            f"the {recording.layout} split leaves no person to learn from: set ingest.test_frames"
        )
    return Split(train, tuple(frame for frame in frames if frame in recording.test))
