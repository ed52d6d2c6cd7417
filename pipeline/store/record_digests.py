"""The seal of a version: the digests of its own records, which its manifest cannot hold.

``SHA256SUMS`` lists ``manifest.json`` and ``run.json`` as ``sha256sum`` writes it, so that
``sha256sum -c SHA256SUMS`` checks them too. With the manifest's own list every byte of a version is covered:
the seal itself is compared as a whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pipeline.store import digest

SEAL = "SHA256SUMS"


def write_seal(folder: Path, names: Sequence[str]) -> None:
    """Writes the digests of the named files of a folder beside them."""
    (folder / SEAL).write_text("".join(_lines(folder, names)), encoding="ascii")


def broken(folder: Path, names: Sequence[str]) -> list[str]:
    """Which of the named files, or the seal itself, are not as they were sealed.

    Versions from before there were seals have none, and nothing is said of them.
    """
    try:
        sealed = (folder / SEAL).read_bytes()
    except FileNotFoundError:
        return []
    except OSError:
        return [SEAL]
    try:
        lines = _lines(folder, names)
    except OSError:
        return [name for name in names if not (folder / name).is_file()] or [SEAL]
    if sealed == "".join(lines).encode("ascii"):
        return []
    wrong = [name for name, line in zip(names, lines, strict=True) if line.encode("ascii") not in sealed]
    # A flipped bit in the seal makes one line differ as a flipped bit in what it seals does.
    return wrong or [SEAL]


def _lines(folder: Path, names: Sequence[str]) -> list[str]:
    return [f"{digest.of_file(folder / name)}  {name}\n" for name in names]
