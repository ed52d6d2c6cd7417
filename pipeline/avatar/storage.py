"""An avatar as one safetensors file: arrays and JSON, nothing that could run."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import safetensors
import torch
from safetensors.torch import save_file
from torch import Tensor

from pipeline.avatar.architecture import ON_REQUEST, Architecture
from pipeline.avatar.avatar import Avatar
from pipeline.avatar.skinning_tables import OWN
from pipeline.body import BodyModel, Identity
from pipeline.errors import UserError, first_line

FORMAT = "flexiavatar-avatar-4"
PREVIEW = "preview.safetensors"
"""The file beside a checkpoint that holds the avatar as it is so far."""
IDENTITY_FIELDS = ("betas", "joint_offset", "face_offset")


def save_avatar(path: Path, avatar: Avatar) -> None:
    """Writes the avatar; equal avatars give equal bytes.

    The file holds the weights (in float16 where the representation says so), the identity, and which body
    vertices are kept and not gated. The body model itself is not in it: ``load_avatar`` needs the one that
    the avatar was built on.

    Raises:
        ValueError: if any number in it is not finite.
    """
    half = avatar.representation.half_stored
    tensors = {
        stored: tensor.half() if stored.removeprefix("network.") in half else tensor
        for stored, tensor in ((_stored_name(name), tensor) for name, tensor in avatar.state_dict().items())
    }
    if bool((avatar.skin_rows == OWN).all()):
        del tensors[_stored_name("skin_rows")]  # each has its own vertex's weights
    for field in IDENTITY_FIELDS:
        tensors[f"identity.{field}"] = torch.as_tensor(getattr(avatar.identity, field))
    for name, tensor in tensors.items():
        if not bool(torch.isfinite(tensor).all()):
            raise ValueError(f"{name} of the avatar holds numbers that are not finite")
    tensors["kept"] = avatar.vertex_ids.int()
    for place, pairs in enumerate(avatar.splits):
        tensors[f"splits.{place}"] = pairs.int()
    header = {
        "format": FORMAT,
        "body": avatar.body_digest,
        "architecture": _described(avatar.architecture),
        "half_precision": avatar.half_precision,
        "pose_heads_active": avatar.pose_heads_active,
        "residuals_active": avatar.residuals_active,
        "unseen": avatar.unseen,
        "completed": bool(len(avatar.completion)),
    }
    # One entry only: safetensors writes several in an order of its own, different in each process.
    metadata = {"avatar": json.dumps(header, sort_keys=True)}
    save_file({name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}, path, metadata)


def save_preview(folder: Path, avatar: Avatar) -> None:
    """Replaces the avatar that a run shows of itself while it trains, in one step."""
    partial = folder / f"{PREVIEW}.partial"
    save_avatar(partial, avatar)
    partial.replace(folder / PREVIEW)


def _stored_name(name: str) -> str:
    """The name in the file of a tensor of ``Avatar.state_dict``."""
    return f"network.{name.removeprefix('representation.')}"


def _described(architecture: Architecture) -> dict:
    """The sizes as JSON values; what an ablation alone asks for is written only where it was asked for."""
    sizes = dataclasses.asdict(architecture)
    usual = Architecture()
    for name in ON_REQUEST:
        if sizes[name] == getattr(usual, name):
            del sizes[name]
    del sizes["plane_deviation"]
    if architecture.representation == "triplane":
        del sizes["representation"], sizes["bases"], sizes["bends"]
    return sizes


def load_avatar(path: Path, body: BodyModel) -> Avatar:
    """Reads an avatar, ready to be posed.

    Args:
        path: an ``avatar.safetensors``.
        body: the body model that it was trained on.

    Raises:
        UserError: if the file is no avatar, is damaged, or belongs to another body model.

    An avatar in the rest pose, from a file in ``avatar_file``:

    >>> from pathlib import Path
    >>> from pipeline.body import Pose, load_body
    >>> avatar = load_avatar(avatar_file, load_body(Path("data/body/open_body.npz")))
    >>> rest = Pose(rotation=torch.zeros(55, 3), expression=torch.zeros(10), transl=torch.zeros(3))
    >>> gaussians = avatar.gaussians(rest)
    >>> len(gaussians) == len(avatar)
    True
    """
    header, tensors = _read(path)
    try:
        return _avatar_of(path, body, header, tensors)
    except (
        KeyError,
        TypeError,
        ValueError,
        RuntimeError,
        IndexError,
        AttributeError,
        OverflowError,
    ) as error:
        raise UserError(f"{path} does not fit its own description; run the train stage again") from error


def _avatar_of(path: Path, body: BodyModel, header: dict[str, Any], tensors: dict[str, Tensor]) -> Avatar:
    if header.get("format") != FORMAT:
        raise UserError(f"{path} is not an avatar of this version; run the train stage again")
    if header["body"] != body.digest:
        raise UserError(f"{path} was trained on another body model; use that one, or run fit and train again")
    identity = Identity(**{field: tensors[f"identity.{field}"] for field in IDENTITY_FIELDS})
    parts = tuple(header["architecture"]["residual_parts"])  # JSON knows no tuples
    architecture = Architecture(**{**header["architecture"], "residual_parts": parts})
    splits = [tensors[name].long() for name in sorted(tensors) if name.startswith("splits.")]
    half = header["half_precision"]
    avatar = Avatar(body, identity, tensors["kept"].long(), architecture, half_precision=half, splits=splits)
    if header["completed"]:
        avatar.completion = torch.zeros(len(avatar.trust), 9)
    names = {_stored_name(name): name for name in avatar.state_dict()}
    weights = {
        names.get(stored, stored): tensor
        for stored, tensor in tensors.items()
        if stored.startswith("network.")
    }
    weights.setdefault("skin_rows", avatar.skin_rows)
    avatar.load_state_dict(weights)
    avatar.apply_skin()
    avatar.pose_heads_active = header["pose_heads_active"]
    avatar.residuals_active = header["residuals_active"]
    avatar.unseen = header["unseen"]
    return avatar.eval()


def _read(path: Path) -> tuple[dict, dict[str, Tensor]]:
    try:
        with safetensors.safe_open(path, "pt") as file:
            header = json.loads((file.metadata() or {}).get("avatar", "{}"))
            if not isinstance(header, dict):
                raise ValueError("its description is no table")
            return header, {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (OSError, ValueError, RecursionError, safetensors.SafetensorError) as error:
        raise UserError(f"{path} cannot be read ({first_line(error)}); run the train stage again") from error
