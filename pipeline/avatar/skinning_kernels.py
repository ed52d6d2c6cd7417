"""The kernels of skinning: blended transforms, posed points, normals and orientations of Gaussians.

``skinning_tables.py`` says what ``skin_points``, ``normals_of_vertices`` and ``place_gaussians`` mean, and
``fused_posing.py`` what ``pose_forward`` and ``pose_backward`` do.
"""

from __future__ import annotations

import numba
import numpy as np

from pipeline.numba_kernels import checked_parallel_kernel, inline_kernel, kernel, parallel_kernel

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


@kernel
def _add_up_bases(bases, row, signal, answer):
    """The six sums of a row's bases, each times its number of the signal."""
    count = np.uint64(len(signal))
    first = np.uint64(0)
    for k in range(6):
        total = ZERO
        for b in range(count):
            total += bases[row, first + b] * signal[b]
        answer[k] = total
        first += count


@kernel
def _blend_few(transforms, joints, weights, point, blended):
    """As ``_blend``; joints are in the order of their weights, so that the first of zero ends it."""
    for k in range(12):
        blended[k] = ZERO
    for place in range(np.uint64(joints.shape[1])):
        weight, joint = weights[point, place], joints[point, place]
        if weight == 0:
            break
        for k in range(12):
            blended[k] += weight * transforms[joint, k]


@kernel
def _clamped(value, low, high):
    """As ``torch.clamp``: what is not a number stays as it is."""
    if value < low:
        return low
    if value > high:
        return high
    return value


@kernel
def _write(row, values, point):
    for k in range(3):
        values[point, k] = row[k]


@kernel
def _shape(still, learnt, frame, point, answer, moves, shape):
    """A point before skinning: rest shape, static offset, expression, and the bases' offset."""
    place = still.places[point]
    for k in range(3):
        moves[point, k] = answer[3 + k] * still.movable[point]
        value = still.points[point, k] + moves[point, k]
        if len(learnt.offset):
            value += learnt.offset[point, k]
        if place >= 0:
            value += frame.moved[np.uint64(place), k]
        shape[k] = value


@kernel
def _look(still, learnt, point, answer, scales, colors, color_logit):
    """A point's scales and colours."""
    low, high, largest = still.limits[0], still.limits[1], still.limits[2]
    for k in range(3):
        logit = learnt.color_logit[point, k] + answer[k]
        color_logit[point, k], colors[point, k] = logit, ONE / (ONE + np.exp(-logit))
        scale = still.initial[point, k] * np.exp(_clamped(learnt.log_scale[point, k], low, high))
        scales[point, k] = largest if scale > largest else scale


@kernel
def _place(blended, shape, frame_at_rest, transl, point, means, turned):
    """A point in the world, and the turned axes of its Gaussian."""
    for row in range(3):
        value = blended[4 * row + 3] + transl[row]
        for column in range(3):
            value += blended[4 * row + column] * shape[column]
            total = ZERO
            for k in range(3):
                total += blended[4 * row + k] * frame_at_rest[k, column]
            turned[row, column] = total
        means[point, row] = value


@kernel
def _pose_points(
    first, end, still, learnt, frame, means, quaternions, scales, colors, color_logit, moves, shapes
):
    own_rows, kept = len(learnt.rows) == 0, len(shapes) > 0
    blended, turned = np.empty(12, np.float32), np.empty((3, 3), np.float32)
    shape, answer = np.empty(3, np.float32), np.empty(6, np.float32)
    for i in range(np.uint64(first), np.uint64(end)):  # unsigned: it does not count from the end
        _add_up_bases(learnt.bases, i if own_rows else np.uint64(learnt.rows[i]), frame.signal, answer)
        _shape(still, learnt, frame, i, answer, moves, shape)
        _look(still, learnt, i, answer, scales, colors, color_logit)
        if kept:
            _write(shape, shapes, i)
        _blend_few(frame.transforms, still.joints, still.weights, i, blended)
        _place(blended, shape, still.frames[i], frame.transl, i, means, turned)
        _write_quaternion(turned, quaternions[i])


@parallel_kernel
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
    # Outputs are no named tuple: numba takes what is only written in one for dead in a parallel loop.
    count = still.points.shape[0]
    step = (count + CHUNKS - 1) // CHUNKS
    for chunk in numba.prange(CHUNKS):
        first, end = chunk * step, min(count, (chunk + 1) * step)
        _pose_points(
            first, end, still, learnt, frame, means, quaternions, scales, colors, color_logit, moves, shapes
        )


