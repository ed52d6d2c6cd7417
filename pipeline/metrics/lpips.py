"""LPIPS in plain torch, from pinned checkpoints that are read without running anything in them.

Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", CVPR 2018;
backbones AlexNet and VGG16 with the heads of version 0.1. The checkpoints are pickles of numpy
arrays (``data/assets.toml``, asset ``lpips``), read as every foreign pickle (``pipeline.untrusted``).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from pipeline.errors import UserError
from pipeline.untrusted import parse_pickle


@dataclasses.dataclass(frozen=True)
class _Backbone:
    """A backbone's convolutions, and where it pools and is tapped."""

    file: str
    key: str
    strides: tuple[tuple[int, int], ...]  # (stride, padding) of each convolution
    widths: tuple[int, ...]  # output channels of each convolution
    pool_before: tuple[int, ...]
    pool: int  # side of the pooling window; its stride is 2
    taps: tuple[int, ...]  # convolutions whose rectified output is compared
    smallest: int  # pixels; a smaller image leaves nothing at the last tap


_BACKBONES: Mapping[str, _Backbone] = {
    "alex": _Backbone(
        "alexnet.ckpt",
        "AlexNet_0",
        ((4, 2), (1, 2), (1, 1), (1, 1), (1, 1)),
        (64, 192, 384, 256, 256),
        pool_before=(1, 2),
        pool=3,
        taps=(0, 1, 2, 3, 4),
        smallest=31,
    ),
    "vgg": _Backbone(
        "vgg16.ckpt",
        "VGG16_0",
        ((1, 1),) * 13,
        (64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512),
        pool_before=(2, 4, 7, 10),
        pool=2,
        taps=(1, 3, 6, 9, 12),
        smallest=16,
    ),
}

NETWORKS = tuple(_BACKBONES)
"""The names of the backbones."""

# The colour statistics that the heads were trained with, for images in [-1, 1].
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)


