"""Pickles and torch files, of which nothing is executed.

Unpickling calls whatever a file names. Here a name stands for a stub that keeps what it is given, and any
name that is not in the one list below is refused before anything happens. Arrays are then built by our code.

A file of ``torch.save`` is a zip archive of ``<name>/data.pkl`` and one file of raw numbers a storage,
``<name>/data/<key>``. Before torch 1.6, and inside plain pickles, it is five pickles (a magic number, a
version, the machine, the object, the keys of its storages) and each storage's length and raw numbers.
``torch.load(weights_only=True)`` will not do for these: it does not look at an archive's checksums, a storage
that the file lacks holds what was in memory, and a few bytes may ask for any amount of it (``bytearray``).
"""

from __future__ import annotations

import io
import pickle
import pickletools
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import UserError
from pipeline.untrusted.bounds import GIGABYTE, bounded_bytes, check_unpacked
from pipeline.untrusted.stubs import (
    Array,
    Buffer,
    Chumpy,
    Dtype,
    NumberType,
    Opaque,
    Parameter,
    Plain,
    Scalar,
    SparseColumns,
    SparseRows,
    Storage,
    Stub,
    Tensor,
)

_MOST_OPCODES = 20_000_000
_MOST_MEMBERS = 100_000  # of a torch file, which has one for each storage
_MAGIC = 0x1950A86A20F9469CFC6C  # of torch's older format
_Persistent = Callable[[Any], Any]


class _Function(Stub):
    """A function of ours; a pickle can call it, and has no way to its attributes."""

    def __call__(self, *arguments: Any) -> Any:
        return self.arguments[0](*arguments)


class _OrderedDict(dict):
    """An OrderedDict; a dict keeps its order anyway."""

    def __init__(self, pairs: Any = ()) -> None:
        super().__init__((pair[0], pair[1]) for pair in pairs)

    def __setstate__(self, state: Any) -> None:
        """Attributes of an OrderedDict, such as a state dict's metadata, are left out."""


def _encode(text: str, encoding: str = "latin1") -> bytes:
    """Bytes that a pickle has as text."""
    return text.encode("latin1" if encoding == "latin1" else "ascii")


def _reconstructor(kind: Any, base: Any, state: Any) -> Stub:
    """An object as Python 2 makes it."""
    return kind() if isinstance(kind, type) and issubclass(kind, Stub) else Opaque()


_ADMITTED: dict[str, Any] = {
    "numpy.core.multiarray._reconstruct": Array, "numpy._core.multiarray._reconstruct": Array,
    "numpy.core.multiarray.scalar": Scalar, "numpy._core.multiarray.scalar": Scalar,
    "numpy.core.numeric._frombuffer": Buffer, "numpy._core.numeric._frombuffer": Buffer,
    "numpy.dtype": Dtype, "numpy.ndarray": Opaque,
    "torch._utils._rebuild_tensor": Tensor, "torch._utils._rebuild_tensor_v2": Tensor,
    "torch._utils._rebuild_parameter": Parameter,
    "torch.DoubleStorage": NumberType("<f8"), "torch.FloatStorage": NumberType("<f4"),
    "torch.HalfStorage": NumberType("<f2"), "torch.LongStorage": NumberType("<i8"),
    "torch.IntStorage": NumberType("<i4"), "torch.ShortStorage": NumberType("<i2"),
    "torch.CharStorage": NumberType("i1"), "torch.ByteStorage": NumberType("u1"),
    "torch.BoolStorage": NumberType("?"),
    "torch.UntypedStorage": NumberType("u1"), "torch.storage.UntypedStorage": NumberType("u1"),
    "scipy.sparse.csc.csc_matrix": SparseColumns, "scipy.sparse._csc.csc_matrix": SparseColumns,
    "scipy.sparse.csr.csr_matrix": SparseRows, "scipy.sparse._csr.csr_matrix": SparseRows,
    "collections.OrderedDict": _OrderedDict, "_codecs.encode": _Function(_encode),
    "copy_reg._reconstructor": _Function(_reconstructor),
    "copyreg._reconstructor": _Function(_reconstructor),
    "__builtin__.object": Opaque, "builtins.object": Opaque,
}  # fmt: skip
"""What each name stands for; bfloat16 has no type in numpy and is refused.

Besides, all names of chumpy are admitted, which has many classes, and torch's for a storage inside a pickle.
"""


