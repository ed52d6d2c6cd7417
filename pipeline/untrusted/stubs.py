"""Stubs for the objects of a pickle, and plain values made of them.

A stub keeps what unpickling gives it and does nothing. Afterwards numpy arrays are built from what was kept:
from bytes whose length, type and shape are held against each other, and no more of them than is allowed.
"""

from __future__ import annotations

import math
import pickle
from typing import Any

import numpy as np
import scipy.sparse

_MOST_VALUES = 300_000  # in one file, containers unrolled: shared ones count each time
_MOST_DEPTH = 40


class Stub:
    """Keeps the arguments and the state of an object of some class."""

    arguments: tuple[Any, ...] = ()  # unpickling may leave __init__ out
    state: Any = None

    def __init__(self, *arguments: Any) -> None:
        self.arguments = arguments

    def __setstate__(self, state: Any) -> None:
        self.state = state


class Array(Stub):
    """A numpy array; its state is (version, shape, dtype, Fortran's order?, bytes or list)."""


class Scalar(Stub):
    """A numpy scalar: (dtype, bytes)."""


class Buffer(Stub):
    """A numpy array of pickle protocol 5: (bytes, dtype, shape, order)."""


class Dtype(Stub):
    """A numpy dtype: (code, ...); its state has the byte order."""


class Tensor(Stub):
    """A torch tensor: (storage, offset, size, stride, ...)."""


class Parameter(Stub):
    """A torch parameter: (tensor, ...)."""


class NumberType(Stub):
    """The class of a torch storage: (numpy's code of its numbers,)."""


class Storage(Stub):
    """A torch storage: (dtype, count), and its numbers once they are read."""

    numbers: np.ndarray | None = None

    def fill(self, raw: bytes) -> None:
        """Take the numbers from the start of ``raw``; UnpicklingError where it is too short."""
        dtype, count = self.arguments
        if len(raw) < count * dtype.itemsize:
            raise pickle.UnpicklingError("a storage is shorter than it says")
        self.numbers = np.frombuffer(raw, dtype, count)


class SparseColumns(Stub):
    """A scipy.sparse.csc_matrix."""


class SparseRows(Stub):
    """A scipy.sparse.csr_matrix."""


class Chumpy(Stub):
    """A chumpy object; its value is what its state calls x."""


class Opaque(Stub):
    """A class that is handed over as an argument, or an object that no value is known of."""


