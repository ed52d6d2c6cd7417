"""The kernels of skinning: blended transforms, posed points, normals and orientations of Gaussians.

``skinning_tables.py`` says what ``skin_points``, ``normals_of_vertices`` and ``place_gaussians`` mean, and
``fused_posing.py`` what ``pose_forward`` and ``pose_backward`` do.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from pipeline.numba_kernels import checked_parallel_kernel, inline_kernel

CHUNKS = 16  # of points; sums over points are added up chunk by chunk, whatever the number of threads
ZERO, ONE = np.float32(0), np.float32(1)


@inline_kernel
def _blend(transforms, joints, weights, point, blended):
    for k in range(12):
        blended[k] = 0
    for place in range(joints.shape[1]):
        weight, joint = weights[point, place], joints[point, place]
        for k in range(12):
            blended[k] += weight * transforms[joint, k]


@checked_parallel_kernel
def skin_points(transforms, joints, weights, points, posed):
    """Rest points carried to their pose.

    Args:
        transforms: [55, 12] float32, each joint's [3, 4] matrix row by row.
        joints, weights: [N, K], as ``joints_of_points`` gives them.
        points: [N, 3], metres.
        posed: output [N, 3], metres.
    """
    count = points.shape[0]
    step = (count + CHUNKS - 1) // CHUNKS
    for chunk in numba.prange(CHUNKS):
        blended = np.empty(12, np.float32)
        for i in range(chunk * step, min(count, (chunk + 1) * step)):
            _blend(transforms, joints, weights, i, blended)
            for row in range(3):
                value = blended[4 * row + 3]
                for column in range(3):
                    value += blended[4 * row + column] * points[i, column]
                posed[i, row] = value


@checked_parallel_kernel
def normals_of_vertices(vertices, faces, starts, around, normals):
    """Unit normals, area-weighted over the faces around each vertex, as ``pipeline.body.vertex_normals``.

    Args:
        vertices: [N, 3], metres.
        faces: [F, 3] int32.
        starts, around: as ``faces_of_vertices`` gives them.
        normals: output [N, 3]; zero where there is no face.
    """
    count = vertices.shape[0]
    step = (count + CHUNKS - 1) // CHUNKS
    area = np.empty((faces.shape[0], 3), np.float32)
    for f in numba.prange(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ux, vx = vertices[b, 0] - vertices[a, 0], vertices[c, 0] - vertices[a, 0]
        uy, vy = vertices[b, 1] - vertices[a, 1], vertices[c, 1] - vertices[a, 1]
        uz, vz = vertices[b, 2] - vertices[a, 2], vertices[c, 2] - vertices[a, 2]
        area[f, 0], area[f, 1], area[f, 2] = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    for chunk in numba.prange(CHUNKS):
        for i in range(chunk * step, min(count, (chunk + 1) * step)):
            x, y, z = np.float32(0), np.float32(0), np.float32(0)
            for place in range(starts[i], starts[i + 1]):
                f = around[place]
                x, y, z = x + area[f, 0], y + area[f, 1], z + area[f, 2]
            length = max(np.sqrt(x * x + y * y + z * z), np.float32(1e-20))
            normals[i, 0], normals[i, 1], normals[i, 2] = x / length, y / length, z / length


@inline_kernel
def _write_quaternion(m, quaternion):
    """A nearly orthonormal matrix [3, 3] as a unit quaternion, wxyz, by the largest of its parts."""
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    i = 0
    for k in range(1, 3):
        if m[k, k] > m[i, i]:
            i = k
    if trace >= m[i, i]:
        quaternion[0] = 1 + trace
        quaternion[1], quaternion[2], quaternion[3] = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    else:
        j, k = (i + 1) % 3, (i + 2) % 3
        quaternion[0] = m[k, j] - m[j, k]
        quaternion[1 + i] = 1 - trace + 2 * m[i, i]
        quaternion[1 + j], quaternion[1 + k] = m[j, i] + m[i, j], m[k, i] + m[i, k]
    square = np.float32(0)
    for k in range(4):
        square += quaternion[k] * quaternion[k]
    for k in range(4):
        quaternion[k] /= np.sqrt(square)


@checked_parallel_kernel
def place_gaussians(transforms, joints, weights, points, frames, transl, means, quaternions):
    """Centres and orientations of the Gaussians in the world.

    Args:
        transforms, joints, weights, points: as for ``skin_points``.
        frames: [N, 3, 3], the Gaussians' axes at rest.
        transl: [3], metres.
        means, quaternions: outputs [N, 3] metres and [N, 4] wxyz.
    """
    count = points.shape[0]
    step = (count + CHUNKS - 1) // CHUNKS
    for chunk in numba.prange(CHUNKS):
        blended, turned = np.empty(12, np.float32), np.empty((3, 3), np.float32)
        for i in range(chunk * step, min(count, (chunk + 1) * step)):
            _blend(transforms, joints, weights, i, blended)
            for row in range(3):
                value = blended[4 * row + 3] + transl[row]
                for column in range(3):
                    value += blended[4 * row + column] * points[i, column]
                    total = np.float32(0)
                    for k in range(3):
                        total += blended[4 * row + k] * frames[i, k, column]
                    turned[row, column] = total
                means[i, row] = value
            _write_quaternion(turned, quaternions[i])


class Still(NamedTuple):
    """The arrays of a posing that no frame changes; N points, float32 where nothing else is said.

    Attributes:
        points: [N, 3] at rest, metres.
        initial: [N, 3], standard deviations that a log scale of 0 stands for, metres.
        movable: [N], metres that a pose-dependent offset of 1 stands for.
        joints, weights: [N, J], as ``joints_of_points`` gives them.
        frames: [N, 3, 3], the Gaussians' axes at rest.
        places: [N] int32, the row of ``Frame.moved`` that moves the point; -1 for none.
        limits: [3], least and greatest log scale, and the largest scale, metres.
    """

    points: np.ndarray
    initial: np.ndarray
    movable: np.ndarray
    joints: np.ndarray
    weights: np.ndarray
    frames: np.ndarray
    places: np.ndarray
    limits: np.ndarray


class Learnt(NamedTuple):
    """The arrays that are learnt, float32.

    Attributes:
        offset: [N, 3], metres; [0, 3] for none.
        log_scale, color_logit: [N, 3].
        bases: [M, 6 K].
        rows: [N] int64, the row of ``bases`` that is the point's; [0] where it is the point's own number.
    """

    offset: np.ndarray
    log_scale: np.ndarray
    color_logit: np.ndarray
    bases: np.ndarray
    rows: np.ndarray


class Frame(NamedTuple):
    """The arrays of one frame, float32.

    Attributes:
        signal: [K].
        transforms: [55, 12], each joint's [3, 4] matrix row by row.
        transl: [3], metres.
        moved: [P, 3], how far the expression moves points, metres.
    """

    signal: np.ndarray
    transforms: np.ndarray
    transl: np.ndarray
    moved: np.ndarray


@inline_kernel
def _add_up_bases(bases, row, signal, answer):
    """The six sums of a row's bases, each times its number of the signal."""
    count = len(signal)
    for k in range(6):
        total = ZERO
        for b in range(count):
            total += bases[row, k * count + b] * signal[b]
        answer[k] = total


