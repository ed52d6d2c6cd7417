"""Gaussians as files for other programs hold them: checked, clamped, turned, in float64 on the CPU."""

from __future__ import annotations

import dataclasses

import numpy as np

from pipeline.config.choices import PlyUp
from pipeline.splat.gaussians import Gaussians

SH_0 = 0.28209479177387814  # the constant spherical harmonic, 1 / (2 sqrt(pi))

# Logit and logarithm have no finite value at the ends of their ranges.
_OPACITY_RANGE = (1e-6, 1 - 1e-6)
_SCALE_MIN = 1e-9  # metres

# Quarter turns about X from our world, whose Y is up, as quaternions' (w, x).
_HALF = np.sqrt(0.5)
_TURNS = {"y": (1.0, 0.0), "-y": (0.0, 1.0), "z": (_HALF, _HALF)}


@dataclasses.dataclass(frozen=True)
class StoredSplats:
    """Gaussians of which every number is finite.

    Attributes:
        means: [N, 3], metres.
        quaternions: [N, 4], (w, x, y, z), of length 1.
        scales: [N, 3], standard deviations, metres; at least 1e-9.
        colors: [N, 3], RGB.
        opacities: [N], in [1e-6, 1 - 1e-6].
    """

    means: np.ndarray
    quaternions: np.ndarray
    scales: np.ndarray
    colors: np.ndarray
    opacities: np.ndarray

    def __len__(self) -> int:
        return len(self.means)

    @property
    def log_scales(self) -> np.ndarray:
        """[N, 3], natural logarithms of metres."""
        return np.log(self.scales)

    @property
    def logits(self) -> np.ndarray:
        """[N], of the opacities."""
        return np.log(self.opacities) - np.log1p(-self.opacities)

    @property
    def harmonics(self) -> np.ndarray:
        """[N, 3], colours as the constant term of spherical harmonics, ``colour = 0.5 + SH_0 f_dc``."""
        return (self.colors - 0.5) / SH_0


def stored_splats(gaussians: Gaussians, up: PlyUp = "y") -> StoredSplats:
    """Gaussians without those that have a number that is not finite, or no orientation.

    Args:
        gaussians: in a world whose Y axis points up.
        up: the axis that points up in the file's world, which is turned about X.
    """
    mean, rotation, scale, color, opacity = (t.detach().cpu().double().numpy() for t in gaussians.tensors())
    with np.errstate(divide="ignore", invalid="ignore"):  # a zero quaternion becomes NaN
        unit = rotation / np.linalg.norm(rotation, axis=1, keepdims=True)
    mean, unit = _turned(mean, unit, *_TURNS[up])
    columns = (mean, unit, np.maximum(scale, _SCALE_MIN), color, np.clip(opacity, *_OPACITY_RANGE))
    with np.errstate(over="ignore"):  # what float32 cannot hold is not finite either
        whole = np.isfinite(np.column_stack(columns).astype(np.float32))
    kept = whole.all(1)
    return StoredSplats(*(one[kept] for one in columns))


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
