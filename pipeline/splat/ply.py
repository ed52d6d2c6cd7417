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
from pipeline.splat.stored_splats import stored_splats

REST = 45  # view-dependent coefficients, degrees 1 to 3 of three colours

_PROPERTIES = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
    *(f"f_rest_{place}" for place in range(REST)),
    *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)


def write_ply(path: Path, gaussians: Gaussians, up: PlyUp = "y") -> None:
    """Write Gaussians; those with a number that is not finite, or without orientation, are left out.

    Opacities are clamped to [1e-6, 1 - 1e-6], scales to 1e-9 m and more; quaternions are normalised.

    Args:
        path: the file.
        gaussians: in a world whose Y axis points up.
        up: the axis that points up in the file's world, which is turned about X.
    """
    splats = stored_splats(gaussians, up)
    rest, normals = np.zeros((len(splats), REST)), np.zeros((len(splats), 3))
    columns = [splats.means, normals, splats.harmonics, rest, splats.logits[:, None], splats.log_scales]
    rows = np.concatenate([*columns, splats.quaternions], 1).astype("<f4")
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    lines += [f"property float {name}" for name in _PROPERTIES] + ["end_header", ""]
    Path(path).write_bytes("\n".join(lines).encode("ascii") + rows.tobytes())
