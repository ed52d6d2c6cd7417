"""The EWA projection of Gaussians into the image, forward and backward, as numba kernels.

The arithmetic is in double precision whatever the tensors' dtype: it is a small part of the time, and
degenerate Gaussians need the digits. Vectors are tuples of three doubles, matrices tuples of three rows.
Names as in ``constants``: ``point`` is x = R m + t, ``axes`` is M; ``g_x`` is the loss's gradient for x.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from pipeline.numba_kernels import kernel, parallel_kernel

# The columns of a record, which is all that the blending reads of a Gaussian. Sixteen columns are one cache
# line in single precision.
RECORD_WIDTH = 16
MEAN_X, MEAN_Y = 0, 1  # pixels
HALF_CONIC_XX, CONIC_XY, HALF_CONIC_YY = 2, 3, 4  # 1 / pixels squared
OPACITY, RED, GREEN, BLUE, DEPTH = 5, 6, 7, 8, 9
FIRST_ROW, END_ROW = 10, 11  # the rows of pixels that it can touch

# The columns of a Gaussian's gradient as the blending hands it back.
GRADIENT_WIDTH = 10

# A sum beyond this is taken for infinite.
_HUGE = 1e300

# Partial sums of the camera's gradient: their number is fixed, so that the result does not depend on threads.
CAMERA_CHUNKS = 64


@kernel
def _dot(a, b):
    """The scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def _multiply(a, b):
    """The product entry by entry."""
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


@kernel
def _combine(s, a, t, b):
    """The vector s a + t b."""
    return s * a[0] + t * b[0], s * a[1] + t * b[1], s * a[2] + t * b[2]


@kernel
def _row(matrix, i):
    """Row i of an array [N, 3] in double precision."""
    return np.float64(matrix[i, 0]), np.float64(matrix[i, 1]), np.float64(matrix[i, 2])


@kernel
def _times_matrix(a, m):
    """The row vector a times the matrix m."""
    x = a[0] * m[0][0] + a[1] * m[1][0] + a[2] * m[2][0]
    y = a[0] * m[0][1] + a[1] * m[1][1] + a[2] * m[2][1]
    z = a[0] * m[0][2] + a[1] * m[1][2] + a[2] * m[2][2]
    return x, y, z


@kernel
def _times_vector(m, a):
    """The matrix m times the column vector a."""
    return _dot(m[0], a), _dot(m[1], a), _dot(m[2], a)


@kernel
def _unit_quaternion(quaternions, i):
    """Quaternion i at length one, and the length that it had."""
    w, x = np.float64(quaternions[i, 0]), np.float64(quaternions[i, 1])
    y, z = np.float64(quaternions[i, 2]), np.float64(quaternions[i, 3])
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    return (w / norm, x / norm, y / norm, z / norm), norm


@kernel
def _rotation_matrix(q):
    """The rotation matrix of a unit quaternion (w, x, y, z)."""
    w, x, y, z = q
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


@kernel
def _to_camera(mean, rotation, translation):
    """The point R m + t."""
    x, y, z = _times_vector(rotation, mean)
    return x + translation[0], y + translation[1], z + translation[2]


@kernel
def _image_rows(point, rotation, lens):
    """The rows of J R, and J's four entries that are not zero: xx, xz, yy, yz."""
    inverse = 1.0 / point[2]
    u = min(max(point[0] * inverse, lens.left), lens.right)
    v = min(max(point[1] * inverse, lens.top), lens.bottom)
    xx, yy = lens.fx * inverse, lens.fy * inverse
    jacobian = (xx, -xx * u, yy, -yy * v)
    x_row = _combine(jacobian[0], rotation[0], jacobian[1], rotation[2])
    y_row = _combine(jacobian[2], rotation[1], jacobian[3], rotation[2])
    return x_row, y_row, jacobian


@kernel
def _covariance(x_row, y_row, dilation):
    """The dilated covariance's entries xx, xy, yy and its determinant, from the rows of J R M S.

    By Lagrange's identity det(A Aᵀ) is the square of the rows' cross product: it does not cancel for needles.
    """
    c0 = x_row[1] * y_row[2] - x_row[2] * y_row[1]
    c1 = x_row[2] * y_row[0] - x_row[0] * y_row[2]
    c2 = x_row[0] * y_row[1] - x_row[1] * y_row[0]
    xx, xy, yy = _dot(x_row, x_row), _dot(x_row, y_row), _dot(y_row, y_row)
    determinant = c0 * c0 + c1 * c1 + c2 * c2 + dilation * (xx + yy) + dilation * dilation
    return xx + dilation, xy, yy + dilation, determinant