class _Unpickler(pickle.Unpickler):
    """Makes stubs, and refuses every other name."""

    def __init__(self, content: bytes, persistent: _Persistent | None) -> None:
        """Read ``content``; ``persistent`` gives what an id stands for that the pickle refers to."""
        super().__init__(io.BytesIO(content), encoding="latin1")
        self._persistent = persistent
        self._storages: dict[bytes, Storage] = {}

    def persistent_load(self, pid: Any) -> Any:
        if self._persistent is None:
            raise pickle.UnpicklingError("it refers to something outside of it")
        return self._persistent(pid)

    def find_class(self, module: str, name: str) -> Any:
        if module.split(".")[0] == "chumpy":
            return Chumpy
        if (module, name) == ("torch.storage", "_load_from_bytes") and self._persistent is None:
            return _Function(self._saved_storage)  # a torch file has its storages elsewhere
        if f"{module}.{name}" not in _ADMITTED:
            raise pickle.UnpicklingError(f"it names {module}.{name}, which plain data has no use for")
        return _ADMITTED[f"{module}.{name}"]

    def _saved_storage(self, content: Any) -> Storage:
        """A storage that was saved as a torch file of its own; the same one for the same bytes."""
        if not isinstance(content, bytes):
            raise pickle.UnpicklingError("a storage is not given as bytes")
        if content not in self._storages:
            storage = _load_torch(content, GIGABYTE)
            if not isinstance(storage, Storage):
                raise pickle.UnpicklingError("a storage holds something else")
            self._storages[content] = storage
        return self._storages[content]


def read_pickle(path: Path, remedy: str, most_bytes: int = GIGABYTE) -> Any:
    """The content of a pickle as dicts, lists, tuples, text, bytes, numbers and numpy arrays.

    Tensors, sparse matrices and chumpy's objects come back as arrays; sets are refused, and so are dictionary
    keys that are no text or number.

    Args:
        path: the file.
        remedy: what the user can do; it ends the error's line.
        most_bytes: of the file, and of its arrays together.

    Raises:
        UserError: the file is missing, damaged or too large, or names anything but arrays.
    """
    content = bounded_bytes(path, most_bytes, remedy)
    try:
        return parse_pickle(content, most_bytes)
    except Exception as error:  # a damaged pickle raises nearly anything
        raise UserError(f"{path} cannot be read as plain data ({error}): {remedy}") from None


def read_torch(path: Path, remedy: str, most_bytes: int = GIGABYTE) -> Any:
    """The content of a file of ``torch.save``, zip or older: as ``read_pickle`` gives it.

    Args:
        path: the file.
        remedy: what the user can do; it ends the error's line.
        most_bytes: of the file, of what it unpacks to, and of its arrays together.

    Raises:
        UserError: the file is missing, damaged or too large, or names anything but tensors and arrays.
    """
    content = bounded_bytes(path, most_bytes, remedy)
    try:
        return Plain(most_bytes)(_load_torch(content, most_bytes))
    except Exception as error:  # a damaged file raises nearly anything
        raise UserError(f"{path} cannot be read as a torch file ({error}): {remedy}") from None


def parse_pickle(content: bytes, most_bytes: int = GIGABYTE) -> Any:
    """The content of a pickle, as ``read_pickle``; UnpicklingError or nearly anything where it is bad."""
    return Plain(most_bytes)(_next_stubs(io.BytesIO(content)))


