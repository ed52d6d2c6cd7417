"""A device that is not the CPU, on a machine that has no other: it computes, and it refuses as CUDA does.

Its tensors say that they are on torch's ``meta`` device and hold their values on the CPU. Whatever meets them
has to be on that device, too, but for numbers without a dimension and for indices, as on CUDA; ``numpy``
refuses them. What it cannot show is speed, rounding, autocast and what a CUDA kernel does not support.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

DEVICE = torch.device("meta")
INDEXING = {  # CUDA takes its indices from the CPU
    torch.ops.aten.index.Tensor, torch.ops.aten.index_put_.default, torch.ops.aten._index_put_impl_.default,
    torch.ops.aten.index_put.default,
}  # fmt: skip
CROSSING = {torch.ops.aten._to_copy.default, torch.ops.aten.copy_.default}


class Elsewhere(Tensor):
    """A tensor on the pretended device."""

    held: Tensor

    @staticmethod
    def __new__(cls, held: Tensor) -> Elsewhere:
        strides = None if held.layout != torch.strided else held.stride()
        made = Tensor._make_wrapper_subclass(
            cls, held.shape, strides=strides, dtype=held.dtype, device=DEVICE, requires_grad=False
        )
        made.held = held
        return made

    def __repr__(self, **_: Any) -> str:
        return f"Elsewhere({self.held!r})"

    @classmethod
    def __torch_dispatch__(cls, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(function, args, kwargs or {})


class _Pretend(TorchDispatchMode):
    """Sees what makes tensors, as ``torch.zeros(..., device=DEVICE)``, and all else."""

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(function, args, kwargs or {})


class _Literals(TorchFunctionMode):
    """Torch leaves out the values of lists that become tensors on the meta device: they are moved there."""

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if function is torch.tensor and kwargs.get("device") == DEVICE:
            del kwargs["device"]
            return function(*args, **kwargs).to(DEVICE)
        if function in (Tensor.__getitem__, Tensor.__setitem__) and isinstance(args[1], tuple):
            place = tuple(
                torch.tensor(one).to(args[0].device) if isinstance(one, list) else one for one in args[1]
            )
            args = (args[0], place, *args[2:])
        return function(*args, **kwargs)


@contextlib.contextmanager
def pretend_device() -> Iterator[torch.device]:
    """Within this, tensors can be made on ``DEVICE``."""
    with _Literals(), _Pretend():
        yield DEVICE


def _run(function: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    tensors = [one for one in tree_flatten((args, kwargs))[0] if isinstance(one, Tensor)]
    there = any(isinstance(one, Elsewhere) for one in tensors)
    strangers = [one for one in tensors if not isinstance(one, Elsewhere) and one.ndim > 0]
    if there and strangers and function not in CROSSING | INDEXING:
        raise RuntimeError(f"{function}: a tensor of shape {tuple(strangers[0].shape)} was left on the CPU")
    if function in INDEXING and there != isinstance(args[0], Elsewhere):
        raise RuntimeError(f"{function}: values and indices are on different devices")
    asked = kwargs.get("device")
    if asked is not None:
        there, kwargs = torch.device(asked) == DEVICE, {**kwargs, "device": "cpu"}
    elif function in CROSSING:
        there = isinstance(args[0], Elsewhere)
    if function is torch.ops.aten._to_copy.default:
        kwargs = {name: value for name, value in kwargs.items() if name != "layout"}  # sparse ones stay so
    held = tree_map(lambda one: one.held if isinstance(one, Elsewhere) else one, (args, kwargs))
    result = function(*held[0], **held[1])
    if there and torch.Tag.inplace_view in function.tags:  # squeeze_: what the wrapper says changes, too
        with torch._C._DisableTorchDispatch():
            function(*args, **kwargs)
    if not there:
        return result
    return _like_arguments(result, tensors)


def _like_arguments(result: Any, tensors: list[Tensor]) -> Any:
    """The result on the pretended device; what was changed in place stays the same tensor."""
    known = {id(one.held): one for one in tensors if isinstance(one, Elsewhere)}

    def wrapped(one: Any) -> Any:
        if not isinstance(one, Tensor) or isinstance(one, Elsewhere):
            return one
        return known[id(one)] if id(one) in known else Elsewhere(one)

    return tree_map(wrapped, result)
