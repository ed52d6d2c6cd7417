"""The contact sheet ``preview.png`` of what was ingested."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from pipeline.clip.frames import read_frame, read_mask, spread_end_to_end, write_png
from pipeline.clip.keypoints import BODY, FACE, FEET, LEFT_HAND, RIGHT_HAND, Keypoints
from pipeline.pictures import contact_sheet

COLOURS = ((BODY, (255, 80, 60)), (FEET, (255, 170, 40)), (FACE, (250, 240, 90)), (LEFT_HAND, (80, 220, 255)),
           (RIGHT_HAND, (150, 130, 255)))  # fmt: skip
EDGE = (60, 255, 90)
TILE = 320  # pixels, a tile's longer side
FEW = 12  # tiles


def draw_frame(image: np.ndarray, mask: np.ndarray, points: np.ndarray, threshold: float = 0.4) -> np.ndarray:
    """The frame dimmed outside the mask, its edge in green, and the points that fit would use.

    Args:
        image: [H, W, 3] uint8 RGB.
        mask: [H, W] uint8.
        points: [133, 3], x, y, score.
        threshold: points that score less are left out.
    """
    alpha = mask[..., None] / 255.0
    drawn = (image * (0.35 + 0.65 * alpha)).astype(np.uint8)
    edges = cv2.findContours((mask > 127).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
    cv2.drawContours(drawn, edges, -1, EDGE, 1)
    for part, colour in COLOURS:
        for x, y, score in points[part]:
            if score >= threshold:
                cv2.circle(drawn, (int(x), int(y)), 1 if part != BODY else 3, colour, -1, cv2.LINE_AA)
    return drawn


def write_preview(output: Path, keypoints: Keypoints) -> None:
    """Write the contact sheet of at most twelve frames, with ``frames`` and ``masks`` in ``output``."""
    rows = spread_end_to_end(range(len(keypoints.frames)), FEW)
    tiles = [_tile(output, keypoints, row) for row in rows]
    columns = 4 if tiles[0].shape[1] >= tiles[0].shape[0] else 6
    write_png(
        output / "preview.png", contact_sheet(tiles, min(columns, len(tiles)))
    )  # cameras of one rig may differ in size


def _tile(output: Path, keypoints: Keypoints, row: int) -> np.ndarray:
    index = int(keypoints.frames[row])
    image, mask = read_frame(output / "frames", index), read_mask(output / "masks", index)
    drawn = draw_frame(image, mask, keypoints.whole_body[row])
    scale = TILE / max(drawn.shape[:2])
    tile = cv2.resize(drawn, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    cv2.putText(tile, str(index), (5, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1, cv2.LINE_AA)
    return tile
