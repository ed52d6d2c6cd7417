"""Generated frames beside the captured ones (paper, Section 3.2; supplements B and E.1).

They have sizes, cameras and masks of their own, and a picture of how far each pixel is to be learnt from.
Their poses never move.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import torch

from pipeline.body import Poses, read_poses
from pipeline.camera import Camera
from pipeline.errors import UserError
from pipeline.frames import read_mask
from pipeline.records import read_cameras
from stages.train.data import Frames, View

MARK = "auxiliary.json"  # the stage publishes nothing where it is switched off


class GeneratedFrames(Frames):
    """Whole generated frames, each with a trust map."""

    def __getitem__(self, frame: int) -> View:
        """The uncropped frame number ``frame``."""
        trust = torch.from_numpy(read_mask(self.folder / "trust", frame)).float() / 255
        return dataclasses.replace(super().__getitem__(frame), trust=trust)


class BothFrames(Frames):
    """Captured crops and generated frames behind one set of numbers.

    Attributes:
        captured, made: the two sources.
        cameras: of all frames.
        generated: the numbers of those that a model made.
    """

    def __init__(self, captured: Frames, made: Frames):
        """Both sources under one set of numbers; reads no file yet."""
        self.captured, self.made = captured, made
        self.generated = made.generated
        self.cameras = {**captured.cameras, **made.cameras}

    def __getitem__(self, frame: int) -> View:
        """The crop of a captured frame, or a generated frame."""
        return self._of(frame)[frame]

    def camera(self, frame: int) -> Camera:
        """The camera of the crop or of the generated frame."""
        return self._of(frame).camera(frame)

    def _of(self, frame: int) -> Frames:
        return self.made if frame in self.generated else self.captured


@dataclasses.dataclass(frozen=True)
class Generated:
    """The auxiliary stage's published frames.

    Attributes:
        views: the frames.
        poses: theirs, fixed.
    """

    views: GeneratedFrames
    poses: Poses

    @property
    def frames(self) -> tuple[int, ...]:
        """The generated frames' numbers."""
        return self.poses.frames


def read_generated(folder: Path | None, captured: Poses) -> Generated | None:
    """Reads the auxiliary stage's frames; None where there are none.

    Raises:
        UserError: they do not go together with the clip's poses.
    """
    if folder is None or not (folder / MARK).is_file():
        return None
    poses = read_poses(folder / "poses.parquet")
    if not len(poses):
        return None
    cameras = read_cameras(folder / "cameras.parquet")
    shared = {*poses.frames} & {*captured.frames}
    if shared or {*cameras} != {*poses.frames}:
        raise UserError(f"{folder}: its frames do not go together; run the auxiliary stage again")
    if poses.expression.shape[1] != captured.expression.shape[1]:
        raise UserError(f"{folder}: made with another fit; run the auxiliary stage again")
    return Generated(GeneratedFrames(folder, cameras, None, frozenset(poses.frames)), poses)


def joined(captured: Poses, made: Poses) -> Poses:
    """The poses of captured and generated frames, captured ones first."""
    return Poses(
        (*captured.frames, *made.frames),
        rotation=torch.cat([captured.rotation, made.rotation]),
        expression=torch.cat([captured.expression, made.expression]),
        transl=torch.cat([captured.transl, made.transl]),
        valid=torch.cat([captured.valid, made.valid]),
    )
