"""A finished avatar as skinned points with linear bases: all that a small program needs to pose it.

Linear bases are such already. A triplane's heads, and the pose correctives of a body that has them, are
replaced by the linear bases that come nearest to them over the clip's own poses (least squares on the driving
signal); the rest of the way, expression and skinning, is the same for both. Residual heads are asked without
a clock, as for a motion that was never filmed, and what they move is left out.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from pipeline.avatar.avatar import LARGEST_SCALE, LOG_SCALE_RANGE, Avatar, scaled_residual
from pipeline.avatar.bake import BakedAvatar, bake
from pipeline.avatar.bases_representation import BakedBases
from pipeline.avatar.driving_signal import DrivingSignal, fit_driving_signal, signal_features
from pipeline.avatar.posed import pose_features
from pipeline.avatar.representation import Condition
from pipeline.body import Pose, joint_transforms
from pipeline.clip.frames import spread_end_to_end
from pipeline.errors import UserError

POSES = 48  # of a clip that bases are fitted to, spread over it
MOST_BASES = 16
POSES_A_BASE = 3  # at least so many, or what is fitted to them tells nothing of any other


@dataclasses.dataclass(frozen=True)
class LinearAvatar:
    """N Gaussians in the rest pose, and what moves and colours them. Float32, metres, on the CPU.

    Attributes:
        points: [N, 3], at rest.
        expressive: [M] int64, the points that expressions move.
        expressions: [M, 3, E], metres a unit of expression.
        joints_of, weights: [N, K] uint8 and float32, the joints that carry each, the heaviest first.
        frames: [N, 3, 3], the Gaussians' axes at rest.
        scales: [N, 3], standard deviations.
        color_logit: [N, 3].
        color_bases: [N, 3, B], logits that a driving signal of 1 adds.
        move_bases: [N, 3, B], metres that it adds before skinning.
        signal: pose and expression to B numbers.
        joints: [55, 3], at rest.
        parents: of the joints, -1 for the root.
        opacities: [N].
        trust: [N] in [0, 1], how far frames showed each one's colour.
        parts: [N] int64, an index into ``pipeline.body.PARTS``.
    """

    points: Tensor
    expressive: Tensor
    expressions: Tensor
    joints_of: Tensor
    weights: Tensor
    frames: Tensor
    scales: Tensor
    color_logit: Tensor
    color_bases: Tensor
    move_bases: Tensor
    signal: DrivingSignal
    joints: Tensor
    parents: tuple[int, ...]
    opacities: Tensor
    trust: Tensor
    parts: Tensor

    def __len__(self) -> int:
        """The number of Gaussians."""
        return len(self.points)


@torch.no_grad()
def linear_avatar(avatar: Avatar, poses: Sequence[Pose] = ()) -> LinearAvatar:
    """An avatar as skinned points with linear bases.

    Args:
        avatar: finished, or as a checkpoint left it; on the CPU.
        poses: of the clip, to which the bases of a triplane are fitted; without any it keeps its colours and
            shape in the rest pose.

    Raises:
        UserError: the gate left none of its Gaussians.
    """
    if not bool(avatar.active.any()):
        raise UserError("the visibility gate left none of the avatar's Gaussians: train it again")
    surface = avatar.surface()
    baked = bake(avatar)
    constants, tables = baked.constants, baked.skinning_tables
    expressions = surface.canonical.expression_directions.shape[-1]
    if isinstance(baked.representation, BakedBases) and not len(constants.correctives):
        signal, mean, bases = _own_bases(baked, baked.representation)
    else:
        signal, mean, bases = _fitted_bases(baked, poses, expressions)
    log_scale = constants.log_scale + mean[:, 6:]
    scales = constants.scales * log_scale.clamp(*LOG_SCALE_RANGE).exp()
    return LinearAvatar(
        points=constants.points + mean[:, 3:6],
        expressive=constants.expressive,
        expressions=constants.expressions,
        joints_of=tables.joints_of,
        weights=tables.weights,
        frames=tables.frames,
        scales=scales.clamp_max(LARGEST_SCALE),
        color_logit=constants.color_logit + mean[:, :3],
        color_bases=bases[:, :3],
        move_bases=bases[:, 3:],
        signal=signal,
        joints=constants.joints,
        parents=baked.parents,
        opacities=baked.opacities,
        trust=surface.pick(avatar.trust)[:, 0],
        parts=surface.canonical.parts,
    )


def _own_bases(baked: BakedAvatar, own: BakedBases) -> tuple[DrivingSignal, Tensor, Tensor]:
    """The signal, a mean of zero [N, 9] and the bases [N, 6, B] of linear bases, in logits and metres."""
    count, used = len(baked), len(own.signal) if own.bases.shape[1] else 0
    signal = own.signal
    if not used:  # the bases sleep
        signal = DrivingSignal(signal.mean, signal.components[:0], signal.limits[:, :0])
    bases = own.bases.reshape(count, 6, used).clone()
    share = baked.constants.pose_share
    if share is not None:
        bases *= share.repeat_interleave(3, 1)[..., None]
    bases[:, 3:] *= baked.constants.offset_unit[..., None]
    return signal, bases.new_zeros(count, 9), bases


def _fitted_bases(
    baked: BakedAvatar, poses: Sequence[Pose], expressions: int
) -> tuple[DrivingSignal, Tensor, Tensor]:
    """The signal of some poses, and mean [N, 9] and bases [N, 6, B] nearest to what follows them."""
    shown = [poses[place] for place in spread_end_to_end(range(len(poses)), POSES)] if len(poses) else []
    shown = shown or [Pose(torch.zeros(55, 3), torch.zeros(expressions), torch.zeros(3))]
    features = torch.stack(
        [signal_features(pose_features(pose.rotation), pose.expression, expressions) for pose in shown]
    )
    signal = fit_driving_signal(features, min(MOST_BASES, len(shown) // POSES_A_BASE))
    told = torch.stack([signal(row) for row in features])  # [F, B]
    design = torch.linalg.pinv(torch.cat([torch.ones(len(shown), 1), told], 1))  # [1 + B, F]
    count = len(baked)
    fitted = torch.zeros(1 + len(signal), count, 9)
    for pose, weights in zip(shown, design.T, strict=True):
        fitted += weights[:, None, None] * _followed(baked, pose)
    return signal, fitted[0], fitted[1:, :, :6].permute(1, 2, 0).contiguous()


def _followed(baked: BakedAvatar, pose: Pose) -> Tensor:
    """What follows a pose before skinning: colour in logits, offset in metres, log scale; [N, 9]."""
    constants = baked.constants
    found = torch.zeros(len(baked), 9)
    rest = baked.rest_shape(pose)
    if len(constants.correctives):
        without = dataclasses.replace(constants, correctives=torch.zeros(0))
        found[:, 3:6] += rest - dataclasses.replace(baked, constants=without).rest_shape(pose)
    transforms = joint_transforms(pose.rotation[None], constants.joints, baked.parents)[0]
    condition = Condition(pose_features(pose.rotation), pose.expression, None)
    share = constants.pose_share
    change = baked.representation.change(condition, lambda: baked.skinning_tables.normals(transforms, rest))
    if change is not None:
        change = change if share is None else change.scaled(share)
        found[:, :3] += change.color_logit
        found[:, 3:6] += change.offset * constants.offset_unit
        if change.log_scale is not None:
            found[:, 6:] += change.log_scale
    means, _ = baked.skinning_tables.place(transforms, rest + found[:, 3:6], pose.transl)
    for rows, answer in baked.representation.residuals(means, condition):
        found[rows, :3] += (answer if share is None else scaled_residual(answer, share[rows]))[:, :3]
    return found
