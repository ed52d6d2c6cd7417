"""numpy's files: ``.npy`` and ``.npz``, also such as hold pickled objects."""

from __future__ import annotations

import io
import math
import pickle
import zipfile
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import UserError
from pipeline.untrusted.bounds import GIGABYTE, bounded_bytes, check_unpacked
from pipeline.untrusted.pickles import parse_pickle

_MOST_HEADER = 100_000  # bytes
_MOST_MEMBERS = 10_000


def read_npy(path: Path, remedy: str, most_bytes: int = GIGABYTE) -> Any:
    """The content of a ``.npy`` file: an array of numbers, or the object that was saved as an array.

    A dictionary that ``np.save`` wrote comes back as a dictionary, an array of objects as a list.

    Raises:
        UserError: the file is missing, damaged or too large, or its objects are more than plain data.
    """
    content = bounded_bytes(path, most_bytes, remedy)
    try:
        return _parse(content)
    except Exception as error:  # a damaged file raises nearly anything
        raise UserError(f"{path} cannot be read as a numpy array ({error}): {remedy}") from None


def read_npz(
    path: Path,
    remedy: str,
    most_bytes: int = GIGABYTE,
    choose: Callable[[Collection[str]], Collection[str]] = lambda names: names,
) -> dict[str, Any]:
    """The content of a ``.npz`` archive by name.

    Args:
        path: the file.
        remedy: what the user can do; it ends the error's line.
        most_bytes: of the file, and of what the chosen members unpack to.
        choose: of the archive's names those to read; the others are not looked at, whatever they hold.

    Raises:
        UserError: as ``read_npy``, or it unpacks to more than is allowed.
    """
    content = bounded_bytes(path, most_bytes, remedy)
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = {one.filename.removesuffix(".npy"): one for one in archive.infolist()}
            chosen = {name: members[name] for name in choose(members)}
            check_unpacked(list(chosen.values()), _MOST_MEMBERS, most_bytes)
            return {name: _parse(archive.read(one)) for name, one in chosen.items()}
    except Exception as error:  # a damaged archive raises nearly anything
        raise UserError(f"{path} cannot be read as an npz archive ({error}): {remedy}") from None


def _parse(content: bytes) -> Any:
    # np.load takes the memory that the header claims before it looks how much there is.
    file = io.BytesIO(content)
    version = np.lib.format.read_magic(file)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise ValueError(f"version {version} of the format is not known")
    shape, fortran, dtype = readers[version](file, max_header_size=_MOST_HEADER)
    if dtype.hasobject:
        return parse_pickle(file.read())
    if dtype.kind not in "biuf":
        raise pickle.UnpicklingError(f"it holds {dtype}, which are no numbers")
    count = math.prod(shape)
    left = len(content) - file.tell()
    if count * dtype.itemsize > left:
        raise ValueError(f"it says {count} numbers and has {left} bytes")
    flat = np.frombuffer(content, dtype, count, file.tell())
    return flat.reshape(shape, order="F" if fortran else "C").copy()
