"""The size that a picture claims, before anything is decoded."""

from __future__ import annotations

import io
import warnings
from pathlib import Path

from pipeline.errors import UserError

MOST_PIXELS = 100_000_000  # 300 MB of RGB; 8K footage has 33 million


def check_picture(path: Path, remedy: str, content: bytes | None = None, most: int = MOST_PIXELS) -> None:
    """Refuse a picture that would not fit into memory.

    Args:
        path: the file.
        remedy: what the user can do; it ends the error's line.
        content: the file's bytes, where they are known already.
        most: pixels.

    Raises:
        UserError: no picture of a known kind, or more pixels than allowed.
    """
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(content) if content is not None else path) as picture:
                width, height = picture.size
    except Image.DecompressionBombError:
        raise UserError(f"{path} claims more pixels than {most:,}: {remedy}") from None
    except Exception:  # a damaged header raises nearly anything
        raise UserError(f"{path} is not a readable picture: {remedy}") from None
    if width * height > most or min(width, height) < 1:
        raise UserError(f"{path} claims {width}x{height} pixels, more than {most:,}: {remedy}")
