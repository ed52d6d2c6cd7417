"""Pickles, of which nothing is executed.

Unpickling calls whatever a file names. Here a name can only stand for a stub that keeps what it is given;
arrays and tensors are built from the bytes kept, by code of ours. Any other name is refused before anything
happens. Known names are those of numpy arrays and scalars, torch tensors and storages, and
``collections.OrderedDict``; a reader may add stubs of its own.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from pipeline.errors import UserError
from pipeline.untrusted.paths import GIGABYTE, bounded_bytes

MOST_OPCODES = 20_000_000
MOST_VALUES = 300_000  # in one file, containers unrolled: shared ones count each time
MOST_DEPTH = 40

_MULTIARRAY = ("numpy.core.multiarray", "numpy._core.multiarray")
_NUMERIC = ("numpy.core.numeric", "numpy._core.numeric")
STORAGE_TYPES = {
    "DoubleStorage": "<f8", "FloatStorage": "<f4", "HalfStorage": "<f2", "LongStorage": "<i8",
    "IntStorage": "<i4", "ShortStorage": "<i2", "CharStorage": "i1", "ByteStorage": "u1",
    "BoolStorage": "?", "UntypedStorage": "u1",
}  # fmt: skip
"""torch's storage classes and what they hold; bfloat16 has no numpy type and is refused."""

Persistent = Callable[[Any], Any]
Names = Callable[[str, str], Any]


class Stub:
    """Keeps the arguments and the state of an object of some class."""

    arguments: tuple[Any, ...] = ()  # unpickling may leave __init__ out
    state: Any = None

    def __init__(self, *arguments: Any) -> None:
        self.arguments = arguments

    def __setstate__(self, state: Any) -> None:
        self.state = state


class ArrayStub(Stub):
    """A numpy array."""


class ScalarStub(Stub):
    """A numpy scalar: (dtype, bytes)."""


class BufferStub(Stub):
    """A numpy array of pickle protocol 5: (bytes, dtype, shape, order)."""


class DtypeStub(Stub):
    """A numpy dtype."""


class NameStub(Stub):
    """A class that is handed over as an argument, such as numpy.ndarray."""


class TensorStub(Stub):
    """A torch tensor: (storage, offset, size, stride, ...)."""


class ParameterStub(Stub):
    """A torch parameter: (tensor, ...)."""


class LoadedStorage(Stub):
    """A torch storage as bytes of a file of its own, as plain pickles of tensors have it."""


class OrderedStub(dict):
    """An OrderedDict; a dict keeps its order anyway."""

    def __init__(self, pairs: Any = ()) -> None:
        super().__init__((pair[0], pair[1]) for pair in pairs)

    def __setstate__(self, state: Any) -> None:
        """Attributes of an OrderedDict, such as a state dict's metadata, are left out."""


def _encode(text: str, encoding: str = "latin1") -> bytes:
    """What ``_codecs.encode`` is used for in pickles: bytes written as text."""
    return text.encode("latin1" if encoding == "latin1" else "ascii")


def storage_kind(name: str) -> type[Stub]:
    """A stub class for one of torch's storage classes."""
    return type(name, (Stub,), {"dtype": np.dtype(STORAGE_TYPES[name])})


class SafeUnpickler(pickle.Unpickler):
    """Knows a handful of names, none of which does anything."""

    def __init__(
        self,
        file: BinaryIO,
        names: Names | None = None,
        persistent: Persistent | None = None,
    ) -> None:
        """Read from ``file``.

        Args:
            file: positioned at a pickle.
            names: the stub of a module's name, or None, besides the usual ones.
            persistent: what a persistent id stands for; without it such ids are refused.
        """
        super().__init__(file, encoding="latin1")
        self._names, self._persistent = names, persistent

    def persistent_load(self, pid: Any) -> Any:
        """The storage that a torch file refers to."""
        if self._persistent is None:
            raise pickle.UnpicklingError("it refers to something outside of it")
        return self._persistent(pid)

    def find_class(self, module: str, name: str) -> Any:
        """The stub for a name; UnpicklingError where there is none."""
        stub = self._names(module, name) if self._names else None
        stub = _known(module, name) if stub is None else stub
        if stub is None:
            raise pickle.UnpicklingError(f"it names {module}.{name}, which plain data has no use for")
        return stub


