"""Given keypoints on the person's mask: which person is meant, and whether they are of this footage."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np

from pipeline.errors import UserError

TRUSTED = 0.3  # score of a point that must lie on the person
OFF_FRAME, OFF_CLIP = 0.5, 0.7  # shares of points on the person under which a frame, a clip is not believed
_REACH = 0.04  # of the mask's longer side: how far from it a point may lie
_FITS = 0.85  # of the points that a change of scale brings onto the person
_FEW = 5  # points; fewer prove nothing


@dataclasses.dataclass(frozen=True)
class Agreement:
    """How a frame's points lie on its mask.

    Attributes:
        path: the file of the points.
        share: of the trusted points that lie on the person; NaN where too few are trusted.
        points: [133, 3], pixels of the stored frame.
        on_mask: [H, W] bool, the mask and what is near it.
    """

    path: Path
    share: float
    points: np.ndarray
    on_mask: np.ndarray

    def without_pictures(self) -> Agreement:
        """The share alone."""
        return dataclasses.replace(self, points=np.zeros((0, 3), np.float32), on_mask=np.zeros((0, 0), bool))


def widened(mask: np.ndarray) -> np.ndarray:
    """The pixels of a mask [H, W] in [0, 1] and those near it, bool."""
    solid = (mask > 0.3).astype(np.uint8)
    rows, columns = np.flatnonzero(solid.any(1)), np.flatnonzero(solid.any(0))
    if not len(rows):
        return solid.astype(bool)
    reach = 2 + round(_REACH * max(rows[-1] - rows[0], columns[-1] - columns[0]))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    return cv2.dilate(solid, kernel).astype(bool)


def share_on(points: np.ndarray, area: np.ndarray) -> float:
    """The share of the trusted points [N, 3] that lie in an area [H, W] bool; NaN where there are too few."""
    trusted = points[points[:, 2] >= TRUSTED, :2]
    if len(trusted) < _FEW:
        return float("nan")
    pixels = np.floor(trusted).astype(int)
    inside = ((pixels >= 0) & (pixels < area.shape[::-1])).all(1)
    return float(area[pixels[inside, 1], pixels[inside, 0]].sum() / len(trusted))


def choose_person(people: np.ndarray, mask: np.ndarray, path: Path) -> Agreement:
    """The one of P >= 1 people [P, 133, 3] whose points lie best on a mask [H, W] in [0, 1]."""
    area = widened(mask)
    shares = np.array([share_on(points, area) for points in people])
    worth = np.nan_to_num(shares) * people[:, :, 2].mean(1) + 1e-6 * people[:, :, 2].mean(1)
    best = int(np.argmax(worth))
    return Agreement(path, float(shares[best]), people[best], area)


def check_agreement(found: list[Agreement]) -> None:
    """Refuse a clip whose points do not lie on the person; UserError names the first such file."""
    judged = [one for one in found if np.isfinite(one.share)]
    if not judged or float(np.median([one.share for one in judged])) >= OFF_CLIP:
        return
    worst = next(one for one in judged if one.share < OFF_CLIP)
    height, width = worst.on_mask.shape
    lying = f"{worst.path}: {worst.share:.0%} of its points lie on the person's mask"
    scale = fitting_scale(judged)
    if scale is not None:
        raise UserError(
            f"{lying}, and {_FITS:.0%} would if they were multiplied by {scale:.2f}: they are of pictures of "
            "another size; write them again in the pixels of this footage"
        )
    raise UserError(
        f"{lying} ({width}x{height}): give keypoints of this footage and person, in its pixels, "
        "or check ingest.masks"
    )


def fitting_scale(found: list[Agreement]) -> float | None:
    """The factor that brings the points of most frames onto the person; None where none does."""
    ratios = []
    for one in found:
        trusted = one.points[one.points[:, 2] >= TRUSTED, :2]
        rows, columns = np.nonzero(one.on_mask)
        if len(trusted) and len(rows):
            # The furthest trusted points lie at the person's right and lower rim, or inside.
            ratios.append(np.mean([columns.mean(), rows.mean()]) / max(float(trusted.mean()), 1e-6))
    if not ratios:
        return None
    scales = float(np.median(ratios)) * np.geomspace(0.5, 2.0, 41)
    shares = np.array([np.nanmedian([_scaled_share(one, scale) for one in found]) for scale in scales])
    best = float(np.median(scales[shares >= shares.max() - 0.02]))  # the middle of all that fit as well
    return best if shares.max() >= _FITS and abs(best - 1) > 0.05 else None


def _scaled_share(one: Agreement, scale: float) -> float:
    return share_on(one.points * np.array([scale, scale, 1]), one.on_mask)
