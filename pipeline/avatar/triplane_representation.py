"""The paper's representation (Sections 3.3, 3.5): triplane, static heads, pose heads, residual colours."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from pipeline.avatar.architecture import Architecture
from pipeline.avatar.head import Head
from pipeline.avatar.representation import (
    BakedRepresentation,
    Change,
    ClipConditions,
    Condition,
    Decoded,
    Normals,
    Representation,
)
from pipeline.avatar.residual import Residuals
from pipeline.avatar.sparse import gather_rows, scatter_rows
from pipeline.avatar.surface import Surface
from pipeline.avatar.triplane import Triplane
from pipeline.avatar.triplane_baking import bake_triplane
from pipeline.device import autocast, product_dtype


class TriplaneRepresentation(Representation):
    """Triplane features ``f_i`` and the heads that decode them.

    Attributes:
        triplane: T.
        geometry, color: the static heads.
        pose_geometry, pose_color: the pose heads; not there if ``Architecture.pose_heads`` is false.
        residuals: the residual colour heads.
    """

    def __init__(
        self,
        sizes: Architecture,
        regions: int,
        pose: int,
        parts: tuple[str, ...],
        seed: int,
        half_precision: bool,
    ):
        """Small random features, and heads whose last layer is zero.

        Args:
            sizes: of the networks.
            regions: of the triplane.
            pose: length of theta.
            parts: those with a residual colour head.
            seed: of the weights.
            half_precision: heads run in bfloat16.
        """
        super().__init__()
        self._sizes, self._half_precision = sizes, half_precision
        generator = torch.Generator().manual_seed(seed)
        side, channels, deviation = sizes.plane_resolution, sizes.plane_channels, sizes.plane_deviation
        self.triplane = Triplane(regions, side, channels, generator, deviation)
        features, hidden = self.triplane.features, {"width": sizes.width, "groups": sizes.groups}
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.geometry = Head(features, 6, **hidden)
            self.color = Head(features, 3, **hidden)
            if sizes.pose_heads:
                self.pose_geometry = Head(features, 6, condition=pose, **hidden)
                self.pose_color = Head(features + 3, 3, condition=pose, **hidden)
            # Last, so that an avatar with them starts from the same weights as one without.
            self.residuals = Residuals(
                parts,
                sizes.residual_place,
                (sizes.place_frequencies, sizes.time_frequencies),
                pose,
                sizes.residual_width,
                sizes.groups,
                sizes.residual_moves,
            )

    def _autocast(self) -> torch.autocast:
        return autocast(self.triplane.planes.device, self._half_precision)

    def decode(self, surface: Surface, base_color: Tensor) -> Decoded:
        """The static heads' output."""
        features = self.triplane(surface.samples)
        with self._autocast():
            geometry, color = self.geometry(features), self.color(features)
        geometry = geometry.float()
        return Decoded(
            surface=surface,
            features=features,
            offset=geometry[:, :3] * self._sizes.offset_unit,
            log_scale=geometry[:, 3:],
            color_logit=base_color + color.float(),
        )

    def change(
        self, decoded: Decoded, condition: Condition, normals: Normals, rows: Tensor | None = None
    ) -> Change | None:
        """The pose heads' output."""
        features, normal, theta = decoded.features, normals(), condition.theta
        count = len(normal)
        if rows is not None:
            features, normal = gather_rows(features, rows), gather_rows(normal, rows)
        with self._autocast():
            geometry = self.pose_geometry(features, theta)
            color = self.pose_color(torch.cat([features, normal], 1), theta)
        geometry, color = geometry.float(), color.float()
        if rows is not None:
            geometry, color = scatter_rows(geometry, rows, count), scatter_rows(color, rows, count)
        return Change(offset=geometry[:, :3], color_logit=color, log_scale=0.5 * geometry[:, 3:])

    def residual(
        self, decoded: Decoded, means: Tensor, condition: Condition, rows: Tensor | None = None
    ) -> Tensor | None:
        """The residual heads' output; None where no part has one."""
        places = decoded.surface.residual
        if not places:
            return None
        with self._autocast():
            return self.residuals(places, means, condition.theta, condition.time, rows)

    def set_clip(self, clip: ClipConditions) -> None:
        """Tells the residual heads when the training frames were filmed."""
        if clip.seconds:
            self.residuals.time_range.copy_(torch.tensor([min(clip.seconds), max(clip.seconds)]))

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """The planes, and all heads."""
        heads = [one for name, one in self.named_parameters() if not name.startswith("triplane.")]
        return {"plane_learning_rate": list(self.triplane.parameters()), "learning_rate": heads}

    def bake(self, decoded: Decoded, pose_dependent: bool, residuals: bool) -> BakedRepresentation:
        """The heads with their first layers done as far as they can be."""
        dtype = product_dtype(self.triplane.planes.device, self._half_precision)
        heads = (self.pose_geometry, self.pose_color) if pose_dependent else None
        places = decoded.surface.residual if residuals else ()
        return bake_triplane(decoded.features, heads, self.residuals, places, dtype)