def _known(module: str, name: str) -> Any:
    """The stub of a name that every pickle may hold, or None."""
    if module in _MULTIARRAY and name in ("_reconstruct", "scalar"):
        return ArrayStub if name == "_reconstruct" else ScalarStub
    if module in _NUMERIC and name == "_frombuffer":
        return BufferStub
    if (module, name) in (("numpy", "dtype"), ("numpy", "ndarray")):
        return DtypeStub if name == "dtype" else NameStub
    if module == "torch._utils" and name in ("_rebuild_tensor_v2", "_rebuild_tensor", "_rebuild_parameter"):
        return ParameterStub if name == "_rebuild_parameter" else TensorStub
    if (module, name) == ("torch.storage", "_load_from_bytes"):
        return LoadedStorage
    if module in ("torch", "torch.storage") and name in STORAGE_TYPES:
        return storage_kind(name)
    if (module, name) == ("collections", "OrderedDict"):
        return OrderedStub
    if (module, name) == ("_codecs", "encode"):
        return _encode
    return None


def read_pickle(path: Path, remedy: str, most_bytes: int = GIGABYTE) -> Any:
    """What a pickle holds, as dicts, lists, tuples, text, bytes, numbers and numpy arrays.

    Tensors come back as arrays, sets are refused, dictionary keys that are no text or number as well.

    Raises:
        UserError: the file is missing, damaged or too large, or names anything but arrays.
    """
    content = bounded_bytes(path, most_bytes, remedy)
    try:
        return plain(load_stubs(content))
    except Exception as error:  # a damaged pickle raises nearly anything
        raise UserError(f"{path} cannot be read as plain data ({error}): {remedy}") from None


def load_stubs(
    content: bytes,
    names: Names | None = None,
    persistent: Persistent | None = None,
) -> Any:
    """A whole pickle with stubs in the place of objects; UnpicklingError or nearly anything if it is bad."""
    return next_stubs(io.BytesIO(content), names, persistent)


def next_stubs(file: BinaryIO, names: Names | None = None, persistent: Persistent | None = None) -> Any:
    """The next pickle in a file, which is left behind it."""
    start = file.tell()
    for count, (_, _, _) in enumerate(pickletools.genops(file)):  # finds lengths that the file does not have
        if count > MOST_OPCODES:
            raise pickle.UnpicklingError("it has too many instructions")
    end = file.tell()
    file.seek(start)
    value = SafeUnpickler(io.BytesIO(file.read(end - start)), names, persistent).load()
    file.seek(end)
    return value


