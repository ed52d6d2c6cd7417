"""A whole decoding head at once on a CPU: linear layers with GroupNorm and ReLU between, and their gradient.

``head.Head`` says what is computed, layer by layer. Three things make the same cheaper here.

- GroupNorm subtracts each group's mean, which is linear. So the mean is taken out of the weights before the
  layer (a matrix of 128 x 128) and not out of its output (one of N x 128); what is left of the norm is a
  division.
- The order of hidden channels is free. Groups are interleaved, so that sums over a group are sums of whole
  vectors.
- The backward pass recomputes what follows a norm instead of having kept it. Rows are taken some thousands
  at a time, in the cache, and nothing is copied or cast in between.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pipeline.avatar.head_kernels import (
    CHUNKS,
    bits,
    lanes_of,
    norm_relu,
    norm_relu_backward,
    sum_norm_relu,
)
from pipeline.numba_kernels import use_torch_threads

ROWS = 4096  # at a time


@dataclasses.dataclass(frozen=True)
class HeadParameters:
    """A head's parameters.

    Attributes:
        weights: of the linear layers, first to last, [out, in].
        biases: of the linear layers, [out]; the first one's may hold a condition that all rows share.
        norm_weights, norm_biases: of the norm after each layer but the last, [out].
        groups: of the norms.
    """

    weights: tuple[Tensor, ...]
    biases: tuple[Tensor, ...]
    norm_weights: tuple[Tensor, ...]
    norm_biases: tuple[Tensor, ...]
    groups: int

    def flat(self) -> tuple[Tensor, ...]:
        """All tensors in the order of the attributes."""
        return (*self.weights, *self.biases, *self.norm_weights, *self.norm_biases)

    @classmethod
    def from_flat(cls, tensors: tuple[Tensor, ...], groups: int) -> HeadParameters:
        """The inverse of ``flat``."""
        count = (len(tensors) + 2) // 4
        weights, biases, norms = tensors[:count], tensors[count : 2 * count], tensors[2 * count :]
        return cls(weights, biases, norms[: count - 1], norms[count - 1 :], groups)

    @classmethod
    def of(cls, linear: Sequence[Any], norms: Sequence[Any]) -> HeadParameters:
        """The parameters of linear layers and of the ``GroupNormReLU`` after each but the last."""
        return cls(
            weights=tuple(one.weight for one in linear),
            biases=tuple(one.bias for one in linear),
            norm_weights=tuple(norm.weight for norm in norms),
            norm_biases=tuple(norm.bias for norm in norms),
            groups=norms[0].groups,
        )


def decode(points: Tensor, layers: HeadParameters, dtype: torch.dtype) -> Tensor:
    """The head's output for every row: [N, in] -> [N, out] in ``dtype``, differentiable.

    Args:
        points: [N, in].
        layers: float32, on the CPU.
        dtype: float32 or bfloat16, of the products and of what is kept for the backward pass.
    """
    if torch.is_grad_enabled():
        return _Decode.apply(layers.groups, dtype, points, *layers.flat())
    with torch.autocast("cpu", enabled=False):
        return _forward(points.to(dtype), arranged(layers, dtype), None)


def arranged(layers: HeadParameters, dtype: torch.dtype) -> HeadParameters:
    """The same head with centred weights and interleaved groups, its products' weights in ``dtype``."""
    groups, last = layers.groups, len(layers.weights) - 1
    order = _order(len(layers.biases[0]), groups)
    weights, biases = [], []
    for place, (weight, bias) in enumerate(zip(layers.weights, layers.biases, strict=True)):
        weight = weight.detach() if place == 0 else weight.detach()[:, order]
        if place < last:
            weight, bias = _centred(weight, groups)[order], _centred(bias.detach(), groups)[order]
        weights.append(weight.to(dtype).contiguous())
        biases.append(bias.detach().to(dtype))
    norm_weights = tuple(one.detach()[order] for one in layers.norm_weights)
    norm_biases = tuple(one.detach()[order] for one in layers.norm_biases)
    return HeadParameters(tuple(weights), tuple(biases), norm_weights, norm_biases, groups)


