"""Gaussians as a file, in the format that its name ends with: ``.ply``, ``.spz`` or ``.glb``."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

from pipeline.config.choices import PlyUp, SplatFormat
from pipeline.errors import UserError
from pipeline.splat.gaussians import Gaussians
from pipeline.splat.ply import write_ply
from pipeline.splat.splat_glb import write_splat_glb
from pipeline.splat.spz import write_spz


def write_splats(path: Path, gaussians: Gaussians, up: PlyUp = "y", name: str = "avatar") -> None:
    """Writes Gaussians; those with a number that is not finite are left out.

    Args:
        path: the file; its suffix says the format.
        gaussians: in a world whose Y axis points up.
        up: the axis that points up in a ``.ply``; the other formats say so themselves.
        name: of the person in a ``.glb``, any text.

    Raises:
        UserError: the suffix is none of the formats'.
    """
    kind = Path(path).suffix.lower().removeprefix(".")
    if kind == "ply":
        write_ply(path, gaussians, up)
    elif kind == "spz":
        write_spz(path, gaussians)
    elif kind == "glb":
        write_splat_glb(path, gaussians, name)
    else:
        raise UserError(f"{path}: splats are written as .{', .'.join(get_args(SplatFormat))}")
