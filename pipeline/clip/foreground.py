"""The person's own colours: the photograph's, and in the mask's soft edge what ingest made of the mixture.

Ingest stores ``foreground/`` beside ``frames/`` and ``masks/``. A folder without it (generated frames, whose
edges are clean) has the photograph's colours everywhere.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.clip.frames import read_frame, read_mask

FOREGROUND = "foreground"


def read_person(folder: Path, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """The person's colours, [H, W, 3] uint8 RGB, and soft alpha, [H, W] uint8, of a frame.

    Where alpha is 0 the colours are the photograph's.

    Args:
        folder: what ingest published, or another with ``frames`` and ``masks``.
        frame: its number.

    Raises:
        UserError: a picture is missing or damaged.
    """
    image, mask = read_frame(folder / "frames", frame), read_mask(folder / "masks", frame)
    if not (folder / FOREGROUND).is_dir():
        return image, mask
    own = read_frame(folder / FOREGROUND, frame)
    if own.shape != image.shape or mask.shape != image.shape[:2]:
        return image, mask  # whoever compares the sizes says so
    return np.where(mask[..., None] > 0, own, image), mask
