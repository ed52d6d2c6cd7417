"""A motion as it was captured, on the joints of the SMPL-X schema, and which of its frames are wanted."""

from __future__ import annotations

import dataclasses

import numpy as np
from torch import Tensor

from pipeline.body import BodyModel, Identity, joint_index, mean_identity, rest_joints
from pipeline.errors import UserError

USUAL_FPS = 30.0
MOST_FRAMES = 200_000
_LEG = ("left_hip", "left_knee", "left_ankle")


@dataclasses.dataclass(frozen=True)
class Motion:
    """A body's motion, T frames, float32. The world is Y up; a body that is not turned faces +Z.

    Attributes:
        name: of the file, for people.
        fps: frames a second.
        numbers: [T] the frames' numbers in the source.
        rotation: [T, 55, 3], rotation vectors, radians, relative to the parent joint; zero where the motion
            tells nothing of a joint.
        expression: [T, E], or None where the motion has none that this body can read.
        root: [T, 3], metres, where the pelvis is; only differences between frames mean anything.
        leg: metres from hip to ankle of whoever ``root`` belongs to.
        told: the schema's joints that the motion tells of.
        unused: the source's joints that have no counterpart in the schema.
        faces_camera: whether +Z is where a camera stood. Else the first frame says what front is.
        notes: what a user should know of the reading, a sentence each.
    """

    name: str
    fps: float
    numbers: tuple[int, ...]
    rotation: Tensor  # [T, 55, 3]
    expression: Tensor | None  # [T, E]
    root: Tensor  # [T, 3]
    leg: float
    told: tuple[str, ...]
    unused: tuple[str, ...] = ()
    faces_camera: bool = False
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.rotation)


@dataclasses.dataclass(frozen=True)
class Span:
    """The frames of a source that are wanted, and their rate.

    Attributes:
        first, last: numbers of frames in the source, both included; -1 is the last there is.
        fps: frames a second of the result; 0 leaves every n-th frame of the source, as near to 30 a second
            as that comes.
    """

    first: int = 0
    last: int = -1
    fps: float = 0.0

    def rows(self, available: int, own_fps: float, name: str) -> tuple[np.ndarray, float]:
        """The frames of a source to take, in order, and their rate: [T] int64 and frames a second.

        Args:
            available: how many frames the source has.
            own_fps: of the source.
            name: of the source, for messages.

        Raises:
            UserError: none of its frames is in the range, or there are too many.
        """
        last = available - 1 if self.last < 0 else min(self.last, available - 1)
        if self.first > last:
            end = "the end" if self.last < 0 else str(self.last)
            raise UserError(
                f"{name} has frames 0 to {available - 1}, none between {self.first} and {end}: change "
                "animate.first_frame and animate.last_frame"
            )
        if self.fps == 0:
            step = max(1, round(own_fps / USUAL_FPS))
            rows, fps = np.arange(self.first, last + 1, step), own_fps / step
        else:
            count = min(max(1, int((last - self.first + 1) * self.fps / own_fps)), MOST_FRAMES + 1)
            rows = self.first + np.round(np.arange(count) * own_fps / self.fps).astype(np.int64)
            rows, fps = np.minimum(rows, last), self.fps
        if len(rows) > MOST_FRAMES:
            raise UserError(f"{name}: {len(rows)} frames are too many; choose some with animate.last_frame")
        return rows, fps


def leg_length(body: BodyModel, betas: Tensor | None = None, identity: Identity | None = None) -> float:
    """From the left hip by the knee to the ankle at rest, metres: of an identity, a shape, or the mean."""
    if identity is None:
        identity = mean_identity(body)
        if betas is not None:
            known = body.shape_directions.shape[2]
            identity = dataclasses.replace(identity, betas=betas[:known])
    joints = rest_joints(body, identity)
    hip, knee, ankle = (joints[joint_index(name)] for name in _LEG)
    return float((hip - knee).norm() + (knee - ankle).norm())
