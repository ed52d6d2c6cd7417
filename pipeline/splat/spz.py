"""Gaussians as an ``.spz`` file, Niantic's packed splats: about a twentieth of the ``.ply``.

Version 3 of the format, which every reader knows: gzip, positions as fixed-point numbers of 24 bits, colours
and log scales of 8 bits, opacities of 8, quaternions of 32. The format says which way is up: its axes are
right, up and back, which are ours. gsply packs; nothing else is added.
"""

from __future__ import annotations

from pathlib import Path

import gsply
import numpy as np

from pipeline.splat.gaussians import Gaussians
from pipeline.splat.stored_splats import stored_splats

FRACTION_BITS = 14  # of a position: steps of 0.06 mm, up to 512 m from the origin
_FURTHEST = (1 << 23 - FRACTION_BITS) - 1.0  # metres; a number of 24 bits cannot hold more
_GZIP_TIME = slice(4, 8)


def write_spz(path: Path, gaussians: Gaussians) -> None:
    """Write Gaussians; what is not finite, or lies further off than 511 m, is left out.

    Equal Gaussians give equal bytes: the time that gzip notes in its header is set to zero.

    Args:
        path: the file.
        gaussians: in a world whose Y axis points up.
    """
    splats = stored_splats(gaussians)
    near = np.abs(splats.means).max(1, initial=0) <= _FURTHEST
    columns = (splats.means, splats.log_scales, splats.quaternions, splats.logits, splats.harmonics)
    means, scales, quaternions, logits, harmonics = (one[near].astype(np.float32) for one in columns)
    none = np.zeros((len(means), 0, 3), np.float32)
    data = gsply.GSData(means, scales, quaternions, logits, harmonics, none)
    gsply.write_spz(path, data, version=3, fractional_bits=FRACTION_BITS)
    content = bytearray(Path(path).read_bytes())
    content[_GZIP_TIME] = bytes(4)
    Path(path).write_bytes(content)
