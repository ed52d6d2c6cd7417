"""Avatars from Python, and the command ``flexiavatar``; ``pipeline`` and ``stages`` do the work.

``flexiavatar.load("data/artifacts/smile/train/latest").render(frame=0, size=512, yaw=90)`` is a picture.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pipeline.posable import PosableAvatar

_HERE = Path(__file__).resolve().parent
ROOT = _HERE / "checkout" if (_HERE / "checkout").is_dir() else _HERE.parent
"""The folder with dodo.py, ``pipeline``, ``stages`` and ``data``: in a wheel a part of this package, so that
nothing of such common names lies in an environment's own folder."""


def load(path: str | Path, body: str | Path | None = None) -> PosableAvatar:
    """Loads a trained avatar; see ``PosableAvatar`` for what it can do.

    Args:
        path: a subject's folder (``data/artifacts/smile``), what its training published
            (``.../train/latest``), or the ``avatar.safetensors`` in it.
        body: the body model that it was trained on; the open one if None.

    Raises:
        UserError: nothing there is an avatar, or it belongs to another body; one line that says what to do.
    """
    use_checkout()
    from pipeline.posable import load_posable

    return load_posable(Path(path), None if body is None else Path(body))


def use_checkout() -> None:
    """Puts the packages ``pipeline`` and ``stages`` on the path, once."""
    if str(ROOT) not in sys.path:
        sys.path.insert(0, str(ROOT))
