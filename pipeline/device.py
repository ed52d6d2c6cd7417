"""The device that training computes on, and records of tensors moved to it.

On a CPU the hot parts are numba kernels; elsewhere their plain torch twins run, which say the same.
Equal inputs and settings give equal bytes on a CPU only: a GPU adds up in an order of its own. The key of an
artifact depends on the setting and not on the machine, so that ``auto`` is one version wherever it ran; which
device it was is in ``run.json``.
"""

from __future__ import annotations

import dataclasses
import importlib.util
from typing import Any, TypeVar, get_args

import torch
from torch import Tensor

from pipeline.config.choices import Device
from pipeline.errors import UserError

Record = TypeVar("Record")


def resolve(word: str) -> torch.device:
    """The device that a setting names.

    Args:
        word: ``"cpu"``, ``"cuda"``, or ``"auto"``: a GPU where torch finds one and gsplat is installed,
            which renders there; else the CPU.

    Raises:
        UserError: a GPU is asked for and torch finds none.
    """
    if word not in get_args(Device):
        raise ValueError(f"a device is one of {', '.join(get_args(Device))}, not {word}")
    found = torch.cuda.is_available()
    if word == "cuda" and not found:
        build = "was built for the CPU" if torch.version.cuda is None else "finds no GPU that it can use"
        raise UserError(
            f"train.device is cuda, and torch {torch.__version__} {build}: install a CUDA build of torch and "
            "NVIDIA's driver, or set train.device=cpu"
        )
    wanted = word == "cuda" or (word == "auto" and importlib.util.find_spec("gsplat") is not None)
    return torch.device("cuda" if found and wanted else "cpu")


def kernels_serve(tensor: Tensor) -> bool:
    """True where the numba kernels can compute with a tensor, False where plain torch has to."""
    return tensor.device.type == "cpu"


def multiplies_bfloat16(device: torch.device) -> bool:
    """True where products in bfloat16 are faster than in float32: on a GPU, and on a CPU with AVX-512.

    On any other CPU torch emulates them: a layer of 128 channels then takes 20 times as long (measured on an
    AMD EPYC with AVX2).
    """
    return device.type != "cpu" or torch.backends.cpu.get_cpu_capability().startswith("AVX512")


def product_dtype(device: torch.device, half_precision: bool) -> torch.dtype:
    """The type that heads are multiplied in: bfloat16 where it is allowed and pays, else float32."""
    return torch.bfloat16 if half_precision and multiplies_bfloat16(device) else torch.float32


def autocast(device: torch.device, half_precision: bool) -> torch.autocast:
    """Products in ``product_dtype`` within this context."""
    enabled = product_dtype(device, half_precision) == torch.bfloat16
    return torch.autocast("cuda" if device.type == "cuda" else "cpu", torch.bfloat16, enabled=enabled)


def moved(record: Record, device: torch.device | str) -> Record:
    """A record with all of its tensors on a device; the record itself where they are there already.

    Args:
        record: a tensor, or a frozen dataclass, a tuple or a list of records. Anything else stays as it is.
        device: where to.
    """
    if isinstance(record, Tensor):
        return record.to(device)  # type: ignore[return-value]
    if isinstance(record, list | tuple):
        parts = [moved(part, device) for part in record]
        same = all(new is old for new, old in zip(parts, record, strict=True))
        return record if same else type(record)(parts)
    if not dataclasses.is_dataclass(record) or isinstance(record, type):
        return record
    fields: dict[str, Any] = {field.name: getattr(record, field.name) for field in dataclasses.fields(record)}
    changed = {name: new for name, old in fields.items() if (new := moved(old, device)) is not old}
    return dataclasses.replace(record, **changed) if changed else record
