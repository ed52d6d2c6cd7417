"""Part-specific residual colours: face, left hand, right hand (the paper's Section 3.5, Equation 7).

Each part has a small head, whose inputs are a Gaussian's place, the time and the pose, and whose output is
added to the colour. It does not move a Gaussian: the paper's ablation loses 0.6 dB by it
(supplement E.3, Table A4). ``residual_moves`` is that ablation: three more outputs a head, an
offset of the centre that no regulariser holds.

What the paper leaves open, and what is done here:

- *The place.* ``mu`` is "a Gaussian center", of no named space. Here it is the Gaussian's rest vertex
  in the box of its part. A residual then belongs to a spot of the skin, wherever the person stands,
  and its encoding is constant. The authors' release encodes the posed centre in the world
  (``residual_place = "posed"``), which also tells the head where the person stands.
- *Time outside training.* Times are clamped to the interval of the training frames: what follows the
  clip looks like its last moment, what precedes it like its first. An animation has no time at all.
  Then the time's code is zero, which no time has, and training shows that code often enough
  (``train.time_dropout``) for the heads to know what to answer without a clock.
"""

from __future__ import annotations

import dataclasses
import math
from typing import get_args

import torch
from torch import Tensor, nn

from pipeline.avatar.canonical import Canonical
from pipeline.avatar.head import Head
from pipeline.body import PARTS
from pipeline.config.choices import ResidualPlace

REST = "rest"  # what no other named part holds
PLACES: tuple[str, ...] = get_args(ResidualPlace)


@dataclasses.dataclass(frozen=True)
class Region:
    """One part's Gaussians on one level of subdivision.

    Attributes:
        part: its name.
        rows: [M] int64, which Gaussians.
        encoded: [M, 3 + 6 L], gamma(mu) of their rest vertices in the part's box.
    """

    part: str
    rows: Tensor  # [M]
    encoded: Tensor  # [M, 3 + 6 L]


def part_rows(canonical: Canonical, parts: tuple[str, ...]) -> dict[str, Tensor]:
    """The Gaussians of each named part that has any: name -> [M] int64.

    Args:
        canonical: the mesh.
        parts: some of ``pipeline.body.PARTS``, and ``"rest"`` for what the others leave.

    Raises:
        ValueError: there is no part of that name.
    """
    unknown = sorted({*parts} - {*PARTS, REST})
    if unknown:
        raise ValueError(f"there is no part {unknown[0]}; there are {', '.join((*PARTS, REST))}")
    named = [part for part in parts if part != REST]
    chosen = {part: canonical.is_part(part) for part in named}
    if REST in parts:
        chosen[REST] = ~canonical.is_part(*named)
    rows = {part: torch.nonzero(inside)[:, 0] for part, inside in chosen.items()}
    return {part: rows[part] for part in parts if len(rows[part])}


def regions(meshes: list[Canonical], parts: tuple[str, ...], frequencies: int) -> list[tuple[Region, ...]]:
    """The regions of every level, from the unsubdivided mesh to the finest.

    A part's box is that of the unsubdivided mesh, so that a Gaussian's code is the same on every level.
    """
    coarse = part_rows(meshes[0], parts)
    boxes = {part: _box(meshes[0].vertices[rows]) for part, rows in coarse.items()}
    levels = []
    for mesh in meshes:
        rows = part_rows(mesh, parts)
        levels.append(
            tuple(
                Region(part, rows[part], encode((mesh.vertices[rows[part]] - middle) / half, frequencies))
                for part, (middle, half) in boxes.items()
            )
        )
    return levels


def encode(values: Tensor, frequencies: int) -> Tensor:
    """The positional encoding gamma: the values, and sine and cosine of ``2^k pi`` times each.

    Args:
        values: [..., D].
        frequencies: L; k runs from 0 to L - 1.

    Returns:
        [..., D (1 + 2 L)].

    >>> encode(torch.tensor([0.5]), 1)  # the value, sin(pi / 2), cos(pi / 2)
    tensor([ 5.0000e-01,  1.0000e+00, -4.3711e-08])
    """
    octaves = 2.0 ** torch.arange(frequencies, dtype=values.dtype, device=values.device)
    angles = values[..., None] * (math.pi * octaves)
    waves = torch.cat([angles.sin(), angles.cos()], -1).flatten(-2)
    return torch.cat([values, waves], -1)