@kernel
def _interval(centre, radius, size):
    """The pixels [first, end) whose centres can lie within ``radius`` of ``centre``, one to spare."""
    first = min(max(centre - radius - 0.5, 0.0), size)
    end = min(max(centre + radius + 1.5, 0.0), size)
    return int(first), int(end)


@kernel
def _has_image(mean, norm, scale, color, opacity, point, lens):
    """True for a Gaussian that is finite and before the camera. Written so that NaN gives False.

    Not with math.isfinite: it asks whether x - x equals itself, and "reassoc" cancels a sum against itself.
    """
    total = _dot(mean, mean) + _dot(scale, scale) + color[0] + color[1] + color[2] + opacity
    in_range = point[2] >= lens.near and point[2] <= lens.far
    oriented = norm >= lens.quaternion_min and norm <= lens.quaternion_max
    return abs(total) <= _HUGE and in_range and oriented and opacity >= lens.alpha_min


@parallel_kernel
def project_forward(
    means, quaternions, scales, colors, opacities, rotation, translation, lens, tile, records, boxes
):
    """Project N Gaussians.

    Args:
        means, quaternions, scales, colors, opacities: as in ``Gaussians``, float32 or float64 alike.
        rotation: float64 [3, 3]; translation: float64 [3].
        lens: a ``Pinhole``.
        tile: a tile's side, pixels.
        records: output [N, RECORD_WIDTH]; rows of Gaussians that are left out stay as they are.
        boxes: output int32 [N, 4], the tiles that a Gaussian can touch: first column, first row, end column,
            end row; all zero for one that is left out.
    """
    for i in prange(means.shape[0]):
        rows = _row(rotation, 0), _row(rotation, 1), _row(rotation, 2)  # nested tuples cannot enter a prange
        boxes[i, 0] = boxes[i, 1] = boxes[i, 2] = boxes[i, 3] = 0
        mean, scale, color = _row(means, i), _row(scales, i), _row(colors, i)
        opacity = np.float64(opacities[i])
        quaternion, norm = _unit_quaternion(quaternions, i)
        point = _to_camera(mean, rows, translation)
        if _has_image(mean, norm, scale, color, opacity, point, lens):
            axes = _rotation_matrix(quaternion)
            x_row, y_row, _ = _image_rows(point, rows, lens)
            x_row = _multiply(_times_matrix(x_row, axes), scale)
            y_row = _multiply(_times_matrix(y_row, axes), scale)
            xx, xy, yy, determinant = _covariance(x_row, y_row, lens.dilation)
            if xx <= lens.covariance_max and yy <= lens.covariance_max:
                px = lens.fx * point[0] / point[2] + lens.cx
                py = lens.fy * point[1] / point[2] + lens.cy
                # alpha is under ALPHA_MIN farther than this many standard deviations from the mean
                reach = math.sqrt(max(2.0 * math.log(opacity / lens.alpha_min), 0.0))
                x0, x1 = _interval(px, reach * math.sqrt(xx), lens.width)
                y0, y1 = _interval(py, reach * math.sqrt(yy), lens.height)
                if x0 < x1 and y0 < y1:
                    boxes[i, 0], boxes[i, 1] = x0 // tile, y0 // tile
                    boxes[i, 2], boxes[i, 3] = (x1 - 1) // tile + 1, (y1 - 1) // tile + 1
                    records[i, MEAN_X], records[i, MEAN_Y] = px, py
                    records[i, HALF_CONIC_XX] = 0.5 * yy / determinant
                    records[i, CONIC_XY] = -xy / determinant
                    records[i, HALF_CONIC_YY] = 0.5 * xx / determinant
                    records[i, OPACITY], records[i, DEPTH] = opacity, point[2]
                    records[i, RED], records[i, GREEN], records[i, BLUE] = color
                    records[i, FIRST_ROW], records[i, END_ROW] = y0, y1


@kernel
def _sum_slots(slots, first, end):
    """A Gaussian's gradient summed over its tiles: mean (2), conic xx, xy, yy, opacity, colour (3), depth."""
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = s8 = s9 = 0.0
    for j in range(first, end):
        s0 += slots[j, 0]
        s1 += slots[j, 1]
        s2 += slots[j, 2]
        s3 += slots[j, 3]
        s4 += slots[j, 4]
        s5 += slots[j, 5]
        s6 += slots[j, 6]
        s7 += slots[j, 7]
        s8 += slots[j, 8]
        s9 += slots[j, 9]
    return (s0, s1), (s2, s3, s4), s5, (s6, s7, s8), s9