class Plain:
    """Turns stubs into arrays; counts what it makes, for containers may be shared a million times."""

    def __init__(self, others: Mapping[type, Callable[[Any, Plain, int], Any]] | None = None) -> None:
        """Start to count.

        Args:
            others: what becomes of further stubs.
        """
        self._others, self._count = dict(others or {}), 0

    def __call__(self, value: Any, depth: int = 0) -> Any:
        """The plain value of what unpickling made."""
        self._count += 1
        if depth > MOST_DEPTH or self._count > MOST_VALUES:
            raise pickle.UnpicklingError("it is nested too deep or unrolls to too much")
        if isinstance(value, dict):
            if not all(isinstance(key, (str, bytes, int, float)) for key in value):
                raise pickle.UnpicklingError("a dictionary has keys that are no text")
            return {_text(key): self(one, depth + 1) for key, one in value.items()}
        if isinstance(value, (list, tuple)):
            return type(value)(self(one, depth + 1) for one in value)
        if value is None or isinstance(value, (str, bytes, int, float, np.ndarray)):
            return value
        if type(value) in self._others:
            return self._others[type(value)](value, self, depth)
        return self._object(value, depth)

    def _object(self, value: Any, depth: int) -> Any:
        if isinstance(value, ArrayStub) and isinstance(value.state, tuple) and len(value.state) == 5:
            _, shape, dtype, fortran, raw = value.state
            if isinstance(raw, list):
                return _objects(self([*raw], depth + 1), shape)
            return array_of(raw, dtype, shape, "F" if fortran else "C")
        if isinstance(value, BufferStub) and len(value.arguments) == 4:
            return array_of(*value.arguments)
        if isinstance(value, ScalarStub) and len(value.arguments) == 2:
            return array_of(value.arguments[1], value.arguments[0], (1,), "C").item()
        if isinstance(value, ParameterStub) and value.arguments:
            return self(value.arguments[0], depth + 1)
        if isinstance(value, TensorStub) and len(value.arguments) >= 4:
            return tensor_of(*value.arguments[:4])
        raise pickle.UnpicklingError(f"it holds a {type(value).__name__}, which is no plain data")


def plain(value: Any) -> Any:
    """The plain value of what unpickling made."""
    return Plain()(value)


def _text(key: Any) -> Any:
    return key.decode("latin1") if isinstance(key, bytes) else key


def _objects(values: list[Any], shape: Any) -> Any:
    """An array of objects: a single one as it is, more of them as a list."""
    if shape == ():
        return values[0]
    return values


def array_of(raw: Any, dtype: Any, shape: Any, order: Any) -> np.ndarray:
    """An array of numbers from its bytes; UnpicklingError where they do not fit."""
    code = str(dtype.arguments[0]) if isinstance(dtype, DtypeStub) and dtype.arguments else ""
    if code[:1] not in tuple("biuf") or not code[1:].isdigit() or order not in ("C", "F"):
        raise pickle.UnpicklingError(f"it holds an array of '{code[:20]}', which are no numbers")
    big = isinstance(dtype.state, tuple) and len(dtype.state) > 1 and dtype.state[1] == ">"
    if isinstance(raw, str):
        raw = raw.encode("latin1")
    if not isinstance(raw, (bytes, bytearray)):
        raise pickle.UnpicklingError("it holds an array without bytes")
    flat = np.frombuffer(raw, np.dtype((">" if big else "<") + code))
    return flat.reshape(_counts(shape), order=order).copy()


def _counts(shape: Any) -> tuple[int, ...]:
    if not isinstance(shape, tuple) or not all(isinstance(n, int) and 0 <= n < 2**40 for n in shape):
        raise pickle.UnpicklingError("it holds an array without a shape")
    return shape


def tensor_of(storage: Any, offset: Any, size: Any, stride: Any) -> np.ndarray:
    """A tensor's numbers from its storage; UnpicklingError where it reaches out of it."""
    if isinstance(storage, LoadedStorage):
        from pipeline.untrusted.torch_files import storage_from_bytes

        storage = storage_from_bytes(storage.arguments[0] if storage.arguments else b"")
    if not isinstance(storage, np.ndarray):
        raise pickle.UnpicklingError("it holds a tensor without a storage")
    size, stride = _counts(tuple(size)), _counts(tuple(stride))
    (first,) = _counts((offset,))
    if len(size) != len(stride):
        raise pickle.UnpicklingError("it holds a tensor whose strides do not fit")
    count = math.prod(size)
    last = first + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    if count and last >= len(storage) or count > max(len(storage), 1):
        raise pickle.UnpicklingError("it holds a tensor larger than its storage")
    if not count:
        return np.zeros(size, storage.dtype)
    steps = tuple(step * storage.itemsize for step in stride)
    return np.lib.stride_tricks.as_strided(storage[first:], size, steps, writeable=False).copy()