def arranged_rows(values: Tensor, groups: int) -> Tensor:
    """Weights of a further input of the first layer, centred and interleaved: [C, ...]."""
    return _centred(values.detach(), groups)[_order(len(values), groups)]


def finish(
    products: Tensor,  # [N, C]
    shared: Tensor,  # [C]
    own: tuple[Tensor, Tensor],  # [N, E], [E, C]
    layers: HeadParameters,
) -> Tensor:
    """A head's output from the finished products of its first layer, without gradient.

    Args:
        products: [N, C] float32 or bfloat16, what is always the same.
        shared: [C] float32, added to every row.
        own: [N, E] and [E, C] float32, whose product is added; E may be 0.
        layers: arranged; the first layer's weight and bias are not looked at.

    Returns:
        [N, out] of the products' dtype.
    """
    use_torch_threads()
    output = products.new_empty(len(products), len(layers.biases[-1]))
    spare = [products.new_empty(min(ROWS, len(products)), products.shape[1]) for _ in range(2)]
    norm = bits(layers.norm_weights[0]), bits(layers.norm_biases[0])
    lanes, groups = lanes_of(products.shape[1], layers.groups), np.uint64(layers.groups)
    for start in range(0, len(products), ROWS):
        chunk = slice(start, min(start + ROWS, len(products)))
        y, z = (one[: chunk.stop - start] for one in spare)
        extra, weight = bits(own[0][chunk]), bits(own[1])
        sum_norm_relu(bits(products[chunk]), bits(shared), extra, weight, *norm, lanes, groups, bits(y))
        for place in range(1, len(layers.norm_weights)):
            torch.addmm(layers.biases[place], y, layers.weights[place].t(), out=z)
            _norm_relu(z, place, layers, y)
        torch.addmm(layers.biases[-1], y, layers.weights[-1].t(), out=output[chunk])
    return output


def _norm_relu(z: Tensor, place: int, layers: HeadParameters, y: Tensor) -> None:
    norm = bits(layers.norm_weights[place]), bits(layers.norm_biases[place])
    lanes = lanes_of(z.shape[1], layers.groups)
    norm_relu(bits(z), *norm, lanes, np.uint64(layers.groups), bits(y))


class _Decode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, groups: int, dtype: torch.dtype, points: Tensor, *tensors: Tensor) -> Tensor:
        with torch.autocast("cpu", enabled=False):
            layers = arranged(HeadParameters.from_flat(tensors, groups), dtype)
            rows = points.to(dtype).contiguous()
            hidden = [rows.new_empty(len(rows), len(bias)) for bias in layers.norm_biases]
            output = _forward(rows, layers, hidden)
        ctx.groups, ctx.layers = groups, layers
        ctx.save_for_backward(rows, *hidden)
        return output

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        rows, *hidden = ctx.saved_tensors
        wanted = ctx.needs_input_grad[2]
        with torch.autocast("cpu", enabled=False):
            to_points, gradients = _backward(
                gradient.to(rows.dtype).contiguous(), rows, hidden, ctx.layers, wanted
            )
        return None, None, to_points, *_restored(gradients, ctx.groups).flat()


def _forward(rows: Tensor, layers: HeadParameters, hidden: list[Tensor] | None) -> Tensor:
    """The output; what goes into the norms is written to ``hidden`` if the backward pass will want it."""
    use_torch_threads()
    output = rows.new_empty(len(rows), len(layers.biases[-1]))
    spare = [rows.new_empty(min(ROWS, len(rows)), len(layers.biases[0])) for _ in range(2)]
    for start in range(0, len(rows), ROWS):
        chunk = slice(start, min(start + ROWS, len(rows)))
        size = chunk.stop - start
        x, y = rows[chunk], spare[0][:size]
        for place in range(len(layers.norm_weights)):
            z = spare[1][:size] if hidden is None else hidden[place][chunk]
            torch.addmm(layers.biases[place], x, layers.weights[place].t(), out=z)
            _norm_relu(z, place, layers, y)
            x = y
        torch.addmm(layers.biases[-1], x, layers.weights[-1].t(), out=output[chunk])
    return output


