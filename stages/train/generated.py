"""Generated frames beside the captured ones (paper, Section 3.2; supplements B and E.1).

They have sizes, cameras and masks of their own, and a picture of how far each pixel is to be learnt from.
Their poses never move.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import torch

from pipeline.body import Poses, read_poses
from pipeline.clip.frames import read_mask
from pipeline.clip.records import read_cameras
from pipeline.clip.views import View, ViewCache
from pipeline.errors import UserError

MARK = "auxiliary.json"  # the stage publishes nothing where it is switched off


@dataclasses.dataclass(frozen=True)
class GeneratedFrames:
    """The auxiliary stage's published frames.

    Attributes:
        views: the pictures, uncropped.
        poses: theirs, fixed.
    """

    views: ViewCache
    poses: Poses

    @property
    def frames(self) -> tuple[int, ...]:
        """The generated frames' numbers."""
        return self.poses.frames

    def view(self, frame: int) -> View:
        """Frame number ``frame`` with its trust map."""
        trust = torch.from_numpy(read_mask(self.views.folder / "trust", frame)).float() / 255
        return dataclasses.replace(self.views[frame], generated=True, trust=trust)


def read_generated(folder: Path | None, captured: Poses) -> GeneratedFrames | None:
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
    return GeneratedFrames(ViewCache(folder, cameras), poses)


def joined(captured: Poses, made: Poses) -> Poses:
    """The poses of captured and generated frames, captured ones first."""
    return Poses(
        (*captured.frames, *made.frames),
        rotation=torch.cat([captured.rotation, made.rotation]),
        expression=torch.cat([captured.expression, made.expression]),
        transl=torch.cat([captured.transl, made.transl]),
        valid=torch.cat([captured.valid, made.valid]),
    )
