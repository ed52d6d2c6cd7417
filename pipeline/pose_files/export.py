"""Writing a fit as the folder that ExAvatar's and FlexiAvatar's own tools read.

::

    smplx_optimized/smplx_params/<frame>.json             poses as fitted
    smplx_optimized/smplx_params_smoothed/<frame>.json    poses after smoothing
    smplx_optimized/shape_param.json                      beta, 100 numbers
    smplx_optimized/{face,joint,locator}_offset.json      [V][3], [55][3], [55][3], metres
    smplx_optimized/body.json                             the digest of the body that was fitted; ours alone
    cam_params/<frame>.json                               R [3][3], t [3], focal [2], princpt [2]
    frame_list_all.txt                                    the measured frames, one a line

Poses are in the axes of each frame's own camera (``pose_files.camera_frame``). Their world is the camera
of the first frame: a camera that stands still has R = 1 and t = 0, as in their files.

Coefficients mean what they mean to the body that was fitted. Tools that build the official SMPL-X
reproduce the fit only if it was made with the official SMPL-X. They are built with 100 betas and 50
expressions, and stop at more: what the official file has beyond (its 51st to 100th expression, the least
of its components) is left out.

Their joints differ from ours in three ways. They are regressed from a template with its face offsets,
which is made up for in ``joint_offset``. The root joint has no offset; so the poses written turn about
the root joint without it, which leaves every vertex and every other joint in its place. And they follow
the expression, by a fraction of a millimetre, which is left as it is.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pipeline.body import BodyModel, Identity, Poses, rest_joints
from pipeline.body.joints import BODY_POSE, JAW, LEFT_EYE, LEFT_HAND, RIGHT_EYE, RIGHT_HAND
from pipeline.clip.camera import Camera
from pipeline.pose_files.camera_frame import HAND_JOINTS, into_camera, moved_pivot

_BETAS, _EXPRESSIONS = 100, 50  # what the tools' models are built with
_DIGITS = 7  # decimals: a tenth of a micrometre, a hundred-thousandth of a degree
_JOINTS: dict[str, int | slice] = {
    "root_pose": 0, "body_pose": BODY_POSE, "jaw_pose": JAW, "leye_pose": LEFT_EYE,
    "reye_pose": RIGHT_EYE, "lhand_pose": LEFT_HAND, "rhand_pose": RIGHT_HAND,
}  # fmt: skip


def write_peer_files(
    folder: Path,
    body: BodyModel,
    identity: Identity,
    raw: Poses,
    smoothed: Poses,
    cameras: Mapping[int, Camera],
    hand_mean: Tensor,
) -> None:
    """Write the files that the module's docstring lists.

    Args:
        smoothed: the poses after smoothing, of the same frames.
        hand_mean: [30, 3], what the tools will add to the hands, from ``read_hand_mean``.

    Raises:
        ValueError: a number is not finite.
    """
    fitted = folder / "smplx_optimized"
    views = [cameras[frame] for frame in raw.frames]
    ours, theirs = rest_joints(body, identity), tool_joints(body, identity)
    for name, poses in (("smplx_params", raw), ("smplx_params_smoothed", smoothed)):
        transl = moved_pivot(poses.rotation[:, 0], poses.transl, ours[0], theirs[0])
        moved = dataclasses.replace(poses, transl=transl)
        _write_poses(fitted / name, moved, theirs[0], views, hand_mean)
    joint_offset = ours - theirs
    joint_offset[0] = 0
    _write(fitted / "shape_param.json", _numbers(_resized(identity.betas, _BETAS)))
    _write(fitted / "face_offset.json", _numbers(identity.face_offset))
    _write(fitted / "joint_offset.json", _numbers(joint_offset))
    _write(fitted / "locator_offset.json", _numbers(torch.zeros_like(joint_offset)))
    _write(fitted / "body.json", {"body": body.digest})
    _write_cameras(folder / "cam_params", raw.frames, views)
    measured = [f"{frame}\n" for frame, valid in zip(raw.frames, raw.valid.tolist(), strict=True) if valid]
    (folder / "frame_list_all.txt").write_text("".join(measured), encoding="ascii", newline="\n")


def tool_joints(body: BodyModel, identity: Identity) -> Tensor:
    """The rest joints as the tools have them before ``joint_offset``: [55, 3], metres."""
    bare = dataclasses.replace(identity, joint_offset=torch.zeros_like(identity.joint_offset))
    return rest_joints(body, bare) + body.joint_regressor @ identity.face_offset


def _write_poses(folder: Path, poses: Poses, pivot: Tensor, views: list[Camera], hand_mean: Tensor) -> None:
    """Write a file a frame, of a body that turns about ``pivot``."""
    rotation = torch.stack([view.rotation for view in views])
    translation = torch.stack([view.translation for view in views])
    root_pose, trans = into_camera(poses.rotation[:, 0], poses.transl, pivot, rotation, translation)
    local = poses.rotation.double().clone()
    local[:, 0] = root_pose
    local[:, HAND_JOINTS] -= hand_mean.double()
    columns = {name: _numbers(local[:, joints]) for name, joints in _JOINTS.items()}
    columns |= {"expr": _numbers(_resized(poses.expression, _EXPRESSIONS)), "trans": _numbers(trans)}
    for row, frame in enumerate(poses.frames):
        _write(folder / f"{frame}.json", {name: values[row] for name, values in columns.items()})


def _write_cameras(folder: Path, frames: tuple[int, ...], views: list[Camera]) -> None:
    """Write a file a frame, relative to the first."""
    first = views[0].to(torch.float64)
    for frame, view in zip(frames, views, strict=True):
        here = view.to(torch.float64)
        rotation = here.rotation @ first.rotation.mT
        value = {
            "R": _numbers(rotation),
            "t": _numbers(here.translation - rotation @ first.translation),
            "focal": _numbers(here.intrinsics.diagonal()[:2]),
            "princpt": _numbers(here.intrinsics[:2, 2]),
        }
        _write(folder / f"{frame}.json", value)


def _resized(values: Tensor, length: int) -> Tensor:
    """[..., K] as ``length`` numbers: zeros are appended, or the last ones cut off."""
    return torch.nn.functional.pad(values, (0, length - values.shape[-1]))


def _numbers(values: Tensor) -> list:
    rounded = np.round(values.detach().cpu().double().numpy(), _DIGITS)
    return (rounded + 0.0).tolist()  # no -0.0


def _write(path: Path, value: list | dict) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value, allow_nan=False) + "\n", encoding="ascii", newline="\n")
