"""The terms of the registration objective (Section 3.1), each a pure function of tensors.

They return unreduced values; ``objective.py`` weights and sums them. Terms that the paper names carry
its symbol and equation number. Where the paper takes an L1 norm of parameters this version squares
them: a small departure from the prior then costs little, and a body part that is hardly seen still returns
to it.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

LONG_SIDE = 512.0  # pixels; errors in the picture are measured as if its long side were this


def keypoint_loss(
    projected: Tensor,  # [T, N, 2]
    target: Tensor,  # [T, N, 2]
    mask: Tensor,  # [T, N]
    saturation: Tensor | None = None,  # [N]
) -> Tensor:
    """L_kpt, Eq. 2: masked reprojection error m_j |Pi(V_j) - K_j|, in pixels.

    The norm is sqrt(|e|^2 + 1) - 1, which is differentiable where a point is hit exactly.

    Args:
        projected: where the points are seen in the model, pixels.
        target: K, where they were detected, pixels.
        mask: m, 0 or 1.
        saturation: upper limit of a point's loss, pixels: e s / (e + s), so that a wrong detection
            pulls no harder the farther it is; None leaves it linear.

    Returns:
        [T, N], pixels, 0 where masked.
    """
    error = torch.sqrt((projected - target).square().sum(-1) + 1) - 1
    if saturation is not None:
        error = error * saturation / (error + saturation)
    return torch.where(mask > 0, error, torch.zeros_like(error))


def outline_loss(distance: Tensor, saturation: float) -> Tensor:
    """The distance of outline points to the outline that was seen, which saturates as ``keypoint_loss`` does.

    Args:
        distance: signed, pixels, any shape.
        saturation: upper limit of a point's loss, pixels.
    """
    error = torch.sqrt(distance.square() + 1) - 1
    return error * saturation / (error + saturation)


def initial_loss(value: Tensor, initial: Tensor) -> Tensor:
    """L_init, Eq. 3, for one of theta, beta and psi: squared departure from the initial value."""
    return (value - initial).square()


def rotation_loss(matrices: Tensor, initial: Tensor) -> Tensor:
    """L_init, Eq. 3, for rotations: |R - R*|_F^2 / 2, which is near the squared angle between them.

    Unlike a difference of rotation vectors it has no seam at pi.

    Args:
        matrices, initial: [..., 3, 3].

    Returns:
        [...], 2 (1 - cos angle), square radians for small angles.
    """
    return (matrices - initial).square().sum((-2, -1)) / 2


def shape_loss(betas: Tensor) -> Tensor:
    """L_shape in Eq. 5: beta^2, [B]."""
    return betas.square()


def joint_offset_loss(joint_offset: Tensor) -> Tensor:
    """L_jo in Eq. 5: squared length of Delta J, [55, 3] -> [55], square metres."""
    return joint_offset.square().sum(-1)


def symmetry_loss(offset: Tensor, mirror: Tensor) -> Tensor:
    """L_sym in Eq. 5: squared difference between offsets of the left and the mirrored right.

    Args:
        offset: [N, 3], metres, X to the subject's left.
        mirror: [N, N], a row picks (or mixes) the points opposite to a point.

    Returns:
        [N], square metres.
    """
    opposite = (mirror @ offset) * offset.new_tensor([-1.0, 1.0, 1.0])
    return (offset - opposite).square().sum(-1)


def face_offset_loss(face_offset: Tensor) -> Tensor:
    """Squared length of Delta V_face at some points, [N, 3] -> [N], square metres."""
    return face_offset.square().sum(-1)


def direction_loss(start: Tensor, end: Tensor, unit: Tensor) -> Tensor:
    """1 - cos of the angle between bones and their detected directions.

    Args:
        start, end: [T, L, 3], the bones' ends.
        unit: [T, L, 3], unit vectors in the same axes.

    Returns:
        [T, L], 0 where they agree, 2 where they are opposite.
    """
    return 1 - (functional.normalize(end - start, dim=-1, eps=1e-6) * unit).sum(-1)


def in_front_loss(depth: Tensor, chest: Tensor, distance: float) -> Tensor:
    """The squared depth that points lack to be ``distance`` in front of the chest, where they are seen.

    With one camera the depth of a hand is free, and hands sink into the torso.

    Args:
        depth: [T, N], metres along the camera's axis.
        chest: [T], metres, the depth of the shoulders.
        distance: metres.

    Returns:
        [T, N], square metres.
    """
    return (depth - (chest[:, None] - distance)).clamp_min(0).square()


def joint_limit_loss(angle: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """The squared angle by which components of a rotation lie outside the joint's limits.

    Args:
        angle: [..., K], radians.
        low, high: [K], radians.

    Returns:
        [..., K], square radians, 0 within the range.
    """
    return (low - angle).clamp_min(0).square() + (angle - high).clamp_min(0).square()


def velocity(values: Tensor, times: Tensor) -> Tensor:
    """Differences of neighbouring frames, divided by the square root of the time between them.

    Its square summed over a gap of dropped frames is what the same motion, spread evenly over the
    missing frames, would have given, whatever the frame rate.

    Args:
        values: [T, ...].
        times: [T], increasing, in 30ths of a second.

    Returns:
        [T - 1, ...]; empty for one frame.
    """
    gap = _like(times.diff(), values)
    return values.diff(dim=0) / gap.sqrt()


def acceleration(values: Tensor, times: Tensor) -> Tensor:
    """Second difference a 30th of a second squared; x[t+1] - 2 x[t] + x[t-1] at that rate.

    Args:
        values: [T, ...].
        times: [T], increasing, in 30ths of a second.

    Returns:
        [T - 2, ...]; empty for fewer than three frames.
    """
    if len(values) < 3:
        return values[:0]
    gap = _like(times.diff(), values)
    rate = values.diff(dim=0) / gap
    return rate.diff(dim=0) * 2 / (gap[1:] + gap[:-1])


def _like(gap: Tensor, values: Tensor) -> Tensor:
    """[T - 1] -> [T - 1, 1, ...] of the values' dtype."""
    return gap.to(values.dtype).reshape(-1, *[1] * (values.dim() - 1))