def time_code(time: float | None, time_range: Tensor, frequencies: int) -> Tensor:
    """gamma(t) of a time in seconds: [1 + 2 L]; zero without a time.

    The interval of the training frames is mapped to [0, 1], where the lowest sine and cosine tell
    every moment from every other; times outside of it are clamped.

    Args:
        time: seconds from the clip's start; None where there is no clock.
        time_range: [2], seconds of the first and the last training frame.
        frequencies: L.
    """
    if time is None:
        return torch.zeros(1 + 2 * frequencies, device=time_range.device)
    first, last = time_range.unbind()
    done = ((time - first) / (last - first).clamp_min(1e-6)).clamp(0, 1)
    return encode(done[None], frequencies)


class Residuals(nn.Module):
    """The residual colour heads, one a part.

    Attributes:
        heads: by part.
        time_range: [2], seconds of the first and the last training frame.
    """

    time_range: Tensor

    def __init__(
        self,
        parts: tuple[str, ...],
        place: str,
        frequencies: tuple[int, int],
        pose: int,
        width: int,
        groups: int,
        moves: bool = False,
    ):
        """Heads whose output is zero until they are trained.

        Args:
            parts: those with a head.
            place: ``"canonical"`` or ``"posed"``, the place that is encoded.
            frequencies: of the place's and of the time's encoding.
            pose: length of theta.
            width: hidden channels.
            groups: of GroupNorm.
            moves: whether they move Gaussians, too.

        Raises:
            ValueError: there is no such place.
        """
        super().__init__()
        if place not in PLACES:
            raise ValueError(f"a residual's place is one of {', '.join(PLACES)}, not {place}")
        self.place, (self.place_frequencies, self.time_frequencies) = place, frequencies
        self.outputs = 6 if moves else 3
        inputs, condition = 3 * (1 + 2 * self.place_frequencies), 1 + 2 * self.time_frequencies + pose
        self.heads = nn.ModuleDict(
            {part: Head(inputs, 3, condition=condition, width=width, groups=groups) for part in parts}
        )
        for head in self.heads.values() if moves else ():
            # Afterwards, so that all other weights are those of heads that move nothing.
            head.last = zero_layer(width, self.outputs)
        self.register_buffer("time_range", torch.tensor([0.0, 1.0]))

    def time_code(self, time: float | None) -> Tensor:
        """gamma(t), see ``time_code`` of the module."""
        return time_code(time, self.time_range, self.time_frequencies)

    def forward(
        self,
        places: tuple[Region, ...],
        means: Tensor,
        theta: Tensor,
        time: float | None,
        asked: Tensor | None = None,
    ) -> Tensor:
        """Delta C_res of every Gaussian in logits, zero where there is no head: [N, 3].

        Where residuals move Gaussians, too: [N, 6], the last three in ``pose_offset_unit`` at rest.

        Args:
            places: the level's regions.
            means: [N, 3] posed centres in the world, metres.
            theta: [P], the pose without the root.
            time: seconds from the clip's start; None where there is no clock.
            asked: [M] int64, the Gaussians that matter, all if None; of the others it is zero, too.
        """
        if asked is not None:
            wanted = means.new_zeros(len(means), dtype=torch.bool).index_fill_(0, asked, True)
            places = tuple(_some(region, wanted) for region in places)
        condition = torch.cat([self.time_code(time), theta])
        change = torch.zeros(len(means), self.outputs, device=means.device)
        for region in places:
            encoded = region.encoded
            if self.place == "posed":
                encoded = encode(means[region.rows].detach(), self.place_frequencies)
            answer = self.heads[region.part](encoded, condition).float()
            change = change.index_copy(0, region.rows, answer)
        return change


def zero_layer(inputs: int, outputs: int) -> nn.Linear:
    """A last layer whose output is zero until it is trained."""
    layer = nn.Linear(inputs, outputs)
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer


def _some(region: Region, wanted: Tensor) -> Region:
    """The part's Gaussians that are wanted, [N] bool."""
    inside = wanted[region.rows]
    return Region(region.part, region.rows[inside], region.encoded[inside])


def _box(points: Tensor) -> tuple[Tensor, Tensor]:
    """Centre and half of the longest side, metres: [3] and a scalar; the same scale along each axis."""
    low, high = points.amin(0), points.amax(0)
    return (low + high) / 2, ((high - low).amax() / 2).clamp_min(1e-6)
