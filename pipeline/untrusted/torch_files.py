"""What ``torch.save`` wrote, without torch reading it.

A zip archive of ``<name>/data.pkl`` and one file of raw numbers a storage, ``<name>/data/<key>``; or, before
torch 1.6 and inside plain pickles, four pickles (a magic number, a version, the machine, the object), a
pickled list of storage keys, and for each storage its length and its raw numbers. Little-endian.
"""

from __future__ import annotations

import io
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import UserError
from pipeline.untrusted.paths import GIGABYTE, bounded_bytes
from pipeline.untrusted.pickles import Stub, load_stubs, next_stubs, plain

_MAGIC = 0x1950A86A20F9469CFC6C
_MOST_MEMBERS = 100_000


def read_torch(path: Path, remedy: str, most_bytes: int = GIGABYTE) -> Any:
    """What a torch file holds: containers, text, numbers, and arrays in the place of tensors.

    Args:
        path: the file.
        remedy: what the user can do; it ends the error's line.
        most_bytes: of the file, and of what it unpacks to.

    Raises:
        UserError: the file is missing, damaged or too large, or names anything but tensors and arrays.
    """
    content = bounded_bytes(path, most_bytes, remedy)
    try:
        zipped = zipfile.is_zipfile(io.BytesIO(content))
        return plain(_from_zip(content, most_bytes) if zipped else _from_legacy(content))
    except Exception as error:  # a damaged file raises nearly anything
        raise UserError(f"{path} cannot be read as a torch file ({error}): {remedy}") from None


def _from_zip(content: bytes, most_bytes: int) -> Any:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = archive.infolist()
        if len(members) > _MOST_MEMBERS or sum(one.file_size for one in members) > most_bytes:
            raise pickle.UnpicklingError("it unpacks to more than is allowed")
        names = {one.filename for one in members}
        index = next((name for name in sorted(names) if name.endswith("/data.pkl")), None)
        if index is None:
            raise pickle.UnpicklingError("it holds no data.pkl")
        order = f"{index[: -len('data.pkl')]}byteorder"
        if order in names and archive.read(order) != b"little":
            raise pickle.UnpicklingError("its numbers are big-endian")

        def storage(pid: Any) -> np.ndarray:
            kind, key, count = _storage_of(pid)
            raw = archive.read(f"{index[: -len('data.pkl')]}data/{key}")
            return _numbers(raw, kind, count)

        return load_stubs(archive.read(index), persistent=storage)


def _from_legacy(content: bytes) -> Any:
    file = io.BytesIO(content)
    magic = next_stubs(file)
    if magic != _MAGIC:
        raise pickle.UnpicklingError("it is no torch file")
    _version, _machine = next_stubs(file), next_stubs(file)
    start = file.tell()
    wanted: dict[str, tuple[np.dtype, int]] = {}

    def note(pid: Any) -> np.ndarray:
        kind, key, count = _storage_of(pid)
        wanted[key] = (kind, count)
        return np.zeros(0, kind)

    next_stubs(file, persistent=note)
    end = file.tell()
    keys = next_stubs(file)
    if not isinstance(keys, list) or {*keys} != {*wanted}:
        raise pickle.UnpicklingError("its list of storages does not fit")
    found = {}
    for key in keys:
        kind, count = wanted[key]
        written = int.from_bytes(_exactly(file, 8), "little", signed=True)
        # An untyped storage says how many bytes it has, a typed one how many numbers.
        if written not in (count, count * kind.itemsize):
            raise pickle.UnpicklingError("the length of a storage does not fit")
        found[key] = _numbers(_exactly(file, count * kind.itemsize), kind, count)
    return load_stubs(content[start:end], persistent=lambda pid: found[_storage_of(pid)[1]])


def storage_from_bytes(content: Any) -> np.ndarray:
    """A storage that was pickled by itself, as tensors in plain pickles are."""
    if not isinstance(content, (bytes, bytearray)):
        raise pickle.UnpicklingError("a storage is not given as bytes")
    zipped = zipfile.is_zipfile(io.BytesIO(content))
    value = _from_zip(bytes(content), GIGABYTE) if zipped else _from_legacy(bytes(content))
    if not isinstance(value, np.ndarray):
        raise pickle.UnpicklingError("a storage holds something else")
    return value


def _storage_of(pid: Any) -> tuple[np.dtype, str, int]:
    """Kind, key and count of ('storage', kind, key, place, count, ...)."""
    fits = isinstance(pid, tuple) and len(pid) in (5, 6) and pid[0] == "storage"
    if not fits or not (isinstance(pid[1], type) and issubclass(pid[1], Stub) and hasattr(pid[1], "dtype")):
        raise pickle.UnpicklingError("it refers to something that is no storage of numbers")
    if not isinstance(pid[2], str) or not isinstance(pid[4], int) or not 0 <= pid[4] < 2**40:
        raise pickle.UnpicklingError("it refers to a storage without a length")
    if len(pid) == 6 and pid[5] is not None:
        raise pickle.UnpicklingError("it refers to a view of a storage")
    return pid[1].dtype, pid[2], pid[4]


def _numbers(raw: bytes, kind: np.dtype, count: int) -> np.ndarray:
    if len(raw) < count * kind.itemsize:
        raise pickle.UnpicklingError("a storage is shorter than it says")
    return np.frombuffer(raw, kind, count)


def _exactly(file: io.BytesIO, count: int) -> bytes:
    raw = file.read(count)
    if len(raw) != count:
        raise pickle.UnpicklingError("it ends too soon")
    return raw