def parse_pickled_arrays(content: bytes) -> dict[str, np.ndarray]:
    """The arrays of a pickled dictionary by name; entries that are none are left out.

    This is for body and head models (SMPL, FLAME), whose pickles hold other objects, too.

    Raises:
        Exception: UnpicklingError or nearly anything where it is bad, or names what is not admitted.
    """
    model = _next_stubs(io.BytesIO(content))
    if not isinstance(model, dict):
        raise pickle.UnpicklingError("it holds no dictionary")
    plain, arrays = Plain(GIGABYTE), {}
    for key, value in model.items():
        try:
            found = plain(value)
        except pickle.UnpicklingError:  # no numbers
            continue
        if isinstance(found, np.ndarray):
            arrays[key.decode("latin1") if isinstance(key, bytes) else str(key)] = found
    return arrays


def _next_stubs(file: io.BytesIO, persistent: _Persistent | None = None) -> Any:
    """The next pickle in a file, which is left behind it, with stubs in the place of objects."""
    start = file.tell()
    for count, _ in enumerate(pickletools.genops(file)):  # finds lengths that the file does not have
        if count > _MOST_OPCODES:
            raise pickle.UnpicklingError("it has too many instructions")
    return _Unpickler(file.getvalue()[start : file.tell()], persistent).load()


def _load_torch(content: bytes, most_bytes: int) -> Any:
    """A torch file with stubs in the place of tensors."""
    if not zipfile.is_zipfile(io.BytesIO(content)):
        return _load_legacy(io.BytesIO(content))
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        check_unpacked(archive.infolist(), _MOST_MEMBERS, most_bytes)
        names = archive.namelist()
        index = next((name for name in sorted(names) if name.endswith("/data.pkl")), None)
        if index is None:
            raise pickle.UnpicklingError("it holds no data.pkl")
        folder = index.removesuffix("data.pkl")
        if f"{folder}byteorder" in names and archive.read(f"{folder}byteorder") != b"little":
            raise pickle.UnpicklingError("its numbers are big-endian")

        def read_storage(pid: Any) -> Storage:
            key, storage = _named_storage(pid)
            storage.fill(archive.read(f"{folder}data/{key}"))
            return storage

        return _next_stubs(io.BytesIO(archive.read(index)), read_storage)


def _load_legacy(file: io.BytesIO) -> Any:
    """A file as torch wrote it before 1.6; its storages come after the object that refers to them."""
    storages: dict[str, Storage] = {}

    def later(pid: Any) -> Storage:
        key, storage = _named_storage(pid)
        return storages.setdefault(key, storage)

    magic, _version, _machine, value, keys = (_next_stubs(file, later) for _ in range(5))
    if magic != _MAGIC:
        raise pickle.UnpicklingError("it is no torch file")
    if not isinstance(keys, list) or {*keys} != {*storages}:
        raise pickle.UnpicklingError("its list of storages does not fit")
    for key in keys:
        dtype, count = storages[key].arguments
        written = int.from_bytes(file.read(8), "little", signed=True)
        if written not in (count, count * dtype.itemsize):  # numbers, or bytes where it is untyped
            raise pickle.UnpicklingError("the length of a storage does not fit")
        storages[key].fill(file.read(count * dtype.itemsize))
    return value


def _named_storage(pid: Any) -> tuple[str, Storage]:
    """Key and storage of a persistent id: ('storage', type, key, device, count[, view])."""
    fits = isinstance(pid, tuple) and len(pid) in (5, 6) and pid[0] == "storage"
    if not fits or not isinstance(pid[1], NumberType) or (len(pid) == 6 and pid[5] is not None):
        raise pickle.UnpicklingError("it refers to something that is no storage of numbers")
    if not isinstance(pid[2], str) or not isinstance(pid[4], int) or not 0 <= pid[4] < 2**40:
        raise pickle.UnpicklingError("it refers to a storage without a length")
    return pid[2], Storage(np.dtype(pid[1].arguments[0]), pid[4])
