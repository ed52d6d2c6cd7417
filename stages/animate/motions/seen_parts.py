"""The parts of a person that a clip shows, by its keypoints: what a motion of it cannot tell."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from pipeline.body import JOINT_NAMES, Poses
from pipeline.clip.keypoints import FACE, LEFT_HAND, RIGHT_HAND, read_keypoints

_FOUND = 0.4  # score of a point that was found, as the fit takes it
_ENOUGH = 1 / 3  # share of a part's points that must be found in a frame
_PARTLY = 0.5  # share of the frames under which a part is said to be seen in some only
_LEGS = slice(13, 17)  # knees and ankles
_POINTS: Mapping[str, slice] = {
    "face": FACE, "left hand": LEFT_HAND, "right hand": RIGHT_HAND, "legs": _LEGS,
}  # fmt: skip
_UNTOLD: Mapping[str, tuple[str, ...]] = {
    "face": ("jaw", "left_eye", "right_eye"),
    "left hand": JOINT_NAMES[25:40],
    "right hand": JOINT_NAMES[40:55],
}
_INSTEAD: Mapping[str, str] = {
    "face": "expression and jaw are left out",
    "left hand": "its fingers are left out and hang relaxed",
    "right hand": "its fingers are left out and hang relaxed",
    "legs": "theirs is the fit's guess",
}


@dataclasses.dataclass(frozen=True)
class SeenParts:
    """The share of a motion's frames in which each part was seen.

    Attributes:
        shares: part -> share.
        guessed: frames in which nothing of the person was found, whose poses are interpolated.
        frames: all.
    """

    shares: Mapping[str, float]
    guessed: int
    frames: int

    def of(self, part: str) -> float:
        """A part's share."""
        return self.shares[part]

    def untold(self) -> set[str]:
        """The joints of parts that were never seen."""
        return {joint for part, joints in _UNTOLD.items() if not self.shares[part] for joint in joints}

    def notes(self, name: str) -> tuple[str, ...]:
        """Sentences on what was not seen.

        Args:
            name: of the clip's subject.
        """
        never = [part for part, share in self.shares.items() if not share]
        some = [part for part, share in self.shares.items() if 0 < share < _PARTLY]
        found = [f"{name}'s clip never shows the {part}: {_INSTEAD[part]}" for part in never]
        for part in some:
            share = f"{100 * self.shares[part]:.0f}% of the frames"
            found.append(f"{name}'s clip shows the {part} in {share}; in the others it is the fit's guess")
        if self.guessed:
            found.append(f"{self.guessed} of {self.frames} frames of {name} show nobody: interpolated")
        return tuple(found)


def seen_parts(ingest: Path, poses: Poses, rows: np.ndarray) -> SeenParts:
    """The parts that some frames of a clip show.

    Args:
        ingest: the folder of the clip's ingest.
        poses: fitted to it.
        rows: [T], which of its poses are wanted.

    Raises:
        UserError: the keypoints cannot be read.
    """
    keypoints = read_keypoints(ingest / "keypoints.parquet")
    frames = [frame for frame in np.asarray(poses.frames)[rows] if frame in set(keypoints.frames.tolist())]
    scores = keypoints.whole_body[[keypoints.index(frame) for frame in frames], :, 2]
    if not (scores >= _FOUND).any():  # poses that were brought along; nothing was looked for
        return SeenParts(dict.fromkeys(_POINTS, 1.0), 0, len(rows))
    shares = {}
    for part, points in _POINTS.items():
        enough = (scores[:, points] >= _FOUND).mean(1) >= _ENOUGH
        shares[part] = float(enough.mean()) if len(enough) else 0.0
    measured = poses.valid[rows]
    return SeenParts(shares, int((~measured).sum()), len(rows))
