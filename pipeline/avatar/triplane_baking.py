"""The pose-dependent part of a finished triplane avatar.

The features are gone, and in their place stands what the first layer of each pose head makes of them,
``W_f f_i + b``; so do the encoded places of the residual heads, where these do not change with the pose.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor, nn

from pipeline.avatar.fused_head import HeadParameters, arranged, arranged_rows, finish
from pipeline.avatar.head import Head
from pipeline.avatar.representation import BakedRepresentation, Change, Condition, Normals
from pipeline.avatar.residual import Region, Residuals, encode, time_code


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
class BakedTriplane(BakedRepresentation):
    """Pose heads and residual colours of a finished avatar.

    Attributes:
        geometry, color: the pose heads; None if the avatar has none that are active.
        parts: the parts' residual colours.
        time_range: [2], seconds of the first and the last training frame.
        place_frequencies, time_frequencies: of the residuals' encodings.
        posed_place: whether the residuals are told posed centres: then nothing of them is baked.
    """

    geometry: BakedHead | None
    color: BakedHead | None
    parts: dict[str, BakedResidual]
    time_range: Tensor
    place_frequencies: int
    time_frequencies: int
    posed_place: bool

    def change(self, condition: Condition, normals: Normals) -> Change | None:
        """The pose heads' output."""
        if self.geometry is None or self.color is None:
            return None
        answer = self.geometry(condition.theta)
        color = self.color(condition.theta, normals())
        return Change(offset=answer[:, :3], color_logit=color, log_scale=0.5 * answer[:, 3:])

    def residuals(self, means: Tensor, condition: Condition) -> list[tuple[Tensor, Tensor]]:
        """Each part's rows and its head's output, [M, 3] logits or [M, 6] with moves."""
        if not self.parts:
            return []
        code = time_code(condition.time, self.time_range, self.time_frequencies)
        told, answers = torch.cat([code, condition.theta]), []
        for part in self.parts.values():
            own = encode(means[part.rows], self.place_frequencies) if self.posed_place else None
            answers.append((part.rows, part.head(told, own)))
        return answers


def bake_triplane(
    features: Tensor,  # [N, C]
    heads: tuple[nn.Module, nn.Module] | None,
    residuals: Residuals,
    places: tuple[Region, ...],
    dtype: torch.dtype,
) -> BakedTriplane:
    """Computes the first layers of pose and residual heads as far as the pose has no part in them.

    Args:
        features: ``f_i``.
        heads: the pose heads of geometry and colour, if they are active.
        residuals: the residual heads.
        places: the parts whose residual heads are active.
        dtype: the precision that heads run in.
    """
    geometry, color = (None, None) if heads is None else (_baked_head(one, features, dtype) for one in heads)
    posed = residuals.place == "posed"
    parts = {}
    for region in places:
        known = region.encoded[:, :0] if posed else region.encoded
        head = _baked_head(residuals.heads[region.part], known, dtype)
        parts[region.part] = BakedResidual(region.rows, head)
    return BakedTriplane(
        geometry=geometry,
        color=color,
        parts=parts,
        time_range=residuals.time_range.clone(),
        place_frequencies=residuals.place_frequencies,
        time_frequencies=residuals.time_frequencies,
        posed_place=posed,
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
