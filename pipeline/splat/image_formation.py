"""Image formation: the equations that every backend of ``render`` computes, and the numbers in them.

A Gaussian with mean m, unit quaternion q, scales s, opacity o and colour c (3D Gaussian splatting,
Kerbl et al. 2023; EWA splatting, Zwicker et al. 2001; the constants are gsplat's):

* in the camera ``x = R m + t``; seen when ``NEAR <= x_z <= FAR``;
* its image is a Gaussian with mean ``K x / x_z`` and covariance ``J R M S S Mᵀ Rᵀ Jᵀ + DILATION I``, where M
  is the rotation matrix of q, S = diag(s), and J the Jacobian of the projection at x. The ratios x_x/x_z
  and x_y/x_z that enter J (not those that enter the mean) are clamped to the image and a margin around it,
  because the linearisation is of no use far outside;
* at a pixel centre at the offset d from the mean, ``sigma = d · conic · d / 2`` and
  ``alpha = min(ALPHA_MAX, o exp(-sigma))``, skipped under ALPHA_MIN;
* front to back in order of depth (compared in single precision, equal ones in order of index),
  ``weight = alpha T`` and ``T <- T (1 - alpha)``, T starting at one. The first Gaussian that would take T to
  TRANSMITTANCE_MIN or below is not drawn, and ends its pixel;
* ``colour = sum weight c``, ``depth = sum weight x_z``, ``alpha = 1 - T``.

A Gaussian is left out of all of this, and has no gradient, when one of its numbers is not finite, when its
quaternion's length is outside [QUATERNION_MIN, QUATERNION_MAX], when its covariance in the image exceeds
COVARIANCE_MAX, or when it does not touch the image.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

NEAR = 0.01  # metres
FAR = 1e10  # metres
DILATION = 0.3  # pixels squared, added to the variance in the image
ALPHA_MAX = 0.999
ALPHA_MIN = 1.0 / 255.0
TRANSMITTANCE_MIN = 1e-4
JACOBIAN_MARGIN = 0.3  # of half the field of view, to each side of the image
QUATERNION_MIN, QUATERNION_MAX = 1e-12, 1e12
COVARIANCE_MAX = 1e16  # pixels squared: its square is still finite in single precision


class Pinhole(NamedTuple):
    """A camera's intrinsics and the limits above, as the projection's kernels take them; pixels."""

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
    near: float = NEAR
    far: float = FAR
    dilation: float = DILATION
    alpha_min: float = ALPHA_MIN
    quaternion_min: float = QUATERNION_MIN
    quaternion_max: float = QUATERNION_MAX
    covariance_max: float = COVARIANCE_MAX


def make_pinhole(intrinsics: np.ndarray, width: int, height: int) -> Pinhole:
    """The pinhole with intrinsics ``K`` [3, 3] for an image of ``width`` x ``height`` pixels."""
    fx, fy = float(intrinsics[0, 0]), float(intrinsics[1, 1])
    cx, cy = float(intrinsics[0, 2]), float(intrinsics[1, 2])
    margin_x = JACOBIAN_MARGIN * 0.5 * width / fx
    margin_y = JACOBIAN_MARGIN * 0.5 * height / fy
    return Pinhole(
        *(fx, fy, cx, cy),
        width=float(width),
        height=float(height),
        left=-cx / fx - margin_x,
        right=(width - cx) / fx + margin_x,
        top=-cy / fy - margin_y,
        bottom=(height - cy) / fy + margin_y,
    )
