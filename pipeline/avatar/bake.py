"""A finished avatar whose pose-independent part is computed once and for all.

``Avatar.gaussians`` decodes the static part once, too. Baking goes on from there: the features are gone, and
in their place stands what the first layer of each pose head makes of them, ``W_f f_i + b``; static offsets
are part of the rest shape; of the skinning weights and the expressions only what is not zero is kept; and
neither the triplane nor the body model is needed any more. Posing has no gradient.
"""

from __future__ import annotations

import dataclasses

import roma
import torch
from torch import Tensor, nn

from pipeline.avatar.avatar import LARGEST_SCALE, LOG_SCALE_RANGE, Avatar, Decoded, pose_features
from pipeline.avatar.fused_head import HeadParameters, arranged, arranged_rows, finish
from pipeline.avatar.head import Head
from pipeline.avatar.residual import encode, time_code
from pipeline.avatar.skinning_tables import SkinningTables
from pipeline.body import Pose, joint_transforms
from pipeline.device import product_dtype
from pipeline.splat import Gaussians


@dataclasses.dataclass(frozen=True)
class BakedHead:
    """A head whose first layer is done as far as it can be.

    Attributes:
        products: [N, C], ``W_f f_i + b``, in the precision that the head runs in.
        condition: [C, P] float32, what the shared vector is multiplied with.
        own: [E, C] float32, what a point's own further inputs are multiplied with.
        layers: the others, arranged (see ``fused_head.py``).
    """

    products: Tensor  # [N, C]
    condition: Tensor  # [C, P]
    own: Tensor  # [E, C]
    layers: HeadParameters

    def __call__(self, shared: Tensor, own: Tensor | None = None) -> Tensor:
        """Decodes a shared vector [P] and each point's own inputs [N, E] to [N, outputs] float32."""
        own = torch.zeros(len(self.products), 0) if own is None else own
        return finish(self.products, self.condition @ shared, (own, self.own), self.layers).float()


@dataclasses.dataclass(frozen=True)
class BakedResidual:
    """One part's residual colours.

    Attributes:
        rows: [M] int64, which Gaussians.
        head: of the part; its products are those of the encoded places, where these do not change.
    """

    rows: Tensor  # [M]
    head: BakedHead


@dataclasses.dataclass(frozen=True)
class Constants:
    """The constants of body and static heads that every pose needs.

    Attributes:
        points: [N, 3], rest vertices and static offsets, metres.
        expressive: [M] int64, the points that expressions move.
        expressions: [M, 3, E], metres a unit of expression.
        correctives: [N, 3, 486] bfloat16, the body's pose correctives; [0, 3, 486] if it has none.
        scales: [N, 3], standard deviations before they change with the pose's log scales, metres.
        log_scale, color_logit: [N, 3], of the static heads.
        offset_unit: [N, 1], metres that a pose head's output of 1 stands for.
        joints: [55, 3], metres.
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


@dataclasses.dataclass(frozen=True)
class BakedAvatar:
    """An avatar that can be posed and nothing else.

    Attributes:
        constants: of the body and of the static heads.
        skinning_tables: of the mesh.
        parents: of the joints, -1 for the root.
        opacity: of every Gaussian.
        geometry, color: the pose heads; None if the avatar has none that are active.
        residuals: the parts' residual colours.
        time_range: [2], seconds of the first and the last training frame.
        place_frequencies, time_frequencies: of the residuals' encodings.
        posed_place: whether the residuals are told posed centres: then nothing of them is baked.
        residual_unit: metres that a residual head's move of 1 stands for; 0 where they move nothing.
    """

    constants: Constants
    skinning_tables: SkinningTables
    parents: tuple[int, ...]
    opacity: float
    geometry: BakedHead | None
    color: BakedHead | None
    residuals: dict[str, BakedResidual]
    time_range: Tensor
    place_frequencies: int
    time_frequencies: int
    posed_place: bool
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
            theta: the heads' pose condition; that of ``pose`` if None.
        """
        constants, theta = self.constants, pose_features(pose.rotation) if theta is None else theta
        transforms = joint_transforms(pose.rotation[None], constants.joints, self.parents)[0]
        points = self._rest_shape(pose)
        log_scale, color_logit = constants.log_scale, constants.color_logit
        if self.geometry is not None and self.color is not None:
            normals = self.skinning_tables.normals(transforms, points)
            change = self.geometry(theta)
            points = torch.addcmul(points, change[:, :3], constants.offset_unit)
            log_scale = log_scale + 0.5 * change[:, 3:]
            color_logit = color_logit + self.color(theta, normals)
        means, quaternions = self.skinning_tables.place(transforms, points, pose.transl)
        answers = self._residuals(means, theta, time)
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
            opacities=torch.full((len(points),), self.opacity),
        )

    def _rest_shape(self, pose: Pose) -> Tensor:
        """The points before skinning, a copy: [N, 3]."""
        constants = self.constants
        moved = constants.expressions[..., : len(pose.expression)] @ pose.expression
        points = constants.points.index_add(0, constants.expressive, moved)
        if not len(constants.correctives):
            return points
        turned = (roma.rotvec_to_rotmat(pose.rotation[1:]) - torch.eye(3)).flatten()
        return points + (constants.correctives @ turned.to(constants.correctives.dtype)).float()

    def _residuals(self, means: Tensor, theta: Tensor, time: float | None) -> list[tuple[Tensor, Tensor]]:
        """Each part's rows and its head's output, [M, 3] logits or [M, 6] with moves."""
        if not self.residuals:
            return []
        condition = torch.cat([time_code(time, self.time_range, self.time_frequencies), theta])
        answers = []
        for part in self.residuals.values():
            own = encode(means[part.rows], self.place_frequencies) if self.posed_place else None
            answers.append((part.rows, part.head(condition, own)))
        return answers