@inline_kernel
def _blend_few(transforms, joints, weights, point, blended):
    """As ``_blend``; joints are in the order of their weights, so that the first of zero ends it."""
    for k in range(12):
        blended[k] = ZERO
    for place in range(joints.shape[1]):
        weight, joint = weights[point, place], joints[point, place]
        if weight == 0:
            break
        for k in range(12):
            blended[k] += weight * transforms[joint, k]


@inline_kernel
def _clamped(value, low, high):
    """As ``torch.clamp``: what is not a number stays as it is."""
    if value < low:
        return low
    if value > high:
        return high
    return value


@checked_parallel_kernel
def pose_forward(still, learnt, frame, means, quaternions, scales, colors, color_logit, moves, shapes):
    """Bases, expression, skinning, scales and colours of one frame in one pass over the Gaussians.

    Args:
        still, learnt, frame: the input.
        means: output [N, 3], metres.
        quaternions: output [N, 4], wxyz.
        scales: output [N, 3], metres.
        colors, color_logit: outputs [N, 3].
        moves: output [N, 3], the pose-dependent offsets, metres.
        shapes: output [N, 3], what is skinned, metres; [0, 3] where nobody asks for it.
    """
    count = still.points.shape[0]
    step = (count + CHUNKS - 1) // CHUNKS
    own_rows, offsets, kept = len(learnt.rows) == 0, len(learnt.offset) > 0, len(shapes) > 0
    low, high, largest = still.limits[0], still.limits[1], still.limits[2]
    for chunk in numba.prange(CHUNKS):
        blended, turned = np.empty(12, np.float32), np.empty((3, 3), np.float32)
        shape, answer = np.empty(3, np.float32), np.empty(6, np.float32)
        for i in range(chunk * step, min(count, (chunk + 1) * step)):
            _add_up_bases(learnt.bases, i if own_rows else learnt.rows[i], frame.signal, answer)
            place = still.places[i]
            for k in range(3):
                logit, move = learnt.color_logit[i, k] + answer[k], answer[3 + k] * still.movable[i]
                color_logit[i, k], moves[i, k] = logit, move
                colors[i, k] = ONE / (ONE + np.exp(-logit))
                scale = still.initial[i, k] * np.exp(_clamped(learnt.log_scale[i, k], low, high))
                scales[i, k] = largest if scale > largest else scale
                shape[k] = still.points[i, k]
                if offsets:
                    shape[k] += learnt.offset[i, k]
                if place >= 0:
                    shape[k] += frame.moved[place, k]
                shape[k] += move
                if kept:
                    shapes[i, k] = shape[k]
            _blend_few(frame.transforms, still.joints, still.weights, i, blended)
            for row in range(3):
                value = blended[4 * row + 3] + frame.transl[row]
                for column in range(3):
                    value += blended[4 * row + column] * shape[column]
                    total = ZERO
                    for k in range(3):
                        total += blended[4 * row + k] * still.frames[i, k, column]
                    turned[row, column] = total
                means[i, row] = value
            _write_quaternion(turned, quaternions[i])


