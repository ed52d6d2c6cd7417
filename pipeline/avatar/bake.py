"""A finished avatar whose pose-independent part is computed once and for all.

``Avatar.gaussians`` decodes the static part once, too. Baking goes on from there: the representation keeps
only what a pose needs (``Representation.bake``); static offsets are part of the rest shape; of the skinning
weights and the expressions only what is not zero is kept; and the body model is not needed any more. Posing
has no gradient.
"""

from __future__ import annotations

import dataclasses
import functools

import roma
import torch
from torch import Tensor

from pipeline.avatar.avatar import Avatar
from pipeline.avatar.fused_posing import PosingTables, pose_at_once
from pipeline.avatar.posed import (
    LARGEST_SCALE,
    LOG_SCALE_RANGE,
    initial_scales,
    pose_features,
    scaled_residual,
)
from pipeline.avatar.representation import BakedRepresentation, Condition, Decoded, LinearChange
from pipeline.avatar.skinning_tables import SkinningTables
from pipeline.body import Pose, joint_transforms
from pipeline.splat import Gaussians


@dataclasses.dataclass(frozen=True)
class Constants:
    """The constants of body and static heads that every pose needs.

    Attributes:
        points: [N, 3], rest vertices and static offsets, metres.
        expressive: [M] int64, the points that expressions move.
        expressions: [M, 3, E], metres a unit of expression.
        correctives: [P, 3, 486] bfloat16, the body's pose correctives; [0, 3, 486] if it has none.
        scales: [N, 3], standard deviations before they change with the pose's log scales, metres.
        log_scale, color_logit: [N, 3], of the static heads.
        offset_unit: [N, 1], metres that a pose-dependent offset of 1 stands for.
        joints: [55, 3], metres.
        pose_share: [N, 2], the share that is shown of what follows the pose, colour and shape; None for all.
        corrected: [P] int64, the points that correctives move; None for all.
    """

    points: Tensor
    expressive: Tensor
    expressions: Tensor
    correctives: Tensor
    scales: Tensor
    log_scale: Tensor
    color_logit: Tensor
    offset_unit: Tensor
    joints: Tensor
    pose_share: Tensor | None = None
    corrected: Tensor | None = None


