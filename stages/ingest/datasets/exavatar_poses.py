"""Poses and identity that ExAvatar's or FlexiAvatar's own preprocessing left in a folder.

::

    smplx_optimized/smplx_params/12.json             poses as fitted
    smplx_optimized/smplx_params_smoothed/12.json    after smoothing; not for NeuMan
    smplx_optimized/shape_param.json                 100 numbers
    smplx_optimized/{joint,face}_offset.json         [55][3], [V][3], metres
    smplx_optimized/body.json                        where ours: the digest of the body that was fitted
    smplx_init/12.json                               where nothing was fitted yet: the estimator's

Source: ExAvatar's fitting/ (mks0601/ExAvatar_RELEASE), whose layout FlexiAvatar's release keeps. Roots are
in the axes of the frame's camera and ``trans`` is relative to the root joint at rest
(``pipeline.pose_files.camera_frame``); hands are relative to the model's mean. ``locator_offset`` moves
supervision only and is not read.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import torch
from torch import Tensor

from pipeline.clip.frame_files import ClipFrames
from pipeline.errors import UserError
from pipeline.pose_files import InitialPoses, read_known_poses
from pipeline.untrusted import parse_json
from stages.ingest.datasets.recording import entry, numbers

_REMEDY = "prepare the folder again, or take smplx_optimized out of it"


def read_exavatar_poses(folder: Path, clip: ClipFrames, smoothed: bool) -> InitialPoses | None:
    """The best poses that a prepared folder has; None where it has none.

    Args:
        folder: the subject's.
        clip: all frames of its footage, which the files' names mean.
        smoothed: whether smoothed poses are preferred.

    Raises:
        UserError: a file is malformed.
    """
    fitted = folder / "smplx_optimized"
    order = ["smplx_params_smoothed", "smplx_params"] if smoothed else ["smplx_params"]
    for name in order:
        if (fitted / name).is_dir():
            return _with_identity(fitted, read_known_poses(fitted / name, clip=clip))
    init = folder / "smplx_init"
    return read_known_poses(init, clip=clip) if init.is_dir() else None


def _with_identity(fitted: Path, poses: InitialPoses) -> InitialPoses:
    shape = _array(fitted / "shape_param.json", (-1,))
    path = fitted / "body.json"
    model = "smplx"
    if path.is_file():
        model = str(entry(parse_json(path, _REMEDY), "body", path, _REMEDY))[:128]
    return dataclasses.replace(
        poses,
        fitted=True,
        model=model,
        betas=poses.betas if shape is None else shape,
        joint_offset=_array(fitted / "joint_offset.json", (55, 3)),
        face_offset=_array(fitted / "face_offset.json", (-1, 3)),
    )


def _array(path: Path, shape: tuple[int, ...]) -> Tensor | None:
    if not path.is_file():
        return None
    array = numbers(parse_json(path, _REMEDY), shape, f"{path}", _REMEDY)
    if not array.size or array.size > 1_000_000 or abs(array).max() > 1e3:
        raise UserError(f"{path} holds no offsets or coefficients: {_REMEDY}")
    return torch.from_numpy(array).float()
