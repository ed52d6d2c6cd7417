"""Arrays out of FLAME's pickle, of which nothing is executed.

The official file is a pickle of Python 2 with numpy arrays, scipy sparse matrices and chumpy objects in
it. It is read as every foreign pickle (``pipeline.untrusted.pickles``), with stubs for the last two.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

from pipeline.errors import UserError
from pipeline.untrusted.paths import GIGABYTE, bounded_bytes
from pipeline.untrusted.pickles import NameStub, Plain, Stub, load_stubs

_REMEDY = "give generic_model.pkl, or an npz of it"  # the official file has 53 MB


class _Chumpy(Stub):
    """A chumpy object; its value is what it calls x."""


class _Sparse(Stub):
    """A scipy sparse matrix, by columns."""


class _SparseRows(_Sparse):
    """A scipy sparse matrix by rows."""


class _Unknown(Stub):
    """An object of Python 2 of no further interest."""


def _names(module: str, name: str) -> Any:
    """The stubs that a FLAME model needs besides those of any pickle."""
    if module.split(".")[0] == "chumpy":
        return _Chumpy
    if module.startswith("scipy.sparse") and name in ("csc_matrix", "csr_matrix"):
        return _Sparse if name == "csc_matrix" else _SparseRows
    if module in ("copy_reg", "copyreg") and name == "_reconstructor":
        return _reconstructed
    if module in ("__builtin__", "builtins") and name == "object":
        return NameStub
    return None


def _reconstructed(kind: Any, base: Any, state: Any) -> Stub:
    """The constructor that Python 2's pickles name."""
    return kind() if isinstance(kind, type) and issubclass(kind, Stub) else _Unknown()


def read_flame_pickle(path: Path) -> dict[str, np.ndarray]:
    """The numeric arrays of a FLAME pickle by name; everything else in it is left out.

    Raises:
        UserError: the file is no such pickle, or names anything but arrays.
    """
    content = bounded_bytes(path, GIGABYTE, _REMEDY)
    try:
        model = load_stubs(content, _names)
        if not isinstance(model, dict):
            raise ValueError("it holds no dictionary")
        found = {str(key): _array(value) for key, value in model.items()}
    except Exception as error:  # a damaged pickle raises nearly anything
        raise UserError(f"{path} cannot be read as a FLAME model ({error}): {_REMEDY}") from error
    return {name: array for name, array in found.items() if array is not None}


def _array(value: Any) -> np.ndarray | None:
    """The numbers that a value holds, or None."""
    if not isinstance(value, Stub):
        return None
    try:
        found = Plain({_Chumpy: _chumpy, _Sparse: _sparse, _SparseRows: _sparse})(value)
    except ValueError:
        raise
    except Exception:  # no numbers: text, objects
        return None
    return found if isinstance(found, np.ndarray) else None


def _chumpy(value: Any, plain: Plain, depth: int) -> Any:
    state = value.state if isinstance(value.state, dict) else {}
    return plain(state.get("x"), depth + 1)


def _sparse(value: Any, plain: Plain, depth: int) -> Any:
    state = value.state if isinstance(value.state, dict) else {}
    data, indices, starts = (plain(state.get(key), depth + 1) for key in ("data", "indices", "indptr"))
    shape = state.get("_shape", state.get("shape"))
    if not all(isinstance(one, np.ndarray) for one in (data, indices, starts)) or not isinstance(
        shape, tuple
    ):
        return None
    kind = scipy.sparse.csr_matrix if isinstance(value, _SparseRows) else scipy.sparse.csc_matrix
    return kind((data, indices, starts), shape=tuple(map(int, shape))).toarray()