@kernel
def _read(values, point, row):
    """Copies a point's row, zeros where there are no values; returns True where any of it is not zero."""
    there = len(values) > 0
    for k in range(3):
        row[k] = values[point, k] if there else ZERO
    return row[0] != 0 or row[1] != 0 or row[2] != 0


@kernel
def _push_joints(push, shape, joints, weights, point, sums, total):
    """Adds a point's share to the gradient of the joints' transforms, and to that of the translation."""
    for row in range(3):
        total[row] += push[row]
    for place in range(np.uint64(joints.shape[1])):
        weight, joint = weights[point, place], joints[point, place]
        if weight == 0:
            break
        for row in range(3):
            value = weight * push[row]
            for column in range(3):
                sums[joint, 4 * row + column] += value * shape[point, column]
            sums[joint, 4 * row + 3] += value


@kernel
def _turn_back(blended, push):
    """Turns the gradient of a posed point into that of the point at rest, in place."""
    x, y, z = push[0], push[1], push[2]
    for k in range(3):
        push[k] = blended[k] * x + blended[4 + k] * y + blended[8 + k] * z


@kernel
def _push_scales(still, log_scales, scales, pushed, point, g_log_scale):
    """Writes the gradient of a point's log scales; there is none where the scale was clamped."""
    low, high, largest = still.limits[0], still.limits[1], still.limits[2]
    for k in range(3):
        scale, log_scale = scales[point, k], log_scales[point, k]
        free = scale < largest and log_scale >= low and log_scale <= high
        g_log_scale[point, k] = pushed[k] * scale if free else ZERO


@kernel
def _push_bases(answer, signal, row, g_bases):
    """Writes the gradient of a row of bases, from that of their six sums."""
    count = np.uint64(len(signal))
    first = np.uint64(0)
    for k in range(6):
        for b in range(count):
            g_bases[row, first + b] = answer[k] * signal[b]
        first += count


@kernel
def _push_points(
    first, end, still, learnt, frame, scales, colors, shapes, pushed,
    g_offset, g_log_scale, g_color_logit, g_bases, g_transforms, g_transl, g_moved,
):  # fmt: skip
    """``pose_backward`` for the points [first, end), with their share of the gradient of the pose."""
    own_rows, pose_asked = len(learnt.rows) == 0, len(shapes) > 0
    blended, push, more = np.empty(12, np.float32), np.empty(3, np.float32), np.empty(3, np.float32)
    answer = np.empty(6, np.float32)
    for i in range(np.uint64(first), np.uint64(end)):  # unsigned: it does not count from the end
        if _read(pushed.means, i, push):
            _blend_few(frame.transforms, still.joints, still.weights, i, blended)
            if pose_asked:
                _push_joints(push, shapes, still.joints, still.weights, i, g_transforms, g_transl)
            _turn_back(blended, push)
        _write(push, g_offset, i)
        if pose_asked and still.places[i] >= 0:
            _write(push, g_moved, np.uint64(still.places[i]))
        _read(pushed.moves, i, more)
        for k in range(3):
            answer[3 + k] = (push[k] + more[k]) * still.movable[i]
        _read(pushed.colors, i, push)
        _read(pushed.color_logit, i, more)
        for k in range(3):
            answer[k] = push[k] * colors[i, k] * (ONE - colors[i, k]) + more[k]
            g_color_logit[i, k] = answer[k]
        _read(pushed.scales, i, push)
        _push_scales(still, learnt.log_scale, scales, push, i, g_log_scale)
        _push_bases(answer, frame.signal, i if own_rows else np.uint64(learnt.rows[i]), g_bases)


@parallel_kernel
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
    count = still.points.shape[0]
    step = (count + CHUNKS - 1) // CHUNKS
    for chunk in numba.prange(CHUNKS):
        first, end = chunk * step, min(count, (chunk + 1) * step)
        _push_points(
            first, end, still, learnt, frame, scales, colors, shapes, pushed,
            g_offset, g_log_scale, g_color_logit, g_bases, g_transforms[chunk], g_transl[chunk], g_moved,
        )  # fmt: skip
