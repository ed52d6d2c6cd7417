"""One frame's Gaussians in one pass on a CPU, for an avatar whose pose-dependent part is linear.

``Avatar.pose`` says what is computed, step by step: bases, expression, skinning, scales and colours. Each of
its steps reads and writes every Gaussian; here all of them are done while a Gaussian is at hand, forward and
backward. Nothing is gathered: the gradient of the bases is written where the bases lie.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pipeline.avatar.posing_arrays import Frame, Learnt, Pushed, Still
from pipeline.avatar.representation import LinearChange
from pipeline.avatar.skinning_kernels import CHUNKS, pose_backward, pose_forward
from pipeline.avatar.skinning_tables import SkinningTables
from pipeline.numba_kernels import use_torch_threads


@dataclasses.dataclass(frozen=True)
class PosingTables:
    """The arrays that posing reads of a surface, and the directions in which the expression moves it.

    Attributes:
        still: of the kernels.
        expressions: [P, 3, E], of the P points that expressions move, metres a unit.
    """

    still: Still
    expressions: Tensor  # [P, 3, E]

    @classmethod
    def build(
        cls,
        skinning: SkinningTables,
        points: Tensor,  # [N, 3]
        expressive: Tensor,  # [P]
        expressions: Tensor,  # [P, 3, E]
        initial_scales: Tensor,  # [N, 3]
        movable: Tensor,  # [N, 1]
        limits: tuple[float, float, float],
    ) -> PosingTables:
        """The tables of a mesh on the CPU.

        Args:
            skinning: of the mesh.
            points: at rest, metres.
            expressive: int64, the points that expressions move.
            expressions: of these, metres a unit of expression.
            initial_scales: standard deviations that a log scale of 0 stands for, metres.
            movable: metres that a pose-dependent offset of 1 stands for.
            limits: least and greatest log scale, and the largest scale, metres.
        """
        places = torch.full((len(points),), -1, dtype=torch.int32)
        places[expressive] = torch.arange(len(expressive), dtype=torch.int32)
        still = Still(
            points=_array(points),
            initial=_array(initial_scales),
            movable=_array(movable[:, 0]),
            joints=skinning.joints_of.numpy(),
            weights=skinning.weights.numpy(),
            frames=skinning.frames.numpy(),
            places=places.numpy(),
            limits=np.array(limits, np.float32),
        )
        return cls(still, expressions.contiguous())


@dataclasses.dataclass(frozen=True)
class PosedAtOnce:
    """One frame's Gaussians, but for their opacity; all [N, 3] but ``quaternions``.

    Attributes:
        means: in the world, metres.
        quaternions: [N, 4] wxyz, without gradient.
        scales: standard deviations, metres.
        colors: in [0, 1].
        color_logit: the same before the sigmoid.
        pose_offset: Delta V_pose, metres.
    """

    means: Tensor
    quaternions: Tensor
    scales: Tensor
    colors: Tensor
    color_logit: Tensor
    pose_offset: Tensor


def pose_at_once(
    tables: PosingTables,
    offset: Tensor | None,  # [N, 3]
    log_scale: Tensor,  # [N, 3]
    color_logit: Tensor,  # [N, 3]
    change: LinearChange,
    transforms: Tensor,  # [55, 3, 4]
    transl: Tensor,  # [3]
    expression: Tensor,  # [E]
) -> PosedAtOnce:
    """The Gaussians of one frame; gradients reach every tensor but the driving signal.

    Args:
        tables: of the surface.
        offset: static, metres; None for none.
        log_scale, color_logit: static.
        change: the bases and the signal that drives them.
        transforms: as ``pipeline.body.joint_transforms`` gives them.
        transl: metres.
        expression: may be shorter than the body's.
    """
    moved = tables.expressions[..., : len(expression)] @ expression
    offset = color_logit.new_zeros(0, 3) if offset is None else offset
    learnt = (offset, log_scale, color_logit, change.bases)
    return PosedAtOnce(*_Pose.apply(*learnt, transforms, transl, moved, change, tables.still))


class _Pose(torch.autograd.Function):
    """Parameters and a pose to the tensors of ``PosedAtOnce``."""

    @staticmethod
    def forward(ctx, offset, log_scale, color_logit, bases, transforms, transl, moved, change, still):
        use_torch_threads()
        count, pose_asked = len(color_logit), any(ctx.needs_input_grad[4:7])
        rows = np.empty(0, np.int64) if change.rows is None else change.rows.numpy()
        learnt = Learnt(*map(_array, (offset, log_scale, color_logit, bases)), rows)
        frame = Frame(
            _array(change.signal), _array(transforms).reshape(-1, 12), _array(transl), _array(moved)
        )
        quaternions = color_logit.new_empty(count, 4)
        means, scales, colors, logit, moves, shapes = color_logit.new_empty(6, count, 3)
        answer = (means, quaternions, scales, colors, logit, moves)
        shapes = shapes if pose_asked else shapes[:0]
        pose_forward(still, learnt, frame, *(one.numpy() for one in (*answer, shapes)))
        # Saving them makes torch complain if they were changed in place before the backward pass.
        ctx.save_for_backward(bases, log_scale, scales, colors)
        ctx.kernel_input, ctx.shapes = (still, learnt, frame), shapes
        ctx.mark_non_differentiable(quaternions)
        ctx.set_materialize_grads(False)
        return answer

    @staticmethod
    @once_differentiable
    def backward(ctx, g_means, _, g_scales, g_colors, g_color_logit, g_moves):
        use_torch_threads()
        bases, _, scales, colors = ctx.saved_tensors
        still, learnt, frame = ctx.kernel_input
        pushed = Pushed(*map(_array_or_none, (g_means, g_scales, g_colors, g_color_logit, g_moves)))
        count, joints = len(still.points), len(frame.transforms)
        offset, log_scale, color_logit = bases.new_empty(3, count, 3)
        # Where every row is a Gaussian's, all of it is written.
        g_bases = (torch.empty_like if len(bases) == count else torch.zeros_like)(bases)
        transforms, transl = bases.new_zeros(CHUNKS, joints, 12), bases.new_zeros(CHUNKS, 3)
        moved = bases.new_empty(frame.moved.shape)
        found = (offset, log_scale, color_logit, g_bases, transforms, transl, moved)
        drawn = (one.numpy() for one in (scales, colors, ctx.shapes))
        pose_backward(still, learnt, frame, *drawn, pushed, *(one.numpy() for one in found))
        pose = (transforms.sum(0).view(joints, 3, 4), transl.sum(0), moved)
        asked = zip((*found[:4], *pose), ctx.needs_input_grad, strict=False)
        return *(one if wanted else None for one, wanted in asked), None, None


def _array(tensor: Tensor) -> np.ndarray:
    """The tensor as a contiguous array, which is the one layout that kernels are compiled for."""
    return tensor.detach().contiguous().numpy()


def _array_or_none(gradient: Tensor | None) -> np.ndarray:
    return np.empty((0, 3), np.float32) if gradient is None else _array(gradient)
