"""Gaussians as the ``.ply`` file that 3D Gaussian splatting viewers read.

The layout is that of Kerbl et al. 2023 without view-dependent colour: one ``vertex`` element of
little-endian float32 properties. Colour is kept as the constant term of spherical harmonics,
``colour = 0.5 + SH_0 f_dc``, opacity as a logit, scales as natural logarithms.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.splat.gaussians import Gaussians

SH_0 = 0.28209479177387814  # the constant spherical harmonic, 1 / (2 sqrt(pi))

_PROPERTIES = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)

# Logit and logarithm have no finite value at the ends of their ranges.
_OPACITY_RANGE = (1e-6, 1 - 1e-6)
_SCALE_MIN = 1e-9  # metres


def write_ply(path: Path, gaussians: Gaussians) -> None:
    """Write Gaussians; those with a number that is not finite, or without orientation, are left out.

    Opacities are clamped to [1e-6, 1 - 1e-6], scales to 1e-9 m and more; quaternions are normalised.
    """
    mean, rotation, scale, color, opacity = (t.detach().cpu().double().numpy() for t in gaussians.tensors())
    logit = np.log(np.clip(opacity, *_OPACITY_RANGE)) - np.log1p(-np.clip(opacity, *_OPACITY_RANGE))
    with np.errstate(divide="ignore", invalid="ignore"):  # a zero quaternion becomes NaN and is dropped below
        unit = rotation / np.linalg.norm(rotation, axis=1, keepdims=True)
    log_scale = np.log(np.maximum(scale, _SCALE_MIN))
    columns = [mean, np.zeros_like(mean), (color - 0.5) / SH_0, logit[:, None], log_scale, unit]
    rows = np.concatenate(columns, 1).astype("<f4")
    rows = rows[np.isfinite(rows).all(1)]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    lines += [f"property float {name}" for name in _PROPERTIES] + ["end_header", ""]
    Path(path).write_bytes("\n".join(lines).encode("ascii") + rows.tobytes())
