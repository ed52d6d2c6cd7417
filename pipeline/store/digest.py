"""Digests of files, remembered so that a large clip is read once."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import tempfile
import time
from pathlib import Path
from typing import Any

SETTLED = 2_000_000_000
"""Nanoseconds after its last change before a file's digest is remembered."""


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
        memory: a JSON file that remembers digests by path and state, so that asking again costs a look
            at the folder. It may be lost at any time, and need not be writable.
    """
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    known, now = read_memory(memory), time.time_ns()
    fresh: dict[str, str] = {}
    parts = []
    for file in files:
        stat = file.stat()
        label = label_of(file, stat)
        digest = known.get(label) or of_file(file)
        if label not in known and is_settled(stat, now):
            fresh[label] = digest
        parts.append(digest if path.is_file() else [str(file.relative_to(path)), digest])
    if fresh:
        with contextlib.suppress(OSError):  # a store that cannot be written is said where it matters
            write_memory(memory, {**known, **fresh})
    return of_json(parts)


def label_of(file: Path, stat: os.stat_result) -> str:
    """What changes whenever a file's content does.

    Size and time of change can be made equal by hand (``cp -p``, ``touch -r``); the inode and the time of
    its last change, which nobody can set, come to them.
    """
    return f"{file.resolve()}|{stat.st_size}|{stat.st_mtime_ns}|{stat.st_ino}|{stat.st_ctime_ns}"


def is_settled(stat: os.stat_result, now: int) -> bool:
    """Whether a change after this look would show in the times: a clock ticks, and may be set back."""
    return max(stat.st_mtime_ns, stat.st_ctime_ns) + SETTLED < now


def read_memory(memory: Path) -> dict[str, str]:
    """The remembered digests; empty where there are none or the file is damaged."""
    try:
        content = json.loads(memory.read_text(encoding="utf-8"))
        known = content["digests"]
        return known if content["sha256"] == of_json(known) else {}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def write_memory(memory: Path, known: dict[str, str]) -> None:
    """Writes the remembered digests with a digest of their own: one wrong bit would make all stages stale."""
    content = {"digests": known, "sha256": of_json(known)}
    write_atomically(memory, json.dumps(content, indent=0, sort_keys=True))


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
