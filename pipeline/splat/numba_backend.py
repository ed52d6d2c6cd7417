"""The CPU rasterizer: numba kernels behind an autograd function.

The result is the same, bit for bit, for any number of threads; their number is torch's.
"""

from __future__ import annotations

import dataclasses

import numba
import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pipeline.clip.camera import Camera
from pipeline.numba_kernels import use_torch_threads
from pipeline.splat.blending import (
    Limits,
    blend_backward,
    blend_forward,
    blend_sums,
    make_limits,
    sum_weights,
)
from pipeline.splat.gaussians import Gaussians, Rendering
from pipeline.splat.image_formation import Pinhole, make_pinhole
from pipeline.splat.projection import (
    CAMERA_CHUNKS,
    DEPTH,
    GRADIENT_WIDTH,
    RECORD_WIDTH,
    project_backward,
    project_forward,
)
from pipeline.splat.tiles import TILE, Tiles, bin_gaussians, deal_tiles


def render_numba(gaussians: Gaussians, camera: Camera) -> Rendering:
    """Render as ``constants`` says, on the CPU. The intrinsics receive no gradient, the extrinsics do.

    Args:
        gaussians: all float32 or all float64.
        camera: its extrinsics in the same dtype.
    """
    lens = make_pinhole(_array(camera.intrinsics), camera.width, camera.height)
    return Rendering(*_Rasterize.apply(*gaussians.tensors(), camera.rotation, camera.translation, lens))


def picture_sums_numba(gaussians: Gaussians, camera: Camera, picture: Tensor) -> tuple[Tensor, Tensor]:
    """As ``render.picture_sums``, on the CPU, in one dtype."""
    use_torch_threads()
    lens = make_pinhole(_array(camera.intrinsics), camera.width, camera.height)
    pose = _array(camera.rotation.double()), _array(camera.translation.double())
    drawing = _draw([_array(tensor) for tensor in gaussians.tensors()], pose, lens)
    slots = np.zeros((len(drawing.member_weights), 4), drawing.records.dtype)
    blend_sums(
        drawing.order, drawing.tiles, drawing.columns, drawing.records, drawing.limits,
        drawing.member_weights, _array(picture), slots,
    )  # fmt: skip
    starts = torch.from_numpy(drawing.tiles.slot_starts).long()
    sums = torch.segment_reduce(torch.from_numpy(slots), "sum", offsets=starts, initial=0)
    return sums, torch.from_numpy(drawing.weights)


@dataclasses.dataclass(frozen=True)
class _Drawing:
    """The results of the forward pass that the backward pass needs.

    Attributes:
        pose: the camera's rotation and translation, float64.
        order: the order in which tiles are taken.
        columns: tiles in a row.
        records: [N, RECORD_WIDTH], the Gaussians in the image.
        image: color [H, W, 3], depth [H, W], transmittance [H, W].
        member_weights: [M], see ``blend_forward``.
        weights: [N], as in ``Rendering``.
    """

    lens: Pinhole
    limits: Limits
    pose: tuple[np.ndarray, np.ndarray]
    tiles: Tiles
    order: np.ndarray
    columns: int
    records: np.ndarray
    image: tuple[np.ndarray, np.ndarray, np.ndarray]
    member_weights: np.ndarray
    weights: np.ndarray


class _Rasterize(torch.autograd.Function):
    """Gaussians and a pose to color, alpha, depth and weights."""

    @staticmethod
    def forward(ctx, means, quaternions, scales, colors, opacities, rotation, translation, lens):
        use_torch_threads()
        gaussians = [_array(tensor) for tensor in (means, quaternions, scales, colors, opacities)]
        drawing = _draw(gaussians, (_array(rotation.double()), _array(translation.double())), lens)
        color, depth, transmittance = (torch.from_numpy(array) for array in drawing.image)
        weights = torch.from_numpy(drawing.weights)
        # Saving the outputs makes torch complain if they were changed in place before the backward pass.
        ctx.save_for_backward(means, quaternions, scales, color, depth)
        ctx.drawing = drawing
        ctx.mark_non_differentiable(weights)
        return color, 1 - transmittance, depth, weights

    @staticmethod
    @once_differentiable
    def backward(ctx, g_color, g_alpha, g_depth, _):
        use_torch_threads()
        means, quaternions, scales = (_array(tensor) for tensor in ctx.saved_tensors[:3])
        drawing: _Drawing = ctx.drawing
        slots = np.zeros((len(drawing.member_weights), GRADIENT_WIDTH), means.dtype)
        blend_backward(
            drawing.order, drawing.tiles, drawing.columns, drawing.records, drawing.limits,
            drawing.member_weights, drawing.image, (_array(g_color), _array(g_alpha), _array(g_depth)), slots,
        )  # fmt: skip
        gradients = [np.empty_like(array) for array in (means, quaternions, scales, means, drawing.weights)]
        g_camera = np.empty((CAMERA_CHUNKS, 12), np.float64)
        project_backward(
            means, quaternions, scales, *drawing.pose, drawing.lens,
            drawing.weights, drawing.tiles.slot_starts, slots, *gradients, g_camera,
        )  # fmt: skip
        g_pose = torch.from_numpy(g_camera.sum(0).astype(means.dtype))
        return *map(torch.from_numpy, gradients), g_pose[:9].reshape(3, 3), g_pose[9:], None


def _draw(gaussians: list[np.ndarray], pose: tuple[np.ndarray, np.ndarray], lens: Pinhole) -> _Drawing:
    """The forward pass: project, bin, blend."""
    count, dtype = len(gaussians[0]), gaussians[0].dtype
    width, height = int(lens.width), int(lens.height)
    columns, rows = -(-width // TILE), -(-height // TILE)
    # A record is one cache line if it starts at one: torch aligns memory so, numpy does not.
    records = torch.empty(count, RECORD_WIDTH, dtype=torch.from_numpy(gaussians[0]).dtype).numpy()
    boxes = np.empty((count, 4), np.int32)
    project_forward(*gaussians, *pose, lens, TILE, records, boxes)

    tiles = bin_gaussians(records, DEPTH, boxes, columns, rows)
    order = deal_tiles(tiles.starts, numba.get_num_threads())
    limits = make_limits(dtype.type)
    image = (
        np.empty((height, width, 3), dtype),
        np.empty((height, width), dtype),
        np.empty((height, width), dtype),
    )
    member_weights, slot_weights = np.empty((2, len(tiles.members)), dtype)
    blend_forward(order, tiles, columns, records, limits, *image, member_weights, slot_weights)
    weights = np.empty(count, dtype)
    sum_weights(tiles.slot_starts, slot_weights, weights)
    return _Drawing(lens, limits, pose, tiles, order, columns, records, image, member_weights, weights)


def _array(tensor: Tensor) -> np.ndarray:
    """The tensor as a contiguous array, which is the one layout that kernels are compiled for."""
    return tensor.detach().contiguous().numpy()