@dataclasses.dataclass(frozen=True)
class BakedAvatar:
    """An avatar that can be posed and nothing else.

    Attributes:
        constants: of the body and of the static heads.
        skinning_tables: of the mesh.
        parents: of the joints, -1 for the root.
        opacities: [N], of the Gaussians.
        representation: the pose-dependent part.
        residual_unit: metres that a residual head's move of 1 stands for; 0 where they move nothing.
    """

    constants: Constants
    skinning_tables: SkinningTables
    parents: tuple[int, ...]
    opacities: Tensor
    representation: BakedRepresentation
    residual_unit: float = 0.0

    def __len__(self) -> int:
        """The number of Gaussians."""
        return len(self.constants.points)

    @torch.no_grad()
    def gaussians(
        self,
        pose: Pose,
        time: float | None = None,
        theta: Tensor | None = None,  # [54 * 6]
    ) -> Gaussians:
        """The avatar in a pose, world coordinates; as ``Avatar.gaussians``, without gradient.

        Args:
            pose: of the body, in the world.
            time: seconds from the clip's start, or None, for the residual colours.
            theta: the pose that the representation is told; that of ``pose`` if None.
        """
        constants, theta = self.constants, pose_features(pose.rotation) if theta is None else theta
        transforms = joint_transforms(pose.rotation[None], constants.joints, self.parents)[0]
        condition = Condition(theta, pose.expression, time)
        linear = self.representation.linear_change(condition)
        if linear is not None and not len(constants.correctives) and constants.pose_share is None:
            return self._pose_at_once(linear, transforms, pose)
        points = rest = self.rest_shape(pose)
        log_scale, color_logit = constants.log_scale, constants.color_logit
        change = self.representation.change(condition, lambda: self.skinning_tables.normals(transforms, rest))
        share = constants.pose_share
        if change is not None:
            change = change if share is None else change.scaled(share)
            points = torch.addcmul(points, change.offset, constants.offset_unit)
            log_scale = log_scale if change.log_scale is None else log_scale + change.log_scale
            color_logit = color_logit + change.color_logit
        means, quaternions = self.skinning_tables.place(transforms, points, pose.transl)
        answers = self.representation.residuals(means, condition)
        if share is not None:
            answers = [(rows, scaled_residual(answer, share[rows])) for rows, answer in answers]
        if self.residual_unit:
            for rows, answer in answers:
                points = points.index_add(0, rows, self.residual_unit * answer[:, 3:])
            means, quaternions = self.skinning_tables.place(transforms, points, pose.transl)
        for rows, answer in answers:
            color_logit = color_logit.index_add(0, rows, answer[:, :3])
        scales = constants.scales * log_scale.clamp(*LOG_SCALE_RANGE).exp_()
        return Gaussians(
            means=means,
            quaternions=quaternions,
            scales=scales.clamp_(max=LARGEST_SCALE),
            colors=color_logit.sigmoid(),
            opacities=self.opacities.clone(),
        )

    def _pose_at_once(self, change: LinearChange, transforms: Tensor, pose: Pose) -> Gaussians:
        """As ``gaussians`` does step by step, in one pass over the Gaussians."""
        learnt = (None, self.constants.log_scale, self.constants.color_logit, change)
        posed = pose_at_once(self.posing_tables, *learnt, transforms, pose.transl, pose.expression)
        colors, opacities = posed.colors, self.opacities.clone()
        return Gaussians(posed.means, posed.quaternions, posed.scales, colors, opacities)

    @functools.cached_property
    def posing_tables(self) -> PosingTables:
        """The tables that posing in one pass reads."""
        constants = self.constants
        return PosingTables.build(
            self.skinning_tables,
            constants.points,
            constants.expressive,
            constants.expressions,
            constants.scales,
            constants.offset_unit,
            (*LOG_SCALE_RANGE, LARGEST_SCALE),
        )

    def rest_shape(self, pose: Pose) -> Tensor:
        """The points before skinning, a copy: [N, 3]."""
        constants = self.constants
        moved = constants.expressions[..., : len(pose.expression)] @ pose.expression
        points = constants.points.index_add(0, constants.expressive, moved)
        if not len(constants.correctives):
            return points
        turned = (roma.rotvec_to_rotmat(pose.rotation[1:]) - torch.eye(3)).flatten()
        corrected = (constants.correctives @ turned.to(constants.correctives.dtype)).float()
        rows = constants.corrected
        return points + corrected if rows is None else points.index_add(0, rows, corrected)


@torch.no_grad()
def bake(avatar: Avatar) -> BakedAvatar:
    """Computes the pose-independent part of a finished avatar on the CPU; the avatar is left as it is.

    What the visibility gate took is not in it, whatever ``Avatar.unseen`` says.
    """
    decoded, sizes = avatar.decode(), avatar.architecture
    surface = decoded.surface
    moves = sizes.residual_moves and avatar.residuals_active and bool(surface.residual)
    return BakedAvatar(
        constants=_constants(avatar, decoded),
        skinning_tables=surface.skinning_tables,
        parents=surface.canonical.parents,
        opacities=avatar.opacities(surface),
        representation=avatar.representation.bake(decoded, avatar.pose_heads_active, avatar.residuals_active),
        residual_unit=sizes.pose_offset_unit if moves else 0.0,
    )


def _constants(avatar: Avatar, decoded: Decoded) -> Constants:
    canonical, sizes = decoded.surface.canonical, avatar.architecture
    expressive, expressions = canonical.expressive()
    correctives = canonical.pose_directions
    joints, moved = avatar.identity_changes(decoded.surface)
    points = canonical.vertices + decoded.offset
    return Constants(
        points=points if moved is None else points + moved,
        expressive=expressive,
        expressions=expressions,
        correctives=torch.zeros(0, 3, 0) if correctives is None else correctives.bfloat16(),
        scales=initial_scales(canonical, sizes),
        log_scale=decoded.log_scale.contiguous(),
        color_logit=decoded.color_logit.contiguous(),
        offset_unit=sizes.pose_offset_unit * decoded.surface.pose_movable,
        joints=joints,
        pose_share=avatar.pose_share(decoded.surface),
        corrected=canonical.corrected,
    )
