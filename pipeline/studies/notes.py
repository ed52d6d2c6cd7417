"""What a study measured itself, kept beside its points so that it is measured once: JSON by name."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path

from pipeline.digest import write_atomically
from pipeline.json_files import json_text

Numbers = dict[str, float]


class Notes:
    """Small dictionaries of numbers in one folder; a name must say all that its numbers hang on."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def read(self, name: str) -> Numbers | None:
        """What is noted under a name; None where there is nothing, or nothing that can be read."""
        try:
            value = json.loads((self.folder / f"{name}.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        known = isinstance(value, dict) and all(isinstance(one, (int, float)) for one in value.values())
        return value if known else None

    def write(self, name: str, numbers: Mapping[str, float]) -> None:
        """Notes finite numbers; others are left out."""
        self.folder.mkdir(parents=True, exist_ok=True)
        known = {key: value for key, value in numbers.items() if math.isfinite(value)}
        write_atomically(self.folder / f"{name}.json", json_text(known))

    def once(self, name: str, measure: Callable[[], Mapping[str, float]]) -> Numbers:
        """What is noted under a name, measured now if it is not."""
        known = self.read(name)
        if known is None:
            self.write(name, measure())
            known = self.read(name) or {}
        return known
