"""The canonical avatar, and its Gaussians in a pose (the paper's Sections 3.3, 3.5 and 3.6).

Data flows: the representation's static part (offset, scale, colour) + what follows pose and face -> plus
expression -> linear blend skinning -> Gaussians. The representation (``representation.py``) is the paper's
triplane with its heads, or linear bases. The part before the pose is the same for every frame: ``decode``
once, ``pose`` as often as needed; a finished avatar does so by itself.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from pipeline.avatar.architecture import Architecture
from pipeline.avatar.bases_representation import BasesRepresentation
from pipeline.avatar.fused_posing import PosingTables, pose_at_once
from pipeline.avatar.identity_change import IdentityChange
from pipeline.avatar.levels import build_surfaces, finest_level
from pipeline.avatar.posed import (
    LARGEST_SCALE,
    LOG_SCALE_RANGE,
    Posed,
    initial_scales,
    pose_features,
    rest_shape,
    scaled_residual,
    scales_of,
)
from pipeline.avatar.representation import Condition, Decoded, LinearChange, Representation
from pipeline.avatar.skinning_tables import OWN, SkinningTables, nearest_rows, with_weights_of
from pipeline.avatar.surface import Surface, active_rows, restricted
from pipeline.avatar.triplane_representation import TriplaneRepresentation
from pipeline.body import BodyModel, Identity, Pose, blend_transforms, joint_transforms, transform_points
from pipeline.device import kernels_serve, moved
from pipeline.splat import Gaussians


class Avatar(nn.Module):
    """One person, animatable.

    Attributes:
        architecture: sizes.
        representation: what is learnt.
        vertex_ids: [K] int64, the body vertices that carry Gaussians; on the CPU, wherever the avatar is.
        identity: the fitted identity; on the CPU, too.
        body_digest: of the body model that it was built on.
        splits: rounds of edges whose splitting makes the finest level; none where subdivision does.
        surfaces: every level from the unsubdivided mesh to the finest, with nothing gated.
        active: [K] bool, these vertices that the visibility gate leaves; see ``surface``.
        unseen: what a finished avatar shows where it was gated, ``"nothing"`` or ``"base"``.
        pose_heads_active: whether what follows the pose takes part: pose heads or bases.
        residuals_active: whether the residual colour heads take part.
        residual_share: the share of their colours that is added; less than 1 while they come in.
        at_once: posed in one pass over the Gaussians where that can be (``fused_posing.py``), else step by
            step, which gives the same.
        identity_change: of betas and joint offsets; None where they are not learnt.
        opacity_logit: [N, 1], of the finest level; None where opacities are not learnt.
        base_color: [N, 3] logits on the finest level; what learnt colours are added to.
        skin_rows: [N] int64, the body vertex whose skinning weights each takes, see ``nearest_rows``.
        trust: [N, 2] in [0, 1], how far evidence bears out what was learnt of colour and of shape, see
            ``evidence.py``; 1 before that is known.
        completion: [N, 9], offset, log scale and colour logits of the finished avatar where the
            representation cannot hold them, see ``completion.py``; [0, 9] where it does not need to.
    """

    base_color: Tensor
    active: Tensor
    skin_rows: Tensor
    trust: Tensor
    completion: Tensor

    def __init__(
        self,
        body: BodyModel,
        identity: Identity,
        vertex_ids: Tensor,  # [K]
        architecture: Architecture,
        seed: int = 0,
        half_precision: bool = True,
        splits: Sequence[Tensor] = (),
    ):
        """A new avatar: the fitted body in grey.

        Args:
            body: the body model.
            identity: the subject's identity.
            vertex_ids: [K] int64, the body vertices that carry Gaussians, sorted.
            architecture: sizes.
            seed: of the initial weights.
            half_precision: heads in bfloat16 where that is faster, see ``pipeline.device.product_dtype``.
            splits: rounds of edges whose splitting makes the finest level, see ``density.py``; midpoint
                subdivision makes it if there are none.

        Raises:
            ValueError: ``splits`` name an edge that the mesh has not.
        """
        super().__init__()
        self.architecture, self.vertex_ids, self.identity = architecture, vertex_ids, identity
        self.body_digest, self.half_precision = body.digest, half_precision
        self.pose_heads_active, self.residuals_active = architecture.pose_heads, True
        self.residual_share, self.at_once = 1.0, True
        self.splits = tuple(splits)
        self.surfaces, self.boxes = build_surfaces(body, identity, vertex_ids, architecture, self.splits)
        count = len(self.surfaces[-1].canonical)
        finest = finest_level(architecture, self.splits), vertex_ids, self.splits
        learnt = IdentityChange(body, identity, *finest) if architecture.learn_identity else None
        self.identity_change = learnt
        first = torch.logit(torch.full((count, 1), architecture.opacity))
        self.opacity_logit = nn.Parameter(first) if architecture.learn_opacity else None
        self.register_buffer("base_color", torch.zeros(count, 3))
        self.register_buffer("active", torch.ones(len(vertex_ids), dtype=torch.bool))
        self.register_buffer("skin_rows", torch.full((count,), OWN))
        self.register_buffer("trust", torch.ones(count, 2))
        self.register_buffer("completion", torch.zeros(0, 9))
        self._own_surfaces = tuple(self.surfaces)
        self.unseen = "nothing"
        self._restricted: dict[int, tuple[Tensor, Surface]] = {}
        self._posing: tuple[Surface, PosingTables] | None = None
        self.representation = self._make_representation(seed)
        self._baked: Decoded | None = None

    def _make_representation(self, seed: int) -> Representation:
        sizes, canonical = self.architecture, self.surfaces[0].canonical
        pose = 6 * (len(canonical.joints) - 1)
        if sizes.representation == "bases":
            count, expressions = len(self.surfaces[-1].canonical), canonical.expression_directions.shape[-1]
            return BasesRepresentation(count, sizes.bases, pose, expressions, sizes.offset_unit, sizes.bends)
        parts = tuple(region.part for region in self.surfaces[0].residual)
        return TriplaneRepresentation(sizes, len(self.boxes), pose, parts, seed, self.half_precision)

    def __len__(self) -> int:
        """The number of Gaussians."""
        return len(self.surface().canonical)

    @property
    def device(self) -> torch.device:
        """The device of its weights and surfaces."""
        return self.active.device

    def to(self, device: torch.device | str) -> Avatar:  # type: ignore[override]
        """Moves weights and surfaces; their dtypes stay."""
        if torch.device(device) == self.device:
            return self
        super().to(device)
        self._own_surfaces = moved(self._own_surfaces, device)
        self.boxes = self.boxes.to(device)
        self.apply_skin()
        return self

    def gate(self, active: Tensor) -> None:
        """Leaves only some of the vertices; others may come back with a later call.

        Args:
            active: [K] bool, with at least one.

        Raises:
            ValueError: none is left.
        """
        if not bool(active.any()):
            raise ValueError("an avatar needs at least one active vertex")
        self.active.copy_(active)
        self._baked = None

    def surface(self, level: int = -1) -> Surface:
        """A level of subdivision without what is gated (the finest by default)."""
        full, level = self.surfaces[level], level % len(self.surfaces)
        if bool(self.active.all()):
            return full
        known = self._restricted.get(level)
        if known is None or not torch.equal(known[0], self.active):
            levels, splits = (0, self.splits) if self.splits and level else (level, ())
            rows = active_rows(self.surfaces[0].canonical, self.active, levels, splits)
            known = self._restricted[level] = self.active.clone(), restricted(full, rows)
        return known[1]

    @torch.no_grad()
    def reskin(self) -> None:
        """Gives points off head and hands the skinning weights of the vertex that they now lie nearest."""
        decoded = self.decode()
        points = decoded.surface.canonical.vertices + decoded.offset
        free = decoded.surface.pose_movable[:, 0] > 0
        rows = nearest_rows(points, self.surfaces[0].canonical.vertices, free)
        places = decoded.surface.pick(torch.arange(len(self.skin_rows), device=self.device))
        self.skin_rows.index_copy_(0, places, rows)
        self.apply_skin()

    def apply_skin(self) -> None:
        """Puts ``skin_rows`` into effect on every level; to be called when they have been loaded."""
        original = self._own_surfaces[0].canonical
        for level, own in enumerate(self._own_surfaces):
            mesh = with_weights_of(own.canonical, original, self.skin_rows[: len(own.canonical)])
            self.surfaces[level] = dataclasses.replace(
                own, canonical=mesh, skinning_tables=SkinningTables.build(mesh)
            )
        self._restricted.clear()
        self._baked = None

    def train(self, mode: bool = True) -> Avatar:
        """Sets the mode as ``nn.Module`` does, and forgets what was decoded: weights are about to change."""
        self._baked = None
        return super().train(mode)

    def decode(self, level: int = -1) -> Decoded:
        """The pose-independent part, on one level of subdivision (the finest by default)."""
        surface = self.surface(level)
        decoded = self.representation.decode(surface, surface.pick(self.base_color))
        if not len(self.completion):
            return decoded
        offset, log_scale, color_logit = surface.pick(self.completion).split(3, dim=1)
        return dataclasses.replace(decoded, offset=offset, log_scale=log_scale, color_logit=color_logit)

    @torch.no_grad()
    def take_completion(self, rows: Tensor, completed: Decoded) -> None:
        """Takes completed values for its own; what follows the pose fades out with trust.

        Args:
            rows: [M] int64, which Gaussians of the finest level.
            completed: their pose-independent part.
        """
        trust, base = self.trust[rows], self.base_color[rows]
        if not self.representation.take_completion(rows, completed, base, trust):
            values = torch.cat([completed.offset, completed.log_scale, completed.color_logit], 1)
            self.completion = self.trust.new_zeros(len(self.trust), 9).index_copy_(0, rows, values)
        self._baked = None

    def pose_share(self, surface: Surface) -> Tensor | None:
        """The share that is shown of what follows the pose, colour and shape, [N, 2]; None for all."""
        return surface.pick(self.trust) if len(self.completion) else None

    def pose(
        self,
        decoded: Decoded,
        pose: Pose,
        noise: Tensor | None = None,  # [54 * 6]
        time: float | None = None,
        rows: Tensor | None = None,  # [M]
        theta: Tensor | None = None,  # [54 * 6]
    ) -> Posed:
        """The Gaussians of one frame.

        Args:
            decoded: the pose-independent part.
            pose: of the frame.
            noise: added to theta; for training.
            time: seconds from the clip's start, for the residual colours; None where there is no clock.
            rows: [M] int64, each at most once, the Gaussians whose pose-dependent part is asked for; all if
                None.
            theta: the pose that the representation is told, see ``pose_features``; that of ``pose`` if None.
        """
        canonical = decoded.surface.canonical
        joints, moved = self.identity_changes(decoded.surface)
        transforms = joint_transforms(pose.rotation[None], joints, canonical.parents)[0]
        theta = pose_features(pose.rotation.detach()) if theta is None else theta
        theta = theta if noise is None else theta + noise
        condition = Condition(theta, pose.expression, time)
        # One pass computes on a CPU, for all Gaussians, and knows neither pose correctives nor completion.
        plain = canonical.pose_directions is not None or len(self.completion) > 0 or rows is not None
        plain |= moved is not None
        if self.at_once and not plain and kernels_serve(decoded.offset):
            linear = self.representation.linear_change(decoded, condition)
            if linear is not None:
                return self._pose_at_once(decoded, linear, transforms, pose)
        blended = blend_transforms(transforms, canonical.skinning_weights)
        shape = decoded.offset + rest_shape(canonical, pose, moved)
        log_scale, color_logit, pose_offset, residual = decoded.log_scale, decoded.color_logit, None, None
        rest = shape
        change = None
        if self.pose_heads_active:
            tables = decoded.surface.skinning_tables
            change = self.representation.change(
                decoded, condition, lambda: tables.normals(transforms, rest), rows
            )
        share = self.pose_share(decoded.surface)
        if change is not None:
            change = change if share is None else change.scaled(share)
            pose_offset = change.offset * self.architecture.pose_offset_unit * decoded.surface.pose_movable
            shape = shape + pose_offset
            log_scale = log_scale if change.log_scale is None else log_scale + change.log_scale
            color_logit = color_logit + change.color_logit
        means = transform_points(blended, shape) + pose.transl
        answer = None
        if self.residuals_active:
            answer = self.representation.residual(decoded, means, condition, rows)
        if answer is not None:
            answer = answer if share is None else scaled_residual(answer, share)
            answer = answer if self.residual_share == 1 else answer * self.residual_share
            residual, means = answer[:, :3], self._moved(means, blended, answer[:, 3:])
            color_logit = color_logit + residual
        gaussians = Gaussians(
            means=means,
            quaternions=decoded.surface.skinning_tables.place(transforms, shape, pose.transl)[1],
            scales=scales_of(canonical, log_scale, self.architecture),
            colors=torch.sigmoid(color_logit),
            opacities=self.opacities(decoded.surface),
        )
        return Posed(gaussians, pose_offset, log_scale, color_logit, residual, rows)

    def _pose_at_once(self, decoded: Decoded, change: LinearChange, transforms: Tensor, pose: Pose) -> Posed:
        """As ``pose`` does step by step, in one pass over the Gaussians."""
        active = self.pose_heads_active and len(change.signal) > 0
        posed = pose_at_once(
            self.posing_tables(decoded.surface),
            decoded.offset,
            decoded.log_scale,
            decoded.color_logit,
            change if active else change.none(),
            transforms,
            pose.transl,
            pose.expression,
        )
        gaussians = Gaussians(
            posed.means,
            posed.quaternions,
            posed.scales,
            posed.colors,
            self.opacities(decoded.surface),
        )
        pose_offset = posed.pose_offset if active else None
        return Posed(gaussians, pose_offset, decoded.log_scale, posed.color_logit)

    def posing_tables(self, surface: Surface) -> PosingTables:
        """The tables that posing in one pass reads of a surface, made once until another takes its place."""
        if self._posing is None or self._posing[0] is not surface:
            canonical = surface.canonical
            tables = PosingTables.build(
                surface.skinning_tables,
                canonical.vertices,
                *canonical.expressive(),
                initial_scales(canonical, self.architecture),
                self.architecture.pose_offset_unit * surface.pose_movable,
                (*LOG_SCALE_RANGE, LARGEST_SCALE),
            )
            self._posing = surface, tables
        return self._posing[1]

    def _moved(self, means: Tensor, blended: Tensor, move: Tensor) -> Tensor:
        """The centres, moved by what the residual heads say at rest, [N, 3]; as they are for [N, 0]."""
        if not move.shape[1]:
            return means
        offset = move * self.architecture.pose_offset_unit
        return means + (blended[..., :3] * offset[:, None, :]).sum(-1)

    def identity_changes(self, surface: Surface) -> tuple[Tensor, Tensor | None]:
        """The rest joints, [55, 3], and by how much vertices differ from the fitted identity's, [N, 3].

        Metres; the latter is None where the identity is not learnt.
        """
        canonical, change = surface.canonical, self.identity_change
        if change is None:
            return canonical.joints, None
        return canonical.joints + change.joints(), change.vertices(surface.rows, len(canonical))

    def opacities(self, surface: Surface) -> Tensor:
        """The opacities of a surface's Gaussians, [N]."""
        if self.opacity_logit is None:
            return torch.full((len(surface.canonical),), self.architecture.opacity, device=self.device)
        return torch.sigmoid(surface.pick(self.opacity_logit)[:, 0])

    def gaussians(
        self,
        pose: Pose,
        time: float | None = None,
        theta: Tensor | None = None,  # [54 * 6]
    ) -> Gaussians:
        """The finished avatar in a pose, world coordinates.

        The pose-independent part is decoded on the first call and kept until ``train()`` is called.
        Gradients reach the pose.

        Args:
            pose: of the body, in the world.
            time: seconds from the clip's start, for the residual colours of face and hands. Clamped to
                the training frames' interval; None, as for a motion that was never filmed, gives what
                the heads learnt to answer without a clock (see ``residual.py``).
            theta: the pose that the representation is told; that of ``pose`` if None.
        """
        if self._baked is None:
            with torch.no_grad():
                self._baked = self.decode()
        seen = self.pose(self._baked, pose, time=time, theta=theta).gaussians
        if self.unseen == "nothing" or bool(self.active.all()):
            return seen
        bare = self.base_gaussians(self.unseen_surface(), pose)
        return Gaussians(*(torch.cat(pair) for pair in zip(seen.tensors(), bare.tensors(), strict=True)))

    def base_gaussians(self, surface: Surface, pose: Pose) -> Gaussians:
        """The fitted body in its base colours, in a pose; no network takes part.

        Args:
            surface: which of its vertices.
            pose: as for ``gaussians``.
        """
        canonical = surface.canonical
        joints, moved = self.identity_changes(surface)
        transforms = joint_transforms(pose.rotation[None], joints, canonical.parents)[0]
        blended = blend_transforms(transforms, canonical.skinning_weights)
        shape = rest_shape(canonical, pose, moved)
        return Gaussians(
            means=transform_points(blended, shape) + pose.transl,
            quaternions=surface.skinning_tables.place(transforms, shape, pose.transl)[1],
            scales=scales_of(canonical, torch.zeros_like(canonical.vertices), self.architecture),
            colors=torch.sigmoid(surface.pick(self.base_color)),
            opacities=self.opacities(surface),
        )

    def unseen_surface(self) -> Surface:
        """The vertices of the finest level that the gate took; to be called only where it took some."""
        known = self._restricted.get(-1)
        if known is None or not torch.equal(known[0], self.active):
            left = self.surface().rows
            rest = torch.ones(len(self.surfaces[-1].canonical), dtype=torch.bool, device=self.device)
            rest[left] = False
            rows = torch.nonzero(rest)[:, 0]
            known = self._restricted[-1] = self.active.clone(), restricted(self.surfaces[-1], rows)
        return known[1]