@torch.no_grad()
def bake(avatar: Avatar) -> BakedAvatar:
    """Computes the pose-independent part of a finished avatar on the CPU; the avatar is left as it is.

    What the visibility gate took is not in it, whatever ``Avatar.unseen`` says.
    """
    decoded = avatar.decode()
    surface, features = decoded.surface, decoded.features
    dtype = product_dtype(avatar.device, avatar.half_precision)
    heads: list[BakedHead | None] = [None, None]
    if avatar.pose_heads_active:
        heads = [
            _baked_head(avatar.pose_geometry, features, dtype),
            _baked_head(avatar.pose_color, features, dtype),
        ]
    residuals, networks = dict[str, BakedResidual](), avatar.residuals
    posed = networks.place == "posed"
    if avatar.residuals_active:
        for region in surface.residual:
            known = region.encoded[:, :0] if posed else region.encoded
            residuals[region.part] = BakedResidual(
                region.rows, _baked_head(networks.heads[region.part], known, dtype)
            )
    return BakedAvatar(
        constants=_constants(avatar, decoded),
        skinning_tables=surface.skinning_tables,
        parents=surface.canonical.parents,
        opacity=avatar.architecture.opacity,
        geometry=heads[0],
        color=heads[1],
        residuals=residuals,
        time_range=networks.time_range.clone(),
        place_frequencies=networks.place_frequencies,
        time_frequencies=networks.time_frequencies,
        posed_place=posed,
        residual_unit=avatar.architecture.pose_offset_unit if residuals and networks.outputs > 3 else 0.0,
    )


def _baked_head(head: nn.Module, points: Tensor, dtype: torch.dtype) -> BakedHead:
    """The head for given points [N, I]; inputs of the first layer beyond these I stay inputs."""
    assert isinstance(head, Head) and head.condition is not None
    layers = HeadParameters.of([head.first, *head.hidden, head.last], list(head.norms))
    ready, groups, known = arranged(layers, dtype), layers.groups, points.shape[1]
    first = arranged_rows(head.first.weight, groups)
    products = torch.addmm(arranged_rows(head.first.bias, groups), points, first[:, :known].t())
    # The first layer's own weights have done their work.
    rest = dataclasses.replace(ready, weights=(ready.weights[0][:, :0], *ready.weights[1:]))
    condition = arranged_rows(head.condition.weight, groups).contiguous()
    return BakedHead(products.to(dtype), condition, first[:, known:].t().contiguous(), rest)


def _constants(avatar: Avatar, decoded: Decoded) -> Constants:
    canonical, sizes = decoded.surface.canonical, avatar.architecture
    expressive = torch.nonzero(canonical.expression_directions.flatten(1).any(1))[:, 0]
    correctives, across = canonical.pose_directions, canonical.spacing * sizes.scale
    return Constants(
        points=canonical.vertices + decoded.offset,
        expressive=expressive,
        expressions=canonical.expression_directions[expressive].contiguous(),
        correctives=torch.zeros(0, 3, 0) if correctives is None else correctives.bfloat16(),
        scales=torch.cat([across, across.mean(1, keepdim=True) * sizes.thickness], 1),
        log_scale=decoded.log_scale.contiguous(),
        color_logit=decoded.color_logit.contiguous(),
        offset_unit=sizes.pose_offset_unit * decoded.surface.pose_movable,
        joints=canonical.joints,
    )
