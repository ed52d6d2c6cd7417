"""``frames.png``: some frames of a motion on one sheet."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

_COLUMNS = 4
_LARGEST = 320  # pixels of a picture's longer side
_BAND = 22
_GAP = 4
_PAPER, _INK = 255, (40, 40, 40)


def contact_sheet(pictures: Mapping[str, np.ndarray]) -> np.ndarray:
    """Pictures of one size in rows of four, each under its caption: caption -> [H, W, 3] uint8 RGB."""
    cells = [_cell(caption, picture) for caption, picture in pictures.items()]
    columns = min(_COLUMNS, len(cells))
    cells += [np.full_like(cells[0], _PAPER)] * (-len(cells) % columns)
    rows = [np.concatenate(cells[start : start + columns], 1) for start in range(0, len(cells), columns)]
    return np.concatenate(rows)


def _cell(caption: str, picture: np.ndarray) -> np.ndarray:
    share = min(1.0, _LARGEST / max(picture.shape[:2]))
    size = tuple(max(1, round(side * share)) for side in picture.shape[1::-1])
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA) if share < 1 else picture
    band = np.full((_BAND, small.shape[1], 3), _PAPER, np.uint8)
    cv2.putText(band, caption, (4, _BAND - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.42, _INK, 1, cv2.LINE_AA)
    whole = np.concatenate([band, small])
    return np.pad(whole, ((0, _GAP), (0, _GAP), (0, 0)), constant_values=_PAPER)
