"""A pinhole as the projection's kernels take it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.splat import image_formation as constants


class Lens(NamedTuple):
    """A camera's intrinsics and the limits of ``constants``, in double precision. Lengths in pixels."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: float
    height: float
    left: float  # limits of x_x / x_z and x_y / x_z in the Jacobian
    right: float
    top: float
    bottom: float
    near: float = constants.NEAR
    far: float = constants.FAR
    dilation: float = constants.DILATION
    alpha_min: float = constants.ALPHA_MIN
    quaternion_min: float = constants.QUATERNION_MIN
    quaternion_max: float = constants.QUATERNION_MAX
    covariance_max: float = constants.COVARIANCE_MAX


def make_lens(intrinsics: np.ndarray, width: int, height: int) -> Lens:
    """The lens of a pinhole with intrinsics ``K`` [3, 3] for an image of ``width`` x ``height`` pixels."""
    fx, fy = float(intrinsics[0, 0]), float(intrinsics[1, 1])
    cx, cy = float(intrinsics[0, 2]), float(intrinsics[1, 2])
    margin_x = constants.JACOBIAN_MARGIN * 0.5 * width / fx
    margin_y = constants.JACOBIAN_MARGIN * 0.5 * height / fy
    return Lens(
        fx,
        fy,
        cx,
        cy,
        width=float(width),
        height=float(height),
        left=-cx / fx - margin_x,
        right=(width - cx) / fx + margin_x,
        top=-cy / fy - margin_y,
        bottom=(height - cy) / fy + margin_y,
    )