class Lpips(nn.Module):
    """The perceptual distance between images; nothing in it is trained, gradients reach the images.

    Args:
        folder: the asset's folder, with ``alexnet.ckpt`` and ``vgg16.ckpt``.
        network: ``alex`` or ``vgg``.

    Raises:
        UserError: the checkpoint is missing or damaged.
    """

    shift: Tensor
    scale: Tensor

    def __init__(self, folder: Path, network: str = "alex") -> None:
        super().__init__()
        if network not in _BACKBONES:
            raise ValueError(f"LPIPS knows {', '.join(NETWORKS)}, not {network}")
        self.backbone = _BACKBONES[network]
        path = folder / self.backbone.file
        checkpoint = read_checkpoint(path)
        try:
            self.convolutions = nn.ModuleList(_convolutions(checkpoint[self.backbone.key], self.backbone))
            self.heads = nn.ModuleList(_heads(checkpoint, self.backbone))
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise _damaged(path, f"it does not hold LPIPS's {network} network") from error
        self.register_buffer("shift", torch.tensor(_SHIFT).view(1, 3, 1, 1))
        self.register_buffer("scale", torch.tensor(_SCALE).view(1, 3, 1, 1))
        self.requires_grad_(False)

    def features(self, images: Tensor) -> list[Tensor]:
        """The unit-length features that are compared, one tensor a tap.

        An image smaller than the network can take (31 pixels for AlexNet, 16 for VGG16) is first
        widened with black on the right and below.

        Args:
            images: [H, W, 3] or [B, H, W, 3] float in [0, 1].

        Returns:
            Tensors [B, C, h, w].
        """
        x = images[None] if images.ndim == 3 else images
        height, width = x.shape[1:3]
        smallest = self.backbone.smallest
        x = F.pad(x, (0, 0, 0, max(0, smallest - width), 0, max(0, smallest - height)))
        x = (x.permute(0, 3, 1, 2) * 2 - 1 - self.shift) / self.scale
        taps = []
        for index, convolution in enumerate(self.convolutions):
            if index in self.backbone.pool_before:
                x = F.max_pool2d(x, self.backbone.pool, 2)
            x = F.relu(convolution(x))
            if index in self.backbone.taps:
                taps.append(_unit(x))
        return taps

    def distance(self, features: Sequence[Tensor], others: Sequence[Tensor]) -> Tensor:
        """The distance between images whose :meth:`features` are known, [B].

        ``sum over taps of mean over pixels of w . (f - f')^2`` (Equation 1 of the paper).
        """
        terms = [
            head((mine - other) ** 2).mean((1, 2, 3))
            for head, mine, other in zip(self.heads, features, others, strict=True)
        ]
        return torch.stack(terms).sum(0)

    def forward(self, images: Tensor, truths: Tensor) -> Tensor:
        """LPIPS of each pair, 0 for identical images.

        Args:
            images: [H, W, 3] or [B, H, W, 3] float in [0, 1].
            truths: the same shape.

        Returns:
            [B].
        """
        return self.distance(self.features(images), self.features(truths))


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Reads a pickle of nested dictionaries of arrays, admitting nothing else.

    Raises:
        UserError: the file is missing, damaged, or asks for anything beyond numpy arrays.
    """
    try:
        checkpoint = parse_pickle(path.read_bytes())
    except OSError as error:
        why = f"cannot be read ({error.strerror})"
        raise UserError(f"{path} {why}: run again, and it is fetched anew") from error
    except Exception as error:  # a damaged pickle raises nearly anything
        raise _damaged(path, str(error)) from error
    if not isinstance(checkpoint, dict):
        raise _damaged(path, "it holds no table of arrays")
    return checkpoint


def _convolutions(arrays: Mapping[str, Any], backbone: _Backbone) -> list[nn.Conv2d]:
    layers = []
    channels = 3
    for index, ((stride, padding), width) in enumerate(zip(backbone.strides, backbone.widths, strict=True)):
        weight = _kernel(arrays[f"Conv_{index}"]["kernel"], channels, width)
        bias = _tensor(arrays[f"Conv_{index}"]["bias"])
        if bias.shape != (width,):
            raise ValueError(f"bias {index} has the shape {tuple(bias.shape)}")
        layer = nn.Conv2d(channels, width, weight.shape[2:], stride, padding)  # type: ignore[arg-type]
        layer.weight, layer.bias = nn.Parameter(weight), nn.Parameter(bias)
        layers.append(layer)
        channels = width
    return layers


def _heads(checkpoint: Mapping[str, Any], backbone: _Backbone) -> list[nn.Conv2d]:
    layers = []
    for index, tap in enumerate(backbone.taps):
        weight = _kernel(checkpoint[f"NetLinLayer_{index}"]["Conv_0"]["kernel"], backbone.widths[tap], 1)
        layer = nn.Conv2d(backbone.widths[tap], 1, 1, bias=False)
        layer.weight = nn.Parameter(weight)
        layers.append(layer)
    return layers


def _kernel(array: Any, inputs: int, outputs: int) -> Tensor:
    """A kernel stored [h, w, inputs, outputs] as torch wants it, [outputs, inputs, h, w]."""
    kernel = _tensor(array)
    if kernel.ndim != 4 or kernel.shape[2:] != (inputs, outputs):
        raise ValueError(f"a kernel has the shape {tuple(kernel.shape)}")
    return kernel.permute(3, 2, 0, 1).contiguous()


def _tensor(array: Any) -> Tensor:
    if not isinstance(array, np.ndarray) or array.dtype.kind != "f" or not np.isfinite(array).all():
        raise ValueError("not an array of finite numbers")
    return torch.from_numpy(array.astype(np.float32))


def _unit(features: Tensor) -> Tensor:
    """Features scaled to length 1 over the channels; zeros stay zeros, with zero gradient."""
    length = features.pow(2).sum(1, keepdim=True).clamp_min(1e-20).sqrt()
    return features / (length + 1e-10)


def _damaged(path: Path, reason: str) -> UserError:
    return UserError(f"{path} is damaged ({reason}): delete it and run again, and it is fetched anew")
