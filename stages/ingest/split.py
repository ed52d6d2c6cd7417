"""Which frames are held out."""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.clip.records import Split
from pipeline.errors import UserError
from stages.ingest.datasets import Recording


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
            f"{count} frames are to be held out of {len(frames)} that hold a person: "
            "lower ingest.test_frames or ingest.test_fraction"
        )
    return Split(tuple(frames[: len(frames) - count]), tuple(frames[len(frames) - count :]))


def split_recording(recording: Recording, frames: Sequence[int], fraction: float, last: int) -> Split:
    """The dataset's own split of the kept frames, else the clip's end is held out.

    Args:
        recording: the dataset's folder.
        frames: the kept frames, increasing.
        fraction, last: as for ``split_frames``. ``last`` replaces the dataset's split of a single camera.

    Raises:
        UserError: nothing is left to learn from.
    """
    own = recording.train is not None and recording.test is not None
    if not own or (last and len(recording.shots) == 1):
        return split_frames(frames, fraction, last)
    assert recording.train is not None and recording.test is not None
    train = tuple(frame for frame in frames if frame in recording.train)
    if not train:
        raise UserError(
            f"the {recording.layout} split leaves no person to learn from: set ingest.test_frames"
        )
    return Split(train, tuple(frame for frame in frames if frame in recording.test))
