"""Gaussians as the ``.ply`` file that 3D Gaussian splatting viewers read.

The layout is that of Kerbl et al. 2023: one ``vertex`` element of little-endian float32 properties. Colour is
kept as the constant term of spherical harmonics, ``colour = 0.5 + SH_0 f_dc``, opacity as a logit, scales as
natural logarithms. The view-dependent terms ``f_rest``, 15 a colour, are zero; some viewers require them.

The axis that points up is not part of the format. Scenes of the reference implementation have COLMAP's world,
whose -Y is up as a rule, and viewers show that upright (SuperSplat, antimatter15's, Inria's own, PlayCanvas).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.config.choices import PlyUp
from pipeline.splat.gaussians import Gaussians

SH_0 = 0.28209479177387814  # the constant spherical harmonic, 1 / (2 sqrt(pi))

REST = 45  # view-dependent coefficients, degrees 1 to 3 of three colours

_PROPERTIES = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
    *(f"f_rest_{place}" for place in range(REST)),
    *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)

# Logit and logarithm have no finite value at the ends of their ranges.
_OPACITY_RANGE = (1e-6, 1 - 1e-6)
_SCALE_MIN = 1e-9  # metres


# Quarter turns about X from our world, whose Y is up, as quaternions' (w, x).
_HALF = np.sqrt(0.5)
_TURNS = {"y": (1.0, 0.0), "-y": (0.0, 1.0), "z": (_HALF, _HALF)}


def write_ply(path: Path, gaussians: Gaussians, up: PlyUp = "y") -> None:
    """Write Gaussians; those with a number that is not finite, or without orientation, are left out.

    Opacities are clamped to [1e-6, 1 - 1e-6], scales to 1e-9 m and more; quaternions are normalised.

    Args:
        path: the file.
        gaussians: in a world whose Y axis points up.
        up: the axis that points up in the file's world, which is turned about X.
    """
    mean, rotation, scale, color, opacity = (t.detach().cpu().double().numpy() for t in gaussians.tensors())
    logit = np.log(np.clip(opacity, *_OPACITY_RANGE)) - np.log1p(-np.clip(opacity, *_OPACITY_RANGE))
    with np.errstate(divide="ignore", invalid="ignore"):  # a zero quaternion becomes NaN and is dropped below
        unit = rotation / np.linalg.norm(rotation, axis=1, keepdims=True)
    log_scale = np.log(np.maximum(scale, _SCALE_MIN))
    mean, unit = _turned(mean, unit, *_TURNS[up])
    rest = np.zeros((len(mean), REST))
    columns = [mean, np.zeros_like(mean), (color - 0.5) / SH_0, rest, logit[:, None], log_scale, unit]
    rows = np.concatenate(columns, 1).astype("<f4")
    rows = rows[np.isfinite(rows).all(1)]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    lines += [f"property float {name}" for name in _PROPERTIES] + ["end_header", ""]
    Path(path).write_bytes("\n".join(lines).encode("ascii") + rows.tobytes())


def _turned(points: np.ndarray, unit: np.ndarray, w: float, x: float) -> tuple[np.ndarray, np.ndarray]:
    """Points [N, 3] and quaternions [N, 4] (w, x, y, z) after the turn about X of quaternion (w, x, 0, 0)."""
    if x == 0:
        return points, unit
    cosine, sine = w * w - x * x, 2 * w * x
    turned = np.stack(
        [
            points[:, 0],
            cosine * points[:, 1] - sine * points[:, 2],
            sine * points[:, 1] + cosine * points[:, 2],
        ],
        1,
    )
    a, b, c, d = unit.T
    return turned, np.stack([w * a - x * b, w * b + x * a, w * c - x * d, w * d + x * c], 1)
