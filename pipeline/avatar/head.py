"""The decoders that turn triplane features into Gaussian parameters (supplement C)."""

from __future__ import annotations

import dataclasses

import torch
import torch.nn.functional as functional
from torch import Tensor, nn

from pipeline.avatar.fused_head import HeadParameters, decode
from pipeline.avatar.head_kernels import EPSILON
from pipeline.device import autocast, kernels_serve


class GroupNormReLU(nn.Module):
    """``relu(torch.nn.GroupNorm(x))`` for [N, C] inputs, by ``layer_norm`` on a view.

    On a CPU ``fused_head.py`` computes it together with the layers around it.
    """

    def __init__(self, groups: int, channels: int):
        super().__init__()
        self.groups = groups
        self.weight = nn.Parameter(torch.ones(channels))
        self.bias = nn.Parameter(torch.zeros(channels))

    def forward(self, x: Tensor) -> Tensor:
        """Normalises each group of channels of each row, then clips: [N, C] -> [N, C]."""
        grouped = x.view(len(x), self.groups, -1)
        normal = functional.layer_norm(grouped, grouped.shape[2:], eps=EPSILON).view(x.shape)
        normal = normal.to(x.dtype)  # autocast on a GPU norms in float32
        return functional.relu(torch.addcmul(self.bias.to(x.dtype), normal, self.weight.to(x.dtype)))


class Head(nn.Module):
    """Four linear layers, each hidden one followed by GroupNorm and ReLU.

    The last layer starts at zero, so that an untrained head changes nothing. A head may be
    conditioned on one vector that all points share, the pose: the first layer of
    ``[f_i, theta]`` is then ``W_f f_i + W_theta theta``, whose second part is computed once a frame
    and not once a point.
    """

    def __init__(self, inputs: int, outputs: int, condition: int = 0, width: int = 128, groups: int = 8):
        """Builds the layers.

        Args:
            inputs: values a point.
            outputs: values a point.
            condition: length of the shared vector; 0 for a head without one.
            width: hidden channels.
            groups: of GroupNorm; must divide ``width``.
        """
        super().__init__()
        self.first = nn.Linear(inputs, width)
        self.condition = nn.Linear(condition, width, bias=False) if condition else None
        self.hidden = nn.ModuleList([nn.Linear(width, width) for _ in range(2)])
        self.norms = nn.ModuleList([GroupNormReLU(groups, width) for _ in range(3)])
        self.last = nn.Linear(width, outputs)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)
        if self.condition is not None:
            # A pose seen for the first time then acts as the mean pose until training says otherwise.
            nn.init.zeros_(self.condition.weight)

    def forward(self, points: Tensor, condition: Tensor | None = None) -> Tensor:
        """Decodes [N, inputs] and an optional shared vector [condition] to [N, outputs]."""
        if self.condition is not None and condition is None:
            raise ValueError("this head is conditioned on a vector, and none was given")
        dtype = torch.get_autocast_dtype("cpu") if torch.is_autocast_enabled("cpu") else points.dtype
        if kernels_serve(points) and dtype in (torch.float32, torch.bfloat16):
            return decode(points, self._layers(condition), dtype)
        layers = self._layers(condition)
        x = self.norms[0](functional.linear(points, layers.weights[0], layers.biases[0]))
        x = self.norms[1](self.hidden[0](x))
        x = self.norms[2](self.hidden[1](x))
        return self.last(x)

    def _layers(self, condition: Tensor | None) -> HeadParameters:
        """The parameters, the condition's part added to the first bias."""
        layers = HeadParameters.of([self.first, *self.hidden, self.last], list(self.norms))
        if self.condition is None or condition is None:
            return layers
        with autocast(condition.device, half_precision=False):  # one small product: exact for nothing
            first = layers.biases[0] + self.condition(condition)
        return dataclasses.replace(layers, biases=(first, *layers.biases[1:]))
