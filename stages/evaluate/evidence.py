"""What the avatar is judged against: the clip as ingest published it, and the poses."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from pipeline.body.poses import Poses, read_poses
from pipeline.camera import Camera
from pipeline.composite import BLACK, composite_frame
from pipeline.errors import UserError
from pipeline.frames import read_frame, read_mask
from pipeline.keypoints import Keypoints, read_keypoints
from pipeline.records import Footage, Split, read_cameras, read_footage, read_split

Item = TypeVar("Item")

OTHER_CAMERA_ANGLE = 5.0
"""Degrees about the person between a camera and every training camera, from which it is another one."""

Pose = tuple[Tensor, Tensor, Tensor]
"""Rotation [55, 3], expression [E] and transl [3] of a frame."""


@dataclasses.dataclass(frozen=True)
class Evidence:
    """A clip with its split, cameras and poses.

    Attributes:
        folder: what ingest published.
        footage: what the source was and what was kept of it.
        split: the frames that were trained on and those held out.
        cameras: a camera a frame.
        fitted: the fit's poses, of every kept frame.
        refined: the training frames' poses as training left them.
        keypoints: what was detected in the frames.
    """

    folder: Path
    footage: Footage
    split: Split
    cameras: Mapping[int, Camera]
    fitted: Poses
    refined: Poses
    keypoints: Keypoints

    def points(self, index: int) -> np.ndarray | None:
        """The frame's 133 whole-body points with scores, [133, 3]; None where nobody looked at it."""
        try:
            return self.keypoints.whole_body[self.keypoints.index(index)]
        except KeyError:
            return None

    def follow(self, first: int, second: int) -> bool:
        """Whether the second frame is the next that was kept after the first."""
        rows = _rows(tuple(sorted(self.cameras)))
        return first in rows and rows.get(second) == rows[first] + 1

    @cached_property
    def other_cameras(self) -> frozenset[int]:
        """The held-out frames whose camera stands elsewhere than every training frame's does.

        A camera that walks around passes between the places that it was seen from; only a view that is
        ``OTHER_CAMERA_ANGLE`` or more off, as seen from the person, is another one.
        """
        person = self.fitted.transl.mean(0)

        def directions(frames: Sequence[int]) -> Tensor:
            centres = torch.stack([self.cameras[frame].centre for frame in frames]) - person
            return torch.nn.functional.normalize(centres, dim=1)

        if not self.split.test:
            return frozenset()
        cosines = (directions(self.split.test) @ directions(self.split.train).mT).amax(1)
        far = cosines < math.cos(math.radians(OTHER_CAMERA_ANGLE))
        return frozenset(frame for frame, other in zip(self.split.test, far.tolist(), strict=True) if other)

    def frame(self, index: int) -> np.ndarray:
        """The frame as filmed, [H, W, 3] uint8 RGB."""
        return read_frame(self.folder / "frames", index)

    def mask(self, index: int) -> np.ndarray:
        """The person's soft alpha, [H, W] uint8."""
        return read_mask(self.folder / "masks", index)

    def person(self, index: int, background: str = BLACK) -> Tensor:
        """The person on a background, [H, W, 3] float32 in [0, 1]."""
        return composite_frame(self.frame(index), self.mask(index), background)

    def seconds(self, index: int) -> float | None:
        """When the frame was filmed, from the clip's start; None where the source has no clock."""
        row = _rows(tuple(sorted(self.cameras))).get(index)
        known = row is not None and row < len(self.footage.seconds)
        return self.footage.seconds[row] if known and row is not None else None

    def pose(self, index: int) -> Pose:
        """The pose that a frame is rendered in: rotation [55, 3], expression [E], transl [3].

        A training frame has the pose that training refined. A held-out frame has the fit's, which
        knows its keypoints and nothing else of the image. (What refining it on the held-out image
        itself makes of it is in ``refinement.py``; its numbers stand beside these.)

        Raises:
            UserError: neither the fit nor training has a pose for the frame.
        """
        held_out = index in self.split.test
        for poses in (self.fitted,) if held_out else (self.refined, self.fitted):
            row = _row_of(poses, index)
            if row is not None:
                return poses.rotation[row], poses.expression[row], poses.transl[row]
        raise UserError(f"frame {index} has no pose in the fit's poses.parquet: run the fit stage again")


def read_evidence(inputs: Mapping[str, Path]) -> Evidence:
    """Reads what the upstream stages published.

    Args:
        inputs: the folders of ingest, fit and train.

    Raises:
        UserError: a file is missing or damaged.
    """
    ingest = inputs["ingest"]
    return Evidence(
        folder=ingest,
        footage=read_footage(ingest / "footage.json"),
        split=read_split(ingest / "split.json"),
        cameras=read_cameras(ingest / "cameras.parquet"),
        fitted=read_poses(inputs["fit"] / "poses.parquet"),
        refined=read_poses(inputs["train"] / "poses.parquet"),
        keypoints=read_keypoints(ingest / "keypoints.parquet"),
    )


@lru_cache(maxsize=4)
def _rows(frames: tuple[int, ...]) -> Mapping[int, int]:
    return {frame: row for row, frame in enumerate(frames)}


def _row_of(poses: Poses, index: int) -> int | None:
    return _rows(poses.frames).get(index)
