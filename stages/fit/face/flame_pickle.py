"""Arrays out of FLAME's pickle, of which nothing is executed.

The official file is a pickle of Python 2 with numpy arrays, scipy sparse matrices and chumpy objects in
it. Unpickling calls whatever a file names. Here a name can only stand for a stub that keeps what it is
given; arrays are built from the bytes kept. Any other name is refused before anything happens.
"""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

from pipeline.errors import UserError

_RECONSTRUCT = {"numpy.core.multiarray", "numpy._core.multiarray"}
_FROM_BUFFER = {"numpy.core.numeric", "numpy._core.numeric"}
_LIMIT = 1 << 30  # bytes; the official file has 53 MB


class _Stub:
    """Keeps the arguments and the state of an object of an unknown class."""

    arguments: tuple[Any, ...] = ()  # unpickling may leave __init__ out
    state: Any = None

    def __init__(self, *arguments: Any) -> None:
        self.arguments = arguments

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Array(_Stub):
    """A numpy array or scalar."""


class _Buffer(_Stub):
    """A numpy array of pickle protocol 5: (bytes, dtype, shape, order)."""


class _Dtype(_Stub):
    """A numpy dtype."""


class _Chumpy(_Stub):
    """A chumpy object; its value is what it calls x."""


class _Sparse(_Stub):
    """A scipy sparse matrix, by columns."""


class _SparseRows(_Sparse):
    """A scipy sparse matrix by rows."""


class _Name(_Stub):
    """A class that is handed over as an argument, such as numpy.ndarray."""


def _encode(text: str, encoding: str = "latin1") -> bytes:
    """What ``_codecs.encode`` is used for in pickles: bytes written as text."""
    return text.encode("latin1" if encoding == "latin1" else "ascii")


class _Unpickler(pickle.Unpickler):
    """Knows a handful of names, none of which does anything."""

    def find_class(self, module: str, name: str) -> Any:
        """The stub for a name; UnpicklingError where there is none."""
        if module in _RECONSTRUCT and name in ("_reconstruct", "scalar"):
            return _Array
        if module in _FROM_BUFFER and name == "_frombuffer":
            return _Buffer
        if module == "numpy" and name in ("dtype", "ndarray"):
            return _Dtype if name == "dtype" else _Name
        if module.split(".")[0] == "chumpy":
            return _Chumpy
        if module.startswith("scipy.sparse") and name in ("csc_matrix", "csr_matrix"):
            return _Sparse if name == "csc_matrix" else _SparseRows
        if module in ("copy_reg", "copyreg") and name == "_reconstructor":
            return lambda kind, base, state: kind() if issubclass(kind, _Stub) else _Stub()
        if module in ("__builtin__", "builtins") and name == "object":
            return _Name
        if (module, name) == ("_codecs", "encode"):
            return _encode
        raise pickle.UnpicklingError(f"it names {module}.{name}, which a FLAME model has no use for")


def read_flame_pickle(path: Path) -> dict[str, np.ndarray]:
    """The numeric arrays of a FLAME pickle by name; everything else in it is left out.

    Raises:
        UserError: the file is no such pickle, or names anything but arrays.
    """
    try:
        if path.stat().st_size > _LIMIT:
            raise pickle.UnpicklingError("it is larger than 1 GB")
        with path.open("rb") as file:
            content = _Unpickler(file, encoding="latin1").load()
        if not isinstance(content, dict):
            raise pickle.UnpicklingError("it holds no dictionary")
        found = {str(key): _array(value) for key, value in content.items()}
    except UserError:
        raise
    except Exception as error:  # a damaged pickle raises nearly anything
        raise UserError(
            f"{path} cannot be read as a FLAME model ({error}): give generic_model.pkl, or an npz of it"
        ) from error
    return {name: array for name, array in found.items() if array is not None}


def _array(value: Any, depth: int = 0) -> np.ndarray | None:
    """The numbers that a value holds, or None."""
    if depth > 8:
        return None
    if isinstance(value, _Array) and isinstance(value.state, tuple) and len(value.state) == 5:
        _, shape, dtype, fortran, raw = value.state
        return _from_bytes(raw, dtype, shape, "F" if fortran else "C")
    if isinstance(value, _Buffer) and len(value.arguments) == 4:
        return _from_bytes(*value.arguments)
    state = value.state if isinstance(value, _Stub) else None
    if isinstance(value, _Chumpy) and isinstance(state, dict):
        return _array(state.get("x"), depth + 1)
    if isinstance(value, _Sparse) and isinstance(state, dict):
        data, indices, starts = (_array(state.get(key), depth + 1) for key in ("data", "indices", "indptr"))
        shape = state.get("_shape", state.get("shape"))
        if data is None or indices is None or starts is None or not isinstance(shape, tuple):
            return None
        kind = scipy.sparse.csr_matrix if isinstance(value, _SparseRows) else scipy.sparse.csc_matrix
        return kind((data, indices, starts), shape=tuple(map(int, shape))).toarray()
    return None


def _from_bytes(raw: Any, dtype: Any, shape: Any, order: Any) -> np.ndarray | None:
    """An array of numbers from its bytes; None for objects and text."""
    if not isinstance(dtype, _Dtype) or not dtype.arguments or order not in ("C", "F"):
        return None
    code = str(dtype.arguments[0])
    if code[:1] not in "biuf" or not code[1:].isdigit() or not isinstance(raw, (bytes, bytearray, str)):
        return None
    big = isinstance(dtype.state, tuple) and len(dtype.state) > 1 and dtype.state[1] == ">"
    kind = np.dtype((">" if big else "<") + code)
    flat = np.frombuffer(raw.encode("latin1") if isinstance(raw, str) else raw, kind)
    return flat.reshape(shape, order=order).copy()
