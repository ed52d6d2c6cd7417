"""Poses of a clip as another program gave them, and the file that hands them from ingest to the fit.

``initial_poses.safetensors`` holds the arrays of :class:`InitialPoses` under their names, those that are
None left out, float32; ``frames`` int64 and ``valid`` uint8. Metadata: ``hands``, ``model`` and ``fitted``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import roma
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from pipeline.body import BodyModel
from pipeline.errors import UserError, first_line

INITIAL_POSES = "initial_poses.safetensors"
_WORDS = ("hands", "model", "fitted")
_REMEDY = "run the ingest stage again"
_VERTICES, _TRIANGLES = 10_475, 20_908  # of every release of SMPL-X


@dataclasses.dataclass(frozen=True)
class InitialPoses:
    """Poses of a clip as another program estimated them.

    Attributes:
        frames: the T frame numbers.
        rotation: [T, 55, 3], rotation vectors, radians, in the order of the schema. The root's is in
            the axes of the frame's camera (``pose_files.camera_frame``); the hands' see ``hands``.
        expression: [T, E], in the units of the program's own SMPL-X, or None.
        betas: [B], likewise, the median over the clip, or None.
        transl: [T, 3], the files' ``trans``, metres in the camera's axes, or None.
        valid: [T] bool, whether the frame had a usable file. The others are interpolated.
        pivot: [3], the root joint at rest of the body that the poses were made with, metres, which
            ``transl`` is relative to; None means that of the body which is posed by them.
        hands: what the hands are relative to: ``flat`` hands, or the ``mean`` of the body's file.
        hand_pca: [T, 2, P], left then right, coefficients of the components of SMPL-X's hands, which add
            to ``rotation``; or None.
        model: whose coefficients ``betas`` and ``expression`` are: ``smplx``, ``smpl``, or a body's
            digest.
        fitted: whether they were fitted to the clip, and not estimated frame by frame.
        joint_offset, face_offset: [55, 3] and [V, 3], metres, of a fitted identity, or None.
    """

    frames: tuple[int, ...]
    rotation: Tensor
    expression: Tensor | None
    betas: Tensor | None
    transl: Tensor | None
    valid: Tensor
    pivot: Tensor | None = None
    hands: str = "flat"
    hand_pca: Tensor | None = None
    model: str = "smplx"
    fitted: bool = False
    joint_offset: Tensor | None = None
    face_offset: Tensor | None = None


def is_official_smplx(body: BodyModel) -> bool:
    """True if coefficients of SMPL-X mean to this body what they mean to SMPL-X.

    Poses carry over between bodies of one skeleton, betas and expressions do not: the open body's are
    components of its own. The official model is known by its mesh, 10,475 vertices and 20,908 triangles,
    and by at least ten shape and ten expression directions, which every release has. Gender and release
    cannot be told, so the coefficients are a start and no more.
    """
    counts = body.shape_directions.shape[2], body.expression_directions.shape[2]
    return len(body.v_template) == _VERTICES and len(body.faces) == _TRIANGLES and min(counts) >= 10


def knows_coefficients(start: InitialPoses, body: BodyModel) -> bool:
    """True if the shape and the expression that came with poses were made for this body."""
    if start.model == "smplx":
        return is_official_smplx(body)
    return start.model == body.digest


def write_initial_poses(path: Path, poses: InitialPoses) -> None:
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


def read_initial_poses(path: Path) -> InitialPoses:
    """Read what ``write_initial_poses`` wrote.

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
    except (SafetensorError, OSError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise UserError(f"{path} cannot be read as initial poses ({first_line(error)}): {_REMEDY}") from None
    if poses.rotation.shape != (len(frames), 55, 3) or valid.shape != (len(frames),):
        raise UserError(f"{path}: its arrays do not fit its {len(frames)} frames: {_REMEDY}")
    return poses


def on_frames(poses: InitialPoses, frames: Sequence[int]) -> InitialPoses:
    """The poses of other frames, float32: those that are not known come from their neighbours.

    Args:
        poses: of at least one frame.
        frames: the T frame numbers, increasing.
    """
    rows = {frame: row for row, frame in enumerate(poses.frames) if bool(poses.valid[row])}
    known = torch.tensor([frame in rows for frame in frames])
    if not known.any():
        nearest = min(rows, key=lambda frame: abs(frame - frames[0]))
        chosen = torch.tensor([rows[nearest]] * len(frames))
        filled = _each(poses, lambda values: values[chosen], lambda values: values[chosen])
    else:
        chosen = torch.tensor([rows[frame] for frame in frames if frame in rows])
        times = torch.tensor(list(frames), dtype=torch.float64)
        filled = _each(
            poses,
            lambda values: _turned_between(values[chosen], times, known),
            lambda values: _between(values[chosen].flatten(1), times, known).unflatten(1, values.shape[1:]),
        )
    betas = None if poses.betas is None else poses.betas.float()
    return dataclasses.replace(poses, **filled, frames=tuple(frames), valid=known, betas=betas)


def _each(
    poses: InitialPoses, turned: Callable[[Tensor], Tensor], moved: Callable[[Tensor], Tensor]
) -> dict[str, Any]:
    """The arrays of all frames after one function for rotations and one for the rest."""
    vectors = {name: getattr(poses, name) for name in ("expression", "transl", "hand_pca")}
    found = {name: None if one is None else moved(one.double()).float() for name, one in vectors.items()}
    return {"rotation": turned(poses.rotation.double()).float(), **found}


def _neighbours(times: Tensor, known: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """For each of T frames the known ones around it, and how far it is from the first to the second.

    Returns:
        left and right [T], indices among the known frames, and share [T] in [0, 1], zero where both are
        the same frame.
    """
    have = times[known]
    right = torch.searchsorted(have, times).clamp_max(len(have) - 1)
    left = torch.where(have[right] > times, (right - 1).clamp_min(0), right)
    length = have[right] - have[left]
    share = torch.where(length > 0, (times - have[left]) / length.clamp_min(1), torch.zeros_like(length))
    return left, right, share


def _between(values: Tensor, times: Tensor, known: Tensor) -> Tensor:
    """Values of the N known frames, interpolated over all: [N, K] -> [T, K]."""
    left, right, share = _neighbours(times, known)
    return torch.lerp(values[left], values[right], share[:, None])


def _turned_between(rotation: Tensor, times: Tensor, known: Tensor) -> Tensor:
    """Rotation vectors of the N known frames along shortest arcs: [N, J, 3] -> [T, J, 3].

    Those of the known frames come back as they were.
    """
    left, right, share = _neighbours(times, known)
    start, end = (roma.rotvec_to_unitquat(rotation[rows]) for rows in (left, right))
    arc = roma.unitquat_to_rotvec(roma.quat_product(roma.quat_conjugation(start), end), shortest_arc=True)
    step = roma.rotvec_to_unitquat(arc * share[:, None, None])
    turned = roma.unitquat_to_rotvec(roma.quat_product(start, step))
    return torch.where((share > 0)[:, None, None], turned, rotation[left])