def _backward(
    gradient: Tensor, rows: Tensor, hidden: list[Tensor], layers: HeadParameters, wanted: bool
) -> tuple[Tensor | None, HeadParameters]:
    """The gradients of the rows, if wanted, and of the arranged parameters (in float32)."""
    use_torch_threads()
    count, channels = len(hidden), hidden[0].shape[1]
    to_rows = torch.empty(rows.shape) if wanted else None
    to_weights = [torch.zeros(weight.shape) for weight in layers.weights]
    sums = [np.zeros((CHUNKS, 3, channels), np.float32) for _ in range(count)]
    lanes, groups = lanes_of(channels, layers.groups), np.uint64(layers.groups)
    spare = [rows.new_empty(min(ROWS, len(rows)), channels) for _ in range(3)]
    narrow = rows.new_empty(min(ROWS, len(rows)), rows.shape[1])
    for start in range(0, len(rows), ROWS):
        chunk = slice(start, min(start + ROWS, len(rows)))
        y, *downs = (one[: chunk.stop - start] for one in spare)
        push = gradient[chunk]
        for place in reversed(range(count)):
            down = torch.mm(push, layers.weights[place + 1], out=downs[place % 2])
            norm = bits(layers.norm_weights[place]), bits(layers.norm_biases[place])
            norm_relu_backward(
                bits(hidden[place][chunk]),
                bits(down),
                *norm,
                lanes,
                groups,
                bits(down),
                bits(y),
                sums[place],
            )
            to_weights[place + 1] += push.t() @ y
            push = down
        to_weights[0] += push.t() @ rows[chunk]
        if to_rows is not None:
            to_rows[chunk] = torch.mm(push, layers.weights[0], out=narrow[: chunk.stop - start])
    totals = [torch.from_numpy(one.sum(0)) for one in sums]
    to_biases = (*(total[2] for total in totals), gradient.sum(0, dtype=torch.float32))
    norms = tuple(total[0] for total in totals), tuple(total[1] for total in totals)
    return to_rows, HeadParameters(tuple(to_weights), to_biases, *norms, layers.groups)


def _restored(gradients: HeadParameters, groups: int) -> HeadParameters:
    """The gradients of the parameters as they are, from those of the arranged ones."""
    last = len(gradients.weights) - 1
    back = _order(len(gradients.biases[0]), groups).argsort()
    weights, biases = [], []
    for place, (weight, bias) in enumerate(zip(gradients.weights, gradients.biases, strict=True)):
        weight = weight if place == 0 else weight[:, back]
        if place < last:
            weight, bias = _centred(weight[back], groups), _centred(bias[back], groups)
        weights.append(weight)
        biases.append(bias)
    norm_weights = tuple(one[back] for one in gradients.norm_weights)
    norm_biases = tuple(one[back] for one in gradients.norm_biases)
    return HeadParameters(tuple(weights), tuple(biases), norm_weights, norm_biases, groups)


def _order(channels: int, groups: int) -> Tensor:
    """The channels with the groups interleaved: the first of each group, then the second of each, ..."""
    return torch.arange(channels).view(groups, -1).t().flatten()


def _centred(values: Tensor, groups: int) -> Tensor:
    """[C, ...] less the mean over each group of consecutive entries; its own transpose."""
    grouped = values.view(groups, -1, *values.shape[1:])
    return (grouped - grouped.mean(1, keepdim=True)).view(values.shape)
