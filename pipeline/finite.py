"""Numbers that are not finite stop a stage where they first appear, and never reach an artifact.

What is looked at, and where: the loss terms and gradients of every step of training and of every step of the
fit, the parameters at every checkpoint, every column of every table (``tables.write_table``), every number of
every JSON file (``json_files.write_json``), masks and scored pictures, and every array file of a version
before it is published (``require_finite_files``). What each look costs is in docs/stability.md.

A look is one sum: NaN and infinities survive every sum. Only where the sum is not finite are the numbers
looked at one by one, since finite ones may have overflowed together.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.errors import UserError

if TYPE_CHECKING:  # the store is read by what must start quickly
    import numpy as np
    from torch import Tensor

ARRAY_FILES = (".safetensors", ".npz", ".npy")
"""The files that are looked into before they are published; tables and JSON were when they were written."""


class NotFiniteError(UserError, ValueError):
    """A number that is not finite. The message names what holds it, where in the run, and the remedy."""


def require_finite(tensors: Mapping[str, Tensor], who: str, where: str, remedy: str) -> None:
    """Refuses to go on with a number that is not finite.

    Args:
        tensors: by the names that a user is shown; of any shape, dtype and device.
        who: what stops: "training".
        where: the place in the run: "at iteration 3, frame 12".
        remedy: what the user can do.

    Raises:
        NotFiniteError: names the first tensor that holds one.

    >>> import torch
    >>> require_finite({"loss": torch.tensor(torch.nan)}, "training", "at iteration 3", "lower the rate")
    Traceback (most recent call last):
    pipeline.finite.NotFiniteError: training stopped: loss is not finite at iteration 3 (1 of 1 numbers, ...
    """
    if finite(tensors.values()):
        return
    for name, tensor in tensors.items():
        if not bool(tensor.isfinite().all()):
            raise NotFiniteError(
                f"{who} stopped: {name} is not finite {where} ({described(tensor)}); {remedy}"
            )


def finite(tensors: Iterable[Tensor]) -> bool:
    """True where the tensors add up to a finite number; then every number in them is finite.

    False says only that one may not be: large numbers overflow together.
    """
    import torch

    sums = [tensor.detach().sum() for tensor in tensors]
    # One number for all: each that is asked for waits for a GPU.
    return not sums or math.isfinite(float(torch.stack([one.float() for one in sums]).sum()))


def described(tensor: Tensor) -> str:
    """A text that says how many numbers of a tensor are not finite, and names the first."""
    bad = ~tensor.detach().isfinite()
    place = bad.nonzero()[0].tolist()
    value = float(tensor[tuple(place)])
    at = f" at {place}" if place else ""
    return f"{int(bad.sum())} of {tensor.numel()} numbers, the first {value}{at}"


def rows_not_finite(tensor: Tensor) -> list[int]:
    """The rows of a tensor [T, ...] that hold a number that is not finite."""
    return [int(row) for row in (~tensor.detach().isfinite()).flatten(1).any(1).nonzero()[:, 0]]


def require_finite_files(folder: Path, remedy: str) -> None:
    """Refuses to publish array files that hold a number that is not finite.

    Raises:
        NotFiniteError: names the file and the array.
    """
    for path in sorted(path for path in folder.rglob("*") if path.suffix in ARRAY_FILES and path.is_file()):
        for name, array in _arrays(path):
            if not _finite_array(array):
                raise NotFiniteError(f"not published: {name} of {path.name} is not finite; {remedy}")


def _finite_array(array: np.ndarray) -> bool:
    import numpy as np

    # In float64 no sum of float32 overflows, and float64's own that does is looked at again.
    total = array.sum(dtype=np.float64) if array.dtype.kind == "f" else 0.0
    return math.isfinite(total) or bool(np.isfinite(array).all())


def _arrays(path: Path) -> Iterable[tuple[str, np.ndarray]]:
    """The arrays of a file, one at a time; nothing in it can run."""
    if path.suffix == ".safetensors":
        import safetensors

        with safetensors.safe_open(path, "pt") as file:  # numpy knows no bfloat16
            for name in file.keys():  # noqa: SIM118
                tensor = file.get_tensor(name)
                yield name, (tensor.float() if tensor.is_floating_point() else tensor).numpy()
        return
    import numpy as np

    loaded = np.load(path, allow_pickle=False)
    if isinstance(loaded, np.ndarray):
        yield path.stem, loaded
        return
    with loaded:
        for name in loaded.files:
            yield name, loaded[name]
