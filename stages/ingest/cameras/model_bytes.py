"""Counts in COLMAP's binary files, held against the files' lengths before pycolmap believes them.

pycolmap reads as many entries as a count says, past the file's end too: one wrong byte keeps it busy for
ever. The layout is that of COLMAP's ``reconstruction_io_binary.cc``: little-endian, without padding.
"""

from __future__ import annotations

import struct
from pathlib import Path

from pipeline.errors import UserError
from pipeline.untrusted import bounded_bytes

_MOST_BYTES = 4 << 30
_LEAST_CAMERA = 24 + 3 * 8  # id, model, width, height and three parameters
_REMEDY = "export it again"


def check_model_bytes(folder: Path) -> None:
    """Refuse a binary model whose files are shorter than their counts say; UserError names the file."""
    walks = {"cameras": _cameras_end, "images": _images_end, "points3D": _points_end,
             "rigs": _rigs_end, "frames": _frames_end}  # fmt: skip
    for name, walk in walks.items():
        path = folder / f"{name}.bin"
        if not path.is_file():
            continue
        content = bounded_bytes(path, _MOST_BYTES, _REMEDY)
        try:
            whole = walk(content, _count(content, 0)) <= len(content)
        except (struct.error, ValueError):
            whole = False
        if not whole:
            raise UserError(f"{path} is damaged or cut off: it is shorter than it says: {_REMEDY}")


def _count(content: bytes, at: int, code: str = "<Q") -> int:
    return int(struct.unpack_from(code, content, at)[0])


def _cameras_end(content: bytes, count: int) -> int:
    return 8 + count * _LEAST_CAMERA


def _images_end(content: bytes, count: int) -> int:
    """Each: id, pose and camera, 64 bytes; a name and its zero; a count of points of 24 bytes."""
    at = 8
    for _ in range(count):
        at = content.index(b"\0", at + 64) + 1
        at += 8 + 24 * _count(content, at)
    return at


def _points_end(content: bytes, count: int) -> int:
    """Each: id, place, colour and error, 43 bytes; a count of observations of 8 bytes."""
    at = 8
    for _ in range(count):
        at += 51 + 8 * _count(content, at + 43)
    return at


def _rigs_end(content: bytes, count: int) -> int:
    """Each: id and count of sensors; the first of 8 bytes, the others of 9 and, where said, a pose of 56."""
    at = 8
    for _ in range(count):
        sensors = _count(content, at + 4, "<I")
        at += 8 + 8 * min(sensors, 1)
        for _ in range(1, sensors):
            at += 9 + 56 * bool(_count(content, at + 8, "<B"))
    return at


def _frames_end(content: bytes, count: int) -> int:
    """Each: id, rig and pose, 64 bytes; a count of data of 16 bytes."""
    at = 8
    for _ in range(count):
        at += 68 + 16 * _count(content, at + 64, "<I")
    return at
