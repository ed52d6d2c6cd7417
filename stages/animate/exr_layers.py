"""A frame as OpenEXR with named layers, in linear light, for compositing.

A multi-part file; every part has a name and the channels that programs expect of it, all of one size:

==========  ===========================  ==========================================================
part        channels                     what they hold
==========  ===========================  ==========================================================
``beauty``  R, G, B, A (half)            linear light with sRGB's primaries, premultiplied with A
``alpha``   A (half)                     coverage in [0, 1], the same as beauty's
``depth``   Z (float)                    metres along the camera's axis, the mean over what is seen in
                                         the pixel; 1e10 where A < 1/255, as Blender writes it
``normal``  X, Y, Z (half)               unit, towards the outside, in the world's axes (Y up, the
                                         camera of ``front`` at +Z); zero where A < 1/255
``part``    ID (half)                    the part of the body that most of the pixel shows: 1 + its place
                                         in ``pipeline.body.PARTS``; 0 where A < 1/255
==========  ===========================  ==========================================================

The clip's colours, and so the Gaussians' and the video's, are sRGB-encoded, and it is there that the renderer
mixes them. So beauty is unpremultiplied, decoded with sRGB's curve (IEC 61966-2-1), and premultiplied again:
``decode(C / A) A``. Undone, it is the video's picture; over a background in linear light, soft edges look as
they do in any compositor. Depth, normal and part are not premultiplied and not smoothed across edges.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import OpenEXR
import roma
import torch
from torch import Tensor

from pipeline.clip.camera import Camera
from pipeline.errors import UserError
from pipeline.splat import Gaussians, Rendering, render

NOWHERE = 1e10  # metres
LEAST_ALPHA = 1 / 255
NAMES = ("beauty", "alpha", "depth", "normal", "part")


@dataclasses.dataclass(frozen=True)
class ExrLayers:
    """One frame's layers, see the module.

    Attributes:
        beauty: [H, W, 4].
        depth: [H, W].
        normal: [H, W, 3].
        part: [H, W] int64.
    """

    beauty: Tensor
    depth: Tensor
    normal: Tensor
    part: Tensor


def decode_srgb(encoded: Tensor) -> Tensor:
    """sRGB-encoded values in [0, 1] as linear light (IEC 61966-2-1)."""
    return torch.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055).clamp_min(0) ** 2.4)


@torch.no_grad()
def exr_layers(gaussians: Gaussians, parts: Tensor, camera: Camera, rendering: Rendering) -> ExrLayers:
    """The layers of a frame.

    Args:
        gaussians: that are shown.
        parts: [N] int64, the part of each.
        rendering: what ``render`` made of the two.
    """
    alpha = rendering.alpha.clamp(0, 1)
    seen = alpha >= LEAST_ALPHA
    safe = torch.where(seen, alpha, torch.ones_like(alpha))
    straight = (rendering.color / safe[..., None]).clamp(0, 1)
    light = decode_srgb(straight) * alpha[..., None] * seen[..., None]
    normal = render(dataclasses.replace(gaussians, colors=outward(gaussians)), camera).color
    normal = torch.nn.functional.normalize(normal, dim=-1) * seen[..., None]
    return ExrLayers(
        beauty=torch.cat([light, alpha[..., None]], -1),
        depth=torch.where(seen, rendering.depth / safe, torch.full_like(alpha, NOWHERE)),
        normal=normal,
        part=torch.where(
            seen, 1 + most_seen(gaussians, parts, camera), torch.zeros_like(seen, dtype=torch.long)
        ),
    )


def outward(gaussians: Gaussians) -> Tensor:
    """The direction of each Gaussian's third axis, which is the surface's normal: [N, 3]."""
    xyzw = roma.quat_wxyz_to_xyzw(gaussians.quaternions)
    return roma.unitquat_to_rotmat(torch.nn.functional.normalize(xyzw, dim=1))[:, :, 2].contiguous()


def most_seen(gaussians: Gaussians, parts: Tensor, camera: Camera) -> Tensor:
    """The part with the largest weight in each pixel: [H, W] int64."""
    there = parts.unique().tolist()
    shares = []
    for start in range(0, len(there), 3):
        some = there[start : start + 3]
        marks = torch.zeros(len(parts), 3)
        for channel, part in enumerate(some):
            marks[:, channel] = (parts == part).float()
        shares.append(render(dataclasses.replace(gaussians, colors=marks), camera).color[..., : len(some)])
    return torch.tensor(there)[torch.cat(shares, -1).argmax(-1)]


def write_layers(path: Path, layers: ExrLayers) -> None:
    """Writes one frame. Equal layers give equal bytes.

    Raises:
        UserError: the file cannot be written.
    """
    half = layers.beauty.numpy().astype(np.float16)
    normal = layers.normal.numpy().astype(np.float16)
    content: dict[str, dict[str, np.ndarray]] = {
        "beauty": {name: half[..., place] for place, name in enumerate("RGBA")},
        "alpha": {"A": half[..., 3]},
        "depth": {"Z": layers.depth.numpy().astype(np.float32)},
        "normal": {name: normal[..., place] for place, name in enumerate("XYZ")},
        "part": {"ID": layers.part.numpy().astype(np.float16)},
    }
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    parts = [
        OpenEXR.Part(dict(header), {name: np.ascontiguousarray(one) for name, one in channels.items()}, part)
        for part, channels in content.items()
    ]
    try:
        OpenEXR.File(parts).write(str(path))
    except (RuntimeError, OSError) as error:
        raise UserError(
            f"{path}: cannot be written ({error}); free some space or choose another store (artifacts=FOLDER)"
        ) from error
