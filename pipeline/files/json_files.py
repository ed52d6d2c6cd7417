"""JSON files as this project writes them, for people and programs: sorted, indented, finite.

Reading JSON, which may be somebody else's, is ``pipeline.untrusted.parse_json``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pipeline.finite import NotFiniteError


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file.

    Raises:
        NotFiniteError: a number is not finite; names its place.
    """
    place = _not_finite_in(value)
    if place is not None:
        raise NotFiniteError(f"{path.name}: {place} is not finite")
    path.write_text(json_text(value), encoding="utf-8")


def json_text(value: Any) -> str:
    """The text of a JSON file; ValueError where a number is not finite."""
    return json.dumps(value, indent=1, sort_keys=True, allow_nan=False) + "\n"


def _not_finite_in(value: Any, place: str = "") -> str | None:
    """The place of the first number in JSON content that is not finite, as "means.test.psnr"; else None."""
    if isinstance(value, float):
        return None if math.isfinite(value) else place
    parts: Iterable[tuple[Any, Any]] = ()
    if isinstance(value, Mapping):
        parts = value.items()
    elif isinstance(value, list | tuple):
        parts = enumerate(value)
    for key, part in parts:
        found = _not_finite_in(part, f"{place}.{key}" if place else str(key))
        if found is not None:
            return found
    return None