class Plain:
    """Turns stubs into arrays; counts them, for what is shared may come a million times."""

    def __init__(self, most_bytes: int) -> None:
        """Start to count; ``most_bytes`` is for all arrays together."""
        self._values_left, self._bytes_left = _MOST_VALUES, most_bytes

    def __call__(self, value: Any, depth: int = 0) -> Any:
        """The plain value of what unpickling made."""
        self._values_left -= 1
        if depth > _MOST_DEPTH or self._values_left < 0:
            raise pickle.UnpicklingError("it is nested too deep or unrolls to too much")
        if isinstance(value, dict):
            if not all(isinstance(key, (str, bytes, int, float)) for key in value):
                raise pickle.UnpicklingError("a dictionary has keys that are no text")
            return {_text(key): self(one, depth + 1) for key, one in value.items()}
        if isinstance(value, (list, tuple)):
            return type(value)(self(one, depth + 1) for one in value)
        if value is None or isinstance(value, (str, bytes, int, float)):
            return value
        return self._of_stub(value, depth)

    def _of_stub(self, value: Any, depth: int) -> Any:
        if isinstance(value, Array) and isinstance(value.state, tuple) and len(value.state) == 5:
            _, shape, dtype, fortran, raw = value.state
            if isinstance(raw, list):  # objects: a single one as it is, more of them as a list
                values = self([*raw], depth + 1)
                return values[0] if shape == () else values
            return self._array(raw, dtype, shape, "F" if fortran else "C")
        if isinstance(value, Buffer) and len(value.arguments) == 4:
            return self._array(*value.arguments)
        if isinstance(value, Scalar) and len(value.arguments) == 2:
            return self._array(value.arguments[1], value.arguments[0], (1,), "C").item()
        if isinstance(value, Parameter) and value.arguments:
            return self(value.arguments[0], depth + 1)
        if isinstance(value, Tensor) and len(value.arguments) >= 4:
            return self._tensor(*value.arguments[:4])
        if isinstance(value, Storage) and value.numbers is not None:
            self._take(value.numbers.nbytes)
            return value.numbers.copy()
        if isinstance(value, (SparseColumns, SparseRows)) and isinstance(value.state, dict):
            return self._sparse(value, depth)
        if isinstance(value, Chumpy) and isinstance(value.state, dict):
            return self(value.state.get("x"), depth + 1)
        raise pickle.UnpicklingError(f"it holds a {type(value).__name__}, which is no plain data")

    def _array(self, raw: Any, dtype: Any, shape: Any, order: Any) -> np.ndarray:
        """An array of numbers from its bytes."""
        code = str(dtype.arguments[0]) if isinstance(dtype, Dtype) and dtype.arguments else ""
        if code[:1] not in tuple("biuf") or not code[1:].isdigit() or order not in ("C", "F"):
            raise pickle.UnpicklingError(f"it holds an array of '{code[:20]}', which are no numbers")
        raw = raw.encode("latin1") if isinstance(raw, str) else raw
        if not isinstance(raw, (bytes, bytearray)):
            raise pickle.UnpicklingError("it holds an array without bytes")
        big = isinstance(dtype.state, tuple) and len(dtype.state) > 1 and dtype.state[1] == ">"
        flat = np.frombuffer(raw, np.dtype((">" if big else "<") + code))
        self._take(flat.nbytes)
        return flat.reshape(_counts(shape), order=order).copy()

    def _tensor(self, storage: Any, offset: Any, size: Any, stride: Any) -> np.ndarray:
        """A tensor's numbers; it may not reach out of its storage, nor repeat it."""
        numbers = storage.numbers if isinstance(storage, Storage) else None
        if numbers is None:
            raise pickle.UnpicklingError("it holds a tensor without a storage")
        size, stride, (first,) = _counts(size), _counts(stride), _counts((offset,))
        if len(size) != len(stride):
            raise pickle.UnpicklingError("it holds a tensor whose strides do not fit")
        count = math.prod(size)
        last = first + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
        if count and last >= len(numbers) or count > max(len(numbers), 1):
            raise pickle.UnpicklingError("it holds a tensor larger than its storage")
        self._take(count * numbers.itemsize)
        if not count:
            return np.zeros(size, numbers.dtype)
        steps = tuple(step * numbers.itemsize for step in stride)
        return np.lib.stride_tricks.as_strided(numbers[first:], size, steps, writeable=False).copy()

    def _sparse(self, value: Stub, depth: int) -> np.ndarray:
        """The dense array of a sparse matrix, whose indices are checked: scipy writes wherever they say."""
        parts = (value.state.get(key) for key in ("data", "indices", "indptr"))
        data, indices, starts = (self(part, depth + 1) for part in parts)
        shape = value.state.get("_shape", value.state.get("shape"))
        arrays = all(isinstance(one, np.ndarray) for one in (data, indices, starts))
        if not arrays or not isinstance(shape, tuple) or len(shape) != 2:
            raise pickle.UnpicklingError("it holds a sparse matrix that is incomplete")
        rows, columns = (int(self(one, depth + 1)) for one in shape)
        kind = scipy.sparse.csr_matrix if isinstance(value, SparseRows) else scipy.sparse.csc_matrix
        matrix = kind((data, indices, starts), shape=(rows, columns))
        matrix.check_format(full_check=True)
        self._take(rows * columns * data.itemsize)
        return matrix.toarray()

    def _take(self, count: int) -> None:
        self._bytes_left -= count
        if self._bytes_left < 0:
            raise pickle.UnpicklingError("it unrolls to more numbers than is allowed")


def _text(key: Any) -> Any:
    return key.decode("latin1") if isinstance(key, bytes) else key


def _counts(numbers: Any) -> tuple[int, ...]:
    """A shape, or strides; UnpicklingError where they are none."""
    whole = isinstance(numbers, (tuple, list)) and all(isinstance(n, int) for n in numbers)
    if not whole or not all(0 <= n < 2**40 for n in numbers):
        raise pickle.UnpicklingError("it holds an array without a shape")
    return tuple(numbers)