@kernel
def _covariance_gradient(entries, conic_gradient):
    """The gradient for xx, xy, yy of a covariance, from that for its inverse Q: -Q G Q."""
    xx, xy, yy, determinant = entries
    qxx, qxy, qyy = yy / determinant, -xy / determinant, xx / determinant
    gxx, gyy = conic_gradient[0], conic_gradient[2]
    gxy = 0.5 * conic_gradient[1]  # which stands twice in the matrix
    e00, e01 = qxx * gxx + qxy * gxy, qxx * gxy + qxy * gyy
    e10, e11 = qxy * gxx + qyy * gxy, qxy * gxy + qyy * gyy
    off_diagonal = e00 * qxy + e01 * qyy + e10 * qxx + e11 * qxy
    return -(e00 * qxx + e01 * qxy), -off_diagonal, -(e10 * qxy + e11 * qyy)


@kernel
def _quaternion_gradient(q, norm, d):
    """The gradient for a quaternion of length ``norm`` and direction q, from that for its matrix, d."""
    w, x, y, z = q
    a, b, c = d[2][1] - d[1][2], d[0][2] - d[2][0], d[1][0] - d[0][1]
    e, f, g = d[0][1] + d[1][0], d[0][2] + d[2][0], d[1][2] + d[2][1]
    gw = 2.0 * (x * a + y * b + z * c)
    gx = 2.0 * (w * a + y * e + z * f - 2.0 * x * (d[1][1] + d[2][2]))
    gy = 2.0 * (w * b + x * e + z * g - 2.0 * y * (d[0][0] + d[2][2]))
    gz = 2.0 * (w * c + x * f + y * g - 2.0 * z * (d[0][0] + d[1][1]))
    along = gw * w + gx * x + gy * y + gz * z  # the length of a quaternion changes nothing
    return (gw - along * w) / norm, (gx - along * x) / norm, (gy - along * y) / norm, (gz - along * z) / norm


@kernel
def _point_gradient(point, rows, lens, jacobian, g_x_row, g_y_row, g_mean2d, g_depth):
    """The gradient for a Gaussian's place in the camera: through its mean, its depth and the Jacobian."""
    inverse = 1.0 / point[2]
    u, v = point[0] * inverse, point[1] * inverse
    gxx, gxz = _dot(g_x_row, rows[0]), _dot(g_x_row, rows[2])
    gyy, gyz = _dot(g_y_row, rows[1]), _dot(g_y_row, rows[2])
    gu, gv = lens.fx * g_mean2d[0], lens.fy * g_mean2d[1]
    # J's entries fx / z, -fx u / z, ... are proportional to 1 / z, and depend on u and v where not clamped.
    g_inverse = (gxx * jacobian[0] + gxz * jacobian[1] + gyy * jacobian[2] + gyz * jacobian[3]) * point[2]
    if u >= lens.left and u <= lens.right:
        gu -= jacobian[0] * gxz
    if v >= lens.top and v <= lens.bottom:
        gv -= jacobian[2] * gyz
    g_inverse += gu * point[0] + gv * point[1]
    return gu * inverse, gv * inverse, g_depth - g_inverse * inverse * inverse


@kernel
def _backward_one(mean, scale, quaternion, norm, point, rows, lens, g_mean2d, g_conic, g_depth):
    """The gradients of one Gaussian: point [3], scale [3], quaternion [4], and its share of R's rows."""
    axes = _rotation_matrix(quaternion)
    jr_x, jr_y, jacobian = _image_rows(point, rows, lens)
    turned_x, turned_y = _times_matrix(jr_x, axes), _times_matrix(jr_y, axes)
    x_row, y_row = _multiply(turned_x, scale), _multiply(turned_y, scale)
    gxx, gxy, gyy = _covariance_gradient(_covariance(x_row, y_row, lens.dilation), g_conic)

    g_x_row, g_y_row = _combine(2.0 * gxx, x_row, gxy, y_row), _combine(2.0 * gyy, y_row, gxy, x_row)
    g_scale = _combine(1.0, _multiply(g_x_row, turned_x), 1.0, _multiply(g_y_row, turned_y))
    g_turned_x, g_turned_y = _multiply(g_x_row, scale), _multiply(g_y_row, scale)
    g_axes = (
        _combine(jr_x[0], g_turned_x, jr_y[0], g_turned_y),
        _combine(jr_x[1], g_turned_x, jr_y[1], g_turned_y),
        _combine(jr_x[2], g_turned_x, jr_y[2], g_turned_y),
    )
    g_quaternion = _quaternion_gradient(quaternion, norm, g_axes)
    g_jr_x, g_jr_y = _times_vector(axes, g_turned_x), _times_vector(axes, g_turned_y)
    g_point = _point_gradient(point, rows, lens, jacobian, g_jr_x, g_jr_y, g_mean2d, g_depth)

    # R enters through the point, R m + t, and through J R.
    g_z_row = _combine(jacobian[1], g_jr_x, jacobian[3], g_jr_y)
    g_rotation = (
        _combine(g_point[0], mean, jacobian[0], g_jr_x),
        _combine(g_point[1], mean, jacobian[2], g_jr_y),
        _combine(g_point[2], mean, 1.0, g_z_row),
    )
    return g_point, g_scale, g_quaternion, g_rotation


