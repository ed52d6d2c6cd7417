"""X-Humans: a take of a scanned person, rendered.

::

    <id>/train/<Take>/render/image/*_000012.png
    <id>/train/<Take>/render/cameras.npz          intrinsic [3, 3], extrinsic [T, 3, 4] or one of [3|4, 4]
    <id>/train/<Take>/render/keypoints_whole_body/12.json
    <id>/train/<Take>/SMPLX/*000012*.pkl

The source is the take's folder. Source: ExAvatar's reader, which names the files; ExAvatar's takes are 00028
Take15, 00034 Take14, 00087 Take8. What is in the pickles it does not say; the names of the smplx package
are read (global_orient, body_pose, jaw_pose, leye_pose, reye_pose, left_hand_pose, right_hand_pose,
expression, betas, transl), and a file without them is refused. Conversions: extrinsics are world-to-camera
with OpenCV axes, in metres; transl is relative to the root joint in the world. Hands of fewer than 45
numbers are coefficients of SMPL-X's components, relative to the mean (see ``talkshow``).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.clip.frame_files import number_files
from pipeline.errors import UserError
from pipeline.pose_files import InitialPoses
from pipeline.untrusted import read_npz, read_pickle
from stages.ingest.cameras.calibration import CalibratedCamera, Calibration, check_rotation
from stages.ingest.cameras.extrinsics import Extrinsics
from stages.ingest.datasets.recording import (
    Recording,
    Shot,
    entry,
    files_of,
    numbers,
    pinhole_of_matrix,
    read_array,
    stacked,
)
from stages.ingest.datasets.smplx_poses import initial_poses
from stages.ingest.settings import IngestSettings
from stages.ingest.video import PICTURES, folder_clip

_REMEDY = "unpack the X-Humans take again"
_BODY = (("global_orient", 3, 0), ("body_pose", 63, 1), ("jaw_pose", 3, 22), ("leye_pose", 3, 23),
         ("reye_pose", 3, 24))  # fmt: skip


def recognises(folder: Path) -> bool:
    """Renders with their cameras."""
    return (folder / "render" / "cameras.npz").is_file()


def read(source: Path, settings: IngestSettings) -> Recording:
    """Read a take's folder; UserError where a file of it is malformed."""
    render = source / "render"
    clip = folder_clip(render / "image", number_files(render / "image", PICTURES), 30.0)
    path = render / "cameras.npz"
    table = read_npz(path, _REMEDY)
    cameras = _cameras(table, path, list(clip.pictures))
    lens = pinhole_of_matrix(read_array(table, "intrinsic", (3, 3), path, _REMEDY), clip, path, _REMEDY)
    views = {str(frame): CalibratedCamera(lens, *pose) for frame, pose in cameras.items()}
    shot = Shot(
        clip=clip,
        calibration=Calibration(path, "X-Humans", views, metric=True, upright=False, by_frame=True),
        keypoints=files_of(render / "keypoints_whole_body", clip, (".json",)),
        masks=files_of(render / "mask", clip),
        poses=_poses(files_of(source / "SMPLX", clip, (".pkl",)) or {}, cameras),
    )
    return Recording("xhumans", (shot,))


def _cameras(table: dict[str, Any], path: Path, frames: list[int]) -> dict[int, Extrinsics]:
    """Frame -> world-to-camera, by the order of the pictures."""
    value = np.asarray(entry(table, "extrinsic", path, _REMEDY))
    rows = value.shape[-2] if value.ndim >= 2 else 0
    if rows not in (3, 4) or value.shape[-1] != 4:
        raise UserError(f"{path}: 'extrinsic' is {value.shape}, not [..., 3, 4]: {_REMEDY}")
    matrices = numbers(value, (-1, rows, 4), f"{path}, 'extrinsic'", _REMEDY)
    if len(matrices) not in (1, len(frames)):
        raise UserError(f"{path} has {len(matrices)} cameras for {len(frames)} pictures: {_REMEDY}")
    found = {}
    for row, frame in enumerate(frames):
        matrix = matrices[min(row, len(matrices) - 1)]
        check_rotation(matrix[:3, :3], f"{path}, camera {row}")
        found[frame] = (matrix[:3, :3], matrix[:3, 3])
    return found


def _poses(files: dict[int, Path], cameras: dict[int, Extrinsics]) -> InitialPoses | None:
    known = {frame: file for frame, file in files.items() if frame in cameras}
    if not known:
        return None
    rotation = np.zeros((len(known), 55, 3))
    columns: dict[str, list[np.ndarray]] = {"hands": [], "expression": [], "betas": [], "transl": []}
    for row, (frame, path) in enumerate(known.items()):
        value = read_pickle(path, _REMEDY)

        def number(key: str, count: int, value: Any = value, path: Path = path) -> np.ndarray:
            return read_array(value, key, (count,), path, _REMEDY)

        for key, count, joint in _BODY:
            rotation[row, joint : joint + count // 3] = number(key, count).reshape(-1, 3)
        turn, shift = cameras[frame]
        root = turn @ Rotation.from_rotvec(rotation[row, 0]).as_matrix()
        rotation[row, 0] = Rotation.from_matrix(root).as_rotvec()
        hands = [number(f"{side}_hand_pose", -1) for side in ("left", "right")]
        columns["hands"].append(stacked(hands, path, _REMEDY))
        columns["expression"].append(number("expression", -1))
        columns["betas"].append(number("betas", -1))
        columns["transl"].append(np.stack([number("transl", 3), shift]))
    folder = next(iter(known.values())).parent
    joined = {name: stacked(arrays, folder, _REMEDY) for name, arrays in columns.items()}
    transl = joined["transl"]
    place = _place(transl[:, 0], transl[:, 1], np.stack([cameras[frame][0] for frame in known]))
    betas = np.median(joined["betas"], axis=0)
    root = np.array(ROOT)
    return initial_poses(list(known), rotation, joined["expression"], betas, place, root, joined["hands"])


def _place(transl: np.ndarray, shift: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """The root joint in the cameras, R (J_0 + transl) + t, relative to J_0 of SMPL-X's mean body."""
    root = np.array(ROOT)
    return np.einsum("tij,tj->ti", turns, root + transl) + shift - root


ROOT = (0.0031, -0.3514, 0.0120)
"""J_0 of SMPL-X's neutral mean body, metres. A person's own differs by some mm to 2 cm."""