def face_vertex_loss(points: Tensor, target: Tensor) -> Tensor:
    """L_vertex in Eq. 4: L1 distance between the body's face and the face that was fitted first.

    Args:
        points: V_face + Delta V_face, [F, 3], metres.
        target: V_FLAME at the same points, [F, 3], in the same frame of reference.

    Returns:
        [F], metres, |x| + |y| + |z|.
    """
    return (points - target).abs().sum(-1)


def face_laplacian_loss(points: Tensor, target: Tensor, laplacian: Tensor) -> Tensor:
    """L_lap in Eq. 4: squared L2 distance between uniform Laplacians, so that both faces curve alike.

    Args:
        points, target: [F, 3], metres.
        laplacian: [F, F], dense or sparse, takes places to mean of neighbours minus self.

    Returns:
        [F], square metres.
    """
    return (laplacian @ (points - target)).square().sum(-1)


def face_edge_loss(points: Tensor, target: Tensor, edges: Tensor) -> Tensor:
    """L_edge in Eq. 4: L1 distance between edge lengths, which keeps the mesh from stretching.

    Args:
        points, target: [F, 3], metres.
        edges: [L, 2], the ends of each edge.

    Returns:
        [L], metres.
    """

    def lengths(places: Tensor) -> Tensor:
        return (places[edges[:, 0]] - places[edges[:, 1]]).norm(dim=-1)

    return (lengths(points) - lengths(target)).abs()


def tie_of_two(seen: Tensor, weight: Tensor, tie: Tensor) -> Tensor:
    """The pair c that is least in sum_e weight_e (c_e - seen_e)^2 + tie (c_0 - c_1)^2.

    Args:
        seen, weight: [T, 2], weights above 0.
        tie: [T], how strongly both are held together.

    Returns:
        [T, 2].
    """
    first, second = weight.unbind(1)
    determinant = first * second + tie * (first + second)
    pulls = weight * seen
    both = tie * pulls.sum(1)
    pair = torch.stack([second * pulls[:, 0] + both, first * pulls[:, 1] + both], dim=1)
    return pair / determinant[:, None]
