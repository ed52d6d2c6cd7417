"""Refinement of the training frames' poses, jointly with the avatar (paper, Section 3.6)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from pipeline.body import Pose, Poses
from pipeline.device import moved


class PoseRefinement(nn.Module):
    """The refined poses: a change of pose for every frame that may move.

    Each frame has parameters of its own: in one tensor for all frames, Adam's momentum would go on
    moving frames that were not drawn.
    """

    def __init__(self, poses: Poses, frames: tuple[int, ...]):
        """Starts at the fitted poses.

        Args:
            poses: of the whole clip; the changes are where they are.
            frames: the frame numbers whose poses may change: the training frames.
        """
        super().__init__()
        self.poses = poses
        first = poses.pose(poses.frames[0])
        self.rotation, self.expression = _each(frames, first.rotation), _each(frames, first.expression)
        self.transl = _each(frames, first.transl)

    def fitted(self, frame: int) -> Pose:
        """The pose that the fit gave a frame."""
        return self.poses.pose(frame)

    def forward(self, frame: int) -> Pose:
        """The refined pose of a training frame, the fitted pose of any other."""
        pose, name = self.fitted(frame), str(frame)
        if name not in self.rotation:
            return pose
        return Pose(
            pose.rotation + self.rotation[name],
            pose.expression + self.expression[name],
            pose.transl + self.transl[name],
        )

    def change(self, frame: int) -> Tensor:
        """The change of a training frame's pose, [D]: radians, expression units, decimetres."""
        name = str(frame)
        return torch.cat([self.rotation[name].flatten(), self.expression[name], 10 * self.transl[name]])

    def refined(self, frames: tuple[int, ...] | None = None) -> Poses:
        """Poses as they now are, of all frames or of some; on the CPU."""
        frames = self.poses.frames if frames is None else frames
        with torch.no_grad():
            return moved(Poses.stack(frames, [self(frame) for frame in frames]), "cpu")


def _each(frames: tuple[int, ...], pose: Tensor) -> nn.ParameterDict:
    return nn.ParameterDict({str(frame): nn.Parameter(torch.zeros_like(pose)) for frame in frames})
