"""The clip that an avatar is compared with: as ingest published it, in the fit's poses and training's."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from pipeline.body.poses import Poses, read_poses
from pipeline.camera import Camera
from pipeline.errors import UserError
from pipeline.frames import read_frame, read_mask
from pipeline.keypoints import Keypoints, read_keypoints
from pipeline.metrics.protocol import BLACK, composite
from pipeline.records import Footage, Split, read_cameras, read_footage, read_split

Item = TypeVar("Item")

OTHER_CAMERA_ANGLE = 5.0
"""Degrees about the person between a camera and every training camera, from which it is another one."""

Pose = tuple[Tensor, Tensor, Tensor]
"""Rotation [55, 3], expression [E] and transl [3] of a frame."""


@dataclasses.dataclass(frozen=True)
class EvaluatedClip:
    """A clip with its split, cameras and poses.

    Attributes:
        folder: what ingest published.
        footage: what the source was and what was kept of it.
        split: the frames that were trained on and those held out.
        cameras: a camera a frame.
        fitted: the fit's poses, of every kept frame.
        trained: the training frames' poses as training left them.
        keypoints: what was detected in the frames.
    """

    folder: Path
    footage: Footage
    split: Split
    cameras: Mapping[int, Camera]
    fitted: Poses
    trained: Poses
    keypoints: Keypoints

    @cached_property
    def places(self) -> Mapping[int, int]:
        """Frame -> its place among the kept frames."""
        return {frame: place for place, frame in enumerate(sorted(self.cameras))}

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
        return composite(self.frame(index), self.mask(index), background)

    def points(self, index: int) -> np.ndarray | None:
        """The frame's 133 whole-body points with scores, [133, 3]; None where none were looked for."""
        try:
            return self.keypoints.whole_body[self.keypoints.index(index)]
        except KeyError:
            return None

    def follows(self, first: int, second: int) -> bool:
        """True where the second frame is the next that was kept after the first."""
        return first in self.places and self.places.get(second) == self.places[first] + 1

    def seconds(self, index: int) -> float | None:
        """The time at which a frame was filmed, from the clip's start; None where the source has no clock."""
        place = self.places.get(index)
        return None if place is None or place >= len(self.footage.seconds) else self.footage.seconds[place]

    def pose(self, index: int) -> Pose:
        """The pose that a frame is rendered in.

        A training frame has the pose that training refined. A held-out frame has the fit's, which
        knows its keypoints and nothing else of the image. (Poses refined on the held-out images
        themselves are in ``test_pose_refinement.py``; their numbers stand beside these.)

        Raises:
            UserError: neither the fit nor training has a pose for the frame.
        """
        known = (self.fitted,) if index in self.split.test else (self.trained, self.fitted)
        for poses in known:
            if index in poses.frames:
                row = poses.index(index)
                return poses.rotation[row], poses.expression[row], poses.transl[row]
        raise UserError(f"frame {index} has no pose in the fit's poses.parquet: run the fit stage again")


def read_clip(inputs: Mapping[str, Path]) -> EvaluatedClip:
    """Reads what the upstream stages published.

    Args:
        inputs: the folders of ingest, fit and train.

    Raises:
        UserError: a file is missing or damaged.
    """
    ingest = inputs["ingest"]
    return EvaluatedClip(
        folder=ingest,
        footage=read_footage(ingest / "footage.json"),
        split=read_split(ingest / "split.json"),
        cameras=read_cameras(ingest / "cameras.parquet"),
        fitted=read_poses(inputs["fit"] / "poses.parquet"),
        trained=read_poses(inputs["train"] / "poses.parquet"),
        keypoints=read_keypoints(ingest / "keypoints.parquet"),
    )


def evenly(items: Sequence[Item], count: int) -> list[Item]:
    """At most ``count`` of the items, evenly spaced, first and last included."""
    if count >= len(items):
        return list(items)
    if count == 1:
        return [items[len(items) // 2]]
    return [items[round(i * (len(items) - 1) / (count - 1))] for i in range(count)]
