"""Gaussians as the ``.ply`` file that 3D Gaussian splatting viewers read.

The layout is that of Kerbl et al. 2023 without view-dependent colour: one ``vertex`` element of
little-endian float32 properties. Colour is kept as the constant term of spherical harmonics,
``colour = 0.5 + SH_0 f_dc``, opacity as a logit, scales as natural logarithms.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from pipeline.errors import UserError
from pipeline.splat.gaussians import Gaussians

SH_0 = 0.28209479177387814  # the constant spherical harmonic, 1 / (2 sqrt(pi))

_MEAN = ("x", "y", "z")
_NORMAL = ("nx", "ny", "nz")
_COLOR = ("f_dc_0", "f_dc_1", "f_dc_2")
_OPACITY = ("opacity",)
_SCALE = ("scale_0", "scale_1", "scale_2")
_ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
_PROPERTIES = _MEAN + _NORMAL + _COLOR + _OPACITY + _SCALE + _ROTATION

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


def read_ply(path: Path) -> Gaussians:
    """Read Gaussians as float32; properties other than those of ``write_ply`` are ignored.

    Raises:
        UserError: the file is missing, truncated, or no such ``.ply``.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); evaluate writes such a file") from None
    head, marker, body = data.partition(b"end_header\n")
    lines = head.decode("ascii", errors="replace").split("\n")
    if not marker or lines[:2] != ["ply", "format binary_little_endian 1.0"]:
        raise UserError(f"{path}: not a binary little-endian .ply file; export the splats again")
    count, names = _vertex_layout(path, lines)
    size = count * len(names) * 4
    if len(body) < size:
        raise UserError(f"{path}: truncated, {len(body)} of {size} bytes; write or copy it again")
    rows = np.frombuffer(body, "<f4", count=count * len(names)).reshape(count, len(names)).astype(np.float32)

    def columns(wanted: tuple[str, ...]) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(rows[:, [names.index(name) for name in wanted]]))

    colors, opacities = 0.5 + SH_0 * columns(_COLOR), torch.sigmoid(columns(_OPACITY))[:, 0]
    return Gaussians(columns(_MEAN), columns(_ROTATION), columns(_SCALE).exp(), colors, opacities)


def _vertex_layout(path: Path, lines: list[str]) -> tuple[int, list[str]]:
    """The number of vertices and the names of their properties, of a file whose only element they are."""
    words = [line.split() for line in lines if line and not line.startswith("comment")]
    elements = [word for word in words if word[0] == "element"]
    if [word[1] for word in elements] != ["vertex"] or not elements[0][-1].isdigit():
        raise UserError(f"{path}: must have vertices and nothing else; export the splats again")
    properties = [word for word in words if word[0] == "property"]
    names = [word[-1] for word in properties]
    missing = set(_PROPERTIES) - set(_NORMAL) - set(names)
    if missing or any(word[1:-1] not in (["float"], ["float32"]) for word in properties):
        reason = f"lacks {', '.join(sorted(missing))}" if missing else "has properties that are not float"
        raise UserError(f"{path}: {reason}; export the splats again")
    return int(elements[0][-1]), names