@kernel
def _store(target, i, values):
    for k in range(len(values)):
        target[i, k] = values[k]


@kernel
def _backward_chunk(
    first, end, means, quaternions, scales, rotation, translation, lens, weights, slot_starts, slot_gradients,
    g_means, g_quaternions, g_scales, g_colors, g_opacities, g_camera,
):  # fmt: skip
    """``project_backward`` for the Gaussians [first, end), with their share of the camera's gradient [12]."""
    rows = _row(rotation, 0), _row(rotation, 1), _row(rotation, 2)
    zero = (0.0, 0.0, 0.0)
    sum_x, sum_y, sum_z, sum_point = zero, zero, zero, zero
    for i in range(first, end):
        if weights[i] == 0.0:
            _store(g_means, i, zero)
            _store(g_scales, i, zero)
            _store(g_colors, i, zero)
            _store(g_quaternions, i, (0.0, 0.0, 0.0, 0.0))
            g_opacities[i] = 0.0
            continue
        g_mean2d, g_conic, g_opacity, g_color, g_depth = _sum_slots(
            slot_gradients, slot_starts[i], slot_starts[i + 1]
        )
        mean, scale = _row(means, i), _row(scales, i)
        quaternion, norm = _unit_quaternion(quaternions, i)
        point = _to_camera(mean, rows, translation)
        g_point, g_scale, g_quaternion, g_rows = _backward_one(
            mean, scale, quaternion, norm, point, rows, lens, g_mean2d, g_conic, g_depth
        )
        _store(g_means, i, _times_matrix(g_point, rows))
        _store(g_scales, i, g_scale)
        _store(g_colors, i, g_color)
        _store(g_quaternions, i, g_quaternion)
        g_opacities[i] = g_opacity
        sum_x, sum_y = _combine(1.0, sum_x, 1.0, g_rows[0]), _combine(1.0, sum_y, 1.0, g_rows[1])
        sum_z, sum_point = _combine(1.0, sum_z, 1.0, g_rows[2]), _combine(1.0, sum_point, 1.0, g_point)
    for k in range(3):
        g_camera[k], g_camera[3 + k] = sum_x[k], sum_y[k]
        g_camera[6 + k], g_camera[9 + k] = sum_z[k], sum_point[k]


@parallel_kernel
def project_backward(
    means, quaternions, scales, rotation, translation, lens, weights, slot_starts, slot_gradients,
    g_means, g_quaternions, g_scales, g_colors, g_opacities, g_camera,
):  # fmt: skip
    """The gradients of ``project_forward``'s inputs.

    Args:
        means, quaternions, scales, rotation, translation, lens: as given to ``project_forward``.
        weights: [N], each Gaussian's summed weight; one without any has no gradient.
        slot_starts: as in ``Tiles``.
        slot_gradients: [M, GRADIENT_WIDTH], as ``blend_backward`` leaves them.
        g_means, g_quaternions, g_scales, g_colors, g_opacities: outputs, as the inputs are shaped.
        g_camera: output float64 [chunks, 12], partial sums of the gradients of R (row by row) and t.
    """
    n, chunks = means.shape[0], g_camera.shape[0]
    step = (n + chunks - 1) // chunks
    for chunk in prange(chunks):
        _backward_chunk(
            min(n, chunk * step), min(n, (chunk + 1) * step),
            means, quaternions, scales, rotation, translation, lens, weights, slot_starts, slot_gradients,
            g_means, g_quaternions, g_scales, g_colors, g_opacities, g_camera[chunk],
        )  # fmt: skip