class Pushed(NamedTuple):
    """The loss's gradients of what ``pose_forward`` gave, [N, 3] float32; [0, 3] for none."""

    means: np.ndarray
    scales: np.ndarray
    colors: np.ndarray
    color_logit: np.ndarray
    moves: np.ndarray


@inline_kernel
def _push_joints(push, shape, joints, weights, point, sums):
    """Adds a point's share to the gradient of the joints' transforms."""
    for place in range(joints.shape[1]):
        weight, joint = weights[point, place], joints[point, place]
        if weight == 0:
            break
        for row in range(3):
            value = weight * push[row]
            for column in range(3):
                sums[joint, 4 * row + column] += value * shape[point, column]
            sums[joint, 4 * row + 3] += value


@checked_parallel_kernel
def pose_backward(
    still, learnt, frame, scales, colors, shapes, pushed,
    g_offset, g_log_scale, g_color_logit, g_bases, g_transforms, g_transl, g_moved,
):  # fmt: skip
    """The gradients of ``pose_forward``'s input.

    Args:
        still, learnt, frame: its input.
        scales, colors, shapes: its output; the gradients of the pose are left out where ``shapes`` is [0, 3].
        pushed: the loss's gradients of its output.
        g_offset, g_log_scale, g_color_logit: outputs [N, 3].
        g_bases: output [M, 6 K]; only the points' rows are written.
        g_transforms, g_transl: outputs [CHUNKS, 55, 12] and [CHUNKS, 3], added to, chunk by chunk.
        g_moved: output [P, 3].
    """
    count, directions = still.points.shape[0], len(frame.signal)
    step = (count + CHUNKS - 1) // CHUNKS
    own_rows, pose_asked = len(learnt.rows) == 0, len(shapes) > 0
    to_means, to_scales, to_colors = len(pushed.means) > 0, len(pushed.scales) > 0, len(pushed.colors) > 0
    to_logit, to_moves = len(pushed.color_logit) > 0, len(pushed.moves) > 0
    low, high, largest = still.limits[0], still.limits[1], still.limits[2]
    for chunk in numba.prange(CHUNKS):
        blended, push = np.empty(12, np.float32), np.empty(3, np.float32)
        answer = np.empty(6, np.float32)
        for i in range(chunk * step, min(count, (chunk + 1) * step)):
            row, place, unit = i if own_rows else learnt.rows[i], still.places[i], still.movable[i]
            reached = False
            for k in range(3):
                push[k] = pushed.means[i, k] if to_means else ZERO
                reached = reached or push[k] != 0
            if reached:
                _blend_few(frame.transforms, still.joints, still.weights, i, blended)
                if pose_asked:
                    for k in range(3):
                        g_transl[chunk, k] += push[k]
                    sums = g_transforms[chunk]
                    _push_joints(push, shapes, still.joints, still.weights, i, sums)
            for k in range(3):
                value = ZERO
                if reached:
                    value = blended[k] * push[0] + blended[4 + k] * push[1] + blended[8 + k] * push[2]
                g_offset[i, k] = value
                if pose_asked and place >= 0:
                    g_moved[place, k] = value
                if to_moves:
                    value += pushed.moves[i, k]
                answer[3 + k] = value * unit
                value = ZERO
                if to_colors:
                    color = colors[i, k]
                    value = pushed.colors[i, k] * color * (ONE - color)
                if to_logit:
                    value += pushed.color_logit[i, k]
                g_color_logit[i, k] = answer[k] = value
                value = ZERO
                if to_scales:
                    scale, log_scale = scales[i, k], learnt.log_scale[i, k]
                    if scale < largest and log_scale >= low and log_scale <= high:
                        value = pushed.scales[i, k] * scale
                g_log_scale[i, k] = value
            for k in range(6):
                for b in range(directions):
                    g_bases[row, k * directions + b] = answer[k] * frame.signal[b]
