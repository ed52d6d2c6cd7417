"""The clip that an avatar is compared with: fitted, with training frames in the poses that training left."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pipeline.body import BodyModel, Pose, Poses, read_poses
from pipeline.clip.composite import BLACK, composite_frame
from pipeline.clip.fitted_clip import FittedClip, read_fitted_clip

OTHER_CAMERA_ANGLE = 5.0
"""Degrees about the person between a camera and every training camera, from which it is another one."""


@dataclasses.dataclass(frozen=True)
class EvaluatedClip(FittedClip):
    """A fitted clip with the training frames' poses as training left them.

    Attributes:
        trained: poses of training frames.
        photographed: the truth has the photograph's colours in the mask's soft edge, not the person's own.
    """

    trained: Poses
    photographed: bool = False

    def pose(self, frame: int) -> Pose:
        """The pose that a frame is rendered in.

        A training frame has the pose that training refined. A held-out frame has the fit's, which
        knows its keypoints and nothing else of the image. (Poses refined on the held-out images
        themselves are in ``test_pose_refinement.py``; their numbers stand beside these.)
        """
        refined = frame not in self.split.test and frame in self.trained.frames
        return (self.trained if refined else self.poses).pose(frame)

    def shown_poses(self) -> Poses:
        """The pose of every frame, as ``pose`` gives it."""
        return Poses.stack(self.poses.frames, [self.pose(frame) for frame in self.poses.frames])

    def frames_a_second(self) -> float:
        """How many of the kept frames a second has; 0 where the source has no clock."""
        times = sorted(self.seconds.values())
        return 0.0 if len(times) < 2 or times[-1] <= times[0] else (len(times) - 1) / (times[-1] - times[0])

    def person(self, frame: int, background: str = BLACK) -> Tensor:
        """The person on a background, [H, W, 3] float32 in [0, 1]."""
        return composite_frame(self.true_colors(frame), self.mask(frame), background)

    def true_colors(self, frame: int) -> np.ndarray:
        """The colours that every picture is compared with, [H, W, 3] uint8 RGB."""
        return self.frame(frame) if self.photographed else self.colors(frame)

    def points(self, frame: int) -> np.ndarray | None:
        """The frame's 133 whole-body points with scores, [133, 3]; None where none were looked for."""
        try:
            return self.keypoints.whole_body[self.keypoints.index(frame)]
        except KeyError:
            return None

    def follows(self, first: int, second: int) -> bool:
        """True where the second frame is the next that was kept after the first."""
        return first in self._places and self._places.get(second) == self._places[first] + 1

    @cached_property
    def other_cameras(self) -> frozenset[int]:
        """The held-out frames whose camera stands elsewhere than every training frame's does.

        A camera that walks around passes between the places that it was seen from; only a view that is
        ``OTHER_CAMERA_ANGLE`` or more off, as seen from the person, is another one.
        """
        person = self.poses.transl.mean(0)

        def directions(frames: Sequence[int]) -> Tensor:
            centres = torch.stack([self.cameras[frame].centre for frame in frames]) - person
            return torch.nn.functional.normalize(centres, dim=1)

        if not self.split.test:
            return frozenset()
        cosines = (directions(self.split.test) @ directions(self.split.train).mT).amax(1)
        far = cosines < math.cos(math.radians(OTHER_CAMERA_ANGLE))
        return frozenset(frame for frame, other in zip(self.split.test, far.tolist(), strict=True) if other)

    @cached_property
    def _places(self) -> Mapping[int, int]:
        """Frame -> its place among the kept frames."""
        return {frame: place for place, frame in enumerate(sorted(self.cameras))}


def read_evaluated_clip(
    inputs: Mapping[str, Path], body: BodyModel | Path, photographed: bool = False
) -> EvaluatedClip:
    """Reads what the upstream stages published.

    Args:
        inputs: the folders of ingest, fit and train.
        body: the body model that the clip was fitted with, or its file.
        photographed: see ``EvaluatedClip``.

    Raises:
        UserError: a file is missing or damaged.
    """
    fitted = read_fitted_clip(inputs["ingest"], inputs["fit"], body)
    parts = {field.name: getattr(fitted, field.name) for field in dataclasses.fields(fitted)}
    return EvaluatedClip(
        **parts, trained=read_poses(inputs["train"] / "poses.parquet"), photographed=photographed
    )
