"""``initial_poses.safetensors``: poses that a dataset came with, from the ingest to the fit stage.

The arrays of :class:`pipeline.pose_files.InitialPoses` under their names, those that are None left out,
float32; ``frames`` int64 and ``valid`` uint8. Metadata: ``hands``, ``model`` and ``fitted``.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from pipeline.errors import UserError
from pipeline.pose_files.read import InitialPoses

RECORD = "initial_poses.safetensors"
_WORDS = ("hands", "model", "fitted")
_REMEDY = "run the ingest stage again"


def write_record(path: Path, poses: InitialPoses) -> None:
    """Write poses; ValueError where a number is not finite."""
    fields = [field.name for field in dataclasses.fields(poses) if field.name not in (*_WORDS, "frames")]
    arrays = {name: getattr(poses, name) for name in fields if getattr(poses, name) is not None}
    arrays = {name: array.detach().float().contiguous() for name, array in arrays.items()}
    for name, array in arrays.items():
        if not torch.isfinite(array).all():
            raise ValueError(f"{name} of the initial poses is not finite")
    arrays["valid"] = poses.valid.to(torch.uint8)
    arrays["frames"] = torch.tensor(poses.frames, dtype=torch.int64)
    words = {"hands": poses.hands, "model": poses.model, "fitted": str(poses.fitted)}
    save_file(arrays, path, metadata=words)


def read_record(path: Path) -> InitialPoses:
    """Read what ``write_record`` wrote.

    Raises:
        UserError: missing, damaged, or of shapes that no poses have.
    """
    try:
        with safe_open(path, framework="pt") as file:
            words = file.metadata() or {}
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        frames = tuple(arrays.pop("frames").tolist())
        valid = arrays.pop("valid").bool()
        absent = dict.fromkeys(("expression", "betas", "transl"))
        poses = InitialPoses(
            frames=frames, valid=valid, hands=words["hands"], model=words["model"],
            fitted=words["fitted"] == "True", **{**absent, **arrays},
        )  # fmt: skip
    except (SafetensorError, OSError, KeyError, TypeError, RuntimeError) as error:
        raise UserError(f"{path} cannot be read as initial poses ({error}): {_REMEDY}") from None
    if poses.rotation.shape != (len(frames), 55, 3) or valid.shape != (len(frames),):
        raise UserError(f"{path}: its arrays do not fit its {len(frames)} frames: {_REMEDY}")
    return poses
