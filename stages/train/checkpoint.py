"""Checkpoints: everything that a resumed run needs to go on as if nothing had happened."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from collections.abc import Iterable
from pathlib import Path

import safetensors
import torch
from safetensors.torch import save
from torch import Tensor, nn

NAME = "checkpoint.safetensors"


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """The state after ``iteration`` steps.

    Attributes:
        iteration: steps done.
        key: of the run that it belongs to; another run's is not resumed from.
        tensors: parameters, buffers and the optimisers' moments by name.
        extra: JSON values.
    """

    iteration: int
    key: str
    tensors: dict[str, Tensor]
    extra: dict


def write_checkpoint(folder: Path, checkpoint: Checkpoint) -> None:
    """Replaces the last checkpoint by a new one, atomically."""
    header = {"iteration": checkpoint.iteration, "key": checkpoint.key, "extra": checkpoint.extra}
    header["sha256"] = digest_of(header, checkpoint.tensors)
    partial = folder / f"{NAME}.partial"
    with partial.open("wb") as file:
        file.write(save(checkpoint.tensors, {"checkpoint": json.dumps(header)}))
        file.flush()
        os.fsync(file.fileno())
    partial.replace(folder / NAME)


def read_checkpoint(folder: Path, key: str) -> Checkpoint | None:
    """The run's last checkpoint; None if there is none, it is damaged in any bit or another run's."""
    try:
        with safetensors.safe_open(folder / NAME, "pt") as file:
            header = json.loads((file.metadata() or {})["checkpoint"])
            sealed = header.pop("sha256")
            if header["key"] != key:
                return None
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            if sealed != digest_of(header, tensors):
                return None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, safetensors.SafetensorError):
        return None
    return Checkpoint(header["iteration"], key, tensors, header["extra"])


def digest_of(header: dict, tensors: dict[str, Tensor]) -> str:
    """A digest of a checkpoint's JSON values, and its tensors by name, type, shape and content."""
    digest = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name, tensor in sorted(tensors.items()):
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        digest.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def run_key(settings: dict, arrays: Iterable[Tensor]) -> str:
    """A digest of what determines a run."""
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    for array in arrays:
        digest.update(str(tuple(array.shape)).encode())
        digest.update(array.contiguous().numpy().tobytes())
    return digest.hexdigest()


def gather(modules: dict[str, nn.Module], optimizers: Iterable[torch.optim.Optimizer]) -> dict[str, Tensor]:
    """The modules' parameters and buffers, and the optimisers' state of each parameter; on the CPU."""
    tensors = {
        f"{prefix}.{name}": tensor
        for prefix, module in modules.items()
        for name, tensor in module.state_dict().items()
    }
    for optimizer in optimizers:
        for name, parameter in _named(modules):
            for field, value in optimizer.state.get(parameter, {}).items():
                tensors[f"optimizer.{field}.{name}"] = value
    return {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}


def restore(
    tensors: dict[str, Tensor], modules: dict[str, nn.Module], optimizers: Iterable[torch.optim.Optimizer]
) -> None:
    """Restores what ``gather`` took, on whatever device the modules are now."""
    for prefix, module in modules.items():
        own = {
            name.removeprefix(f"{prefix}."): tensor
            for name, tensor in tensors.items()
            if name.startswith(f"{prefix}.")
        }
        module.load_state_dict(own)
    owner = {
        parameter: optimizer
        for optimizer in optimizers
        for group in optimizer.param_groups
        for parameter in group["params"]
    }
    parameters = dict(_named(modules))
    for full_name, tensor in tensors.items():
        kind, _, rest = full_name.partition(".")
        if kind == "optimizer":
            field, _, name = rest.partition(".")
            parameter = parameters[name]
            # A copy: what safetensors returns lies in the mapped file, with any alignment.
            owner[parameter].state[parameter][field] = tensor.to(parameter.device, copy=True)


def _named(modules: dict[str, nn.Module]) -> list[tuple[str, nn.Parameter]]:
    return [
        (f"{prefix}.{name}", parameter)
        for prefix, module in modules.items()
        for name, parameter in module.named_parameters()
    ]
