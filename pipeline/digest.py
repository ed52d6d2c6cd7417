"""Digests of files, remembered so that a large clip is read once."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from pathlib import Path
from typing import Any


def of_bytes(content: bytes) -> str:
    """The SHA-256 of ``content`` in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


def of_json(value: Any) -> str:
    """The SHA-256 of a JSON value in its canonical form (sorted keys, no spaces)."""
    return of_bytes(json.dumps(value, sort_keys=True, separators=(",", ":")).encode())


def of_file(path: Path) -> str:
    """The SHA-256 of a file's content in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def of_source(path: Path, memory: Path) -> str:
    """The digest of footage: a file, or a folder's files with their names.

    Args:
        path: a file or a folder.
        memory: a JSON file that remembers digests by path, size and time of change, so that asking
            again costs a look at the folder. It may be lost at any time.
    """
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    known = read_memory(memory)
    fresh: dict[str, str] = {}
    parts = []
    for file in files:
        stat = file.stat()
        label = f"{file.resolve()}|{stat.st_size}|{stat.st_mtime_ns}"
        digest = known.get(label) or fresh.setdefault(label, of_file(file))
        parts.append(digest if path.is_file() else [str(file.relative_to(path)), digest])
    if fresh:
        write_atomically(memory, json.dumps({**known, **fresh}, indent=0, sort_keys=True))
    return of_json(parts)


def read_memory(memory: Path) -> dict[str, str]:
    """The remembered digests; empty where there are none or the file is damaged."""
    try:
        known = json.loads(memory.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return known if isinstance(known, dict) else {}


def write_atomically(path: Path, text: str) -> None:
    """Replaces a small text file in one step, so that a reader never sees half of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}-")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise
