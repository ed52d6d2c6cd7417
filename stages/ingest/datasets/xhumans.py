"""X-Humans: a take of a scanned person, rendered.

::

    <id>/mean_shape_smplx.npy                     betas [10] of all takes
    <id>/train/<Take>/render/image/color_000012.png
    <id>/train/<Take>/render/cameras.npz          intrinsic [3, 3], extrinsic [T, 4, 4] (or [3|4, 4] alone)
    <id>/train/<Take>/render/keypoints_whole_body/12.json    where ExAvatar prepared it
    <id>/train/<Take>/render/mask/mask_000012.png            where rendered again: labels in colours
    <id>/train/<Take>/SMPLX/mesh-f00012_smplx.pkl

The source is the take's folder. Source: X-Avatar (Skype-line/X-Avatar: data_process/README.md and
rendering_RGBD_image.py, which writes pictures and cameras, lib/dataset/XHumans_rgbd.py); ExAvatar's takes
are 00028 Take15, 00034 Take14, 00087 Take8. The pickles have the smplx package's names (global_orient,
body_pose, jaw_pose, leye_pose, reye_pose, left_hand_pose, right_hand_pose, expression, betas, transl);
their betas are to be replaced by mean_shape_smplx.npy. Pictures are counted from 1 in the order of the
meshes, whose own numbers may begin elsewhere: where there are as many, the n-th pickle and the n-th camera
are the n-th picture's.

Conversions: extrinsics are world-to-camera with OpenCV axes, in metres; transl is relative to the root
joint in the world. Hands are rotations relative to the mean hand (flat_hand_mean is false); of fewer than
45 numbers they are coefficients of SMPL-X's components (see ``talkshow``).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.clip.frame_files import number_files, visible_files
from pipeline.errors import UserError
from pipeline.pose_files import InitialPoses
from pipeline.untrusted import read_npy, read_npz, read_pickle
from stages.ingest.cameras.calibration import CalibratedCamera, Calibration, check_rotation
from stages.ingest.cameras.extrinsics import Extrinsics
from stages.ingest.datasets.recording import (
    Recording,
    Shot,
    entry,
    files_of,
    lacking,
    numbers,
    pinhole_of_matrix,
    read_array,
    stacked,
)
from stages.ingest.datasets.smplx_poses import initial_poses
from stages.ingest.settings import IngestSettings
from stages.ingest.video import PICTURES, Clip, folder_clip

MEAN_SHAPE = "mean_shape_smplx.npy"
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
    pickles = _pickles(source / "SMPLX", clip)
    shape = _mean_shape(source)
    shot = Shot(
        clip=clip,
        calibration=Calibration(path, "X-Humans", views, metric=True, upright=False, by_frame=True),
        keypoints=files_of(render / "keypoints_whole_body", clip, (".json",)),
        masks=files_of(render / "mask", clip),
        poses=_poses(pickles, cameras, shape),
    )
    notes = [lacking("poses", len(pickles), len(clip.pictures), "SMPLX/")]
    if pickles and shape is None:
        notes.append(f"no {MEAN_SHAPE} two folders up, so the shape is the pickles' own")
    return Recording("xhumans", (shot,), notes=tuple(note for note in notes if note))


def _pickles(folder: Path, clip: Clip) -> dict[int, Path]:
    """Frame -> pickle: by their order where there are as many as pictures, else by their numbers."""
    files = visible_files(folder, (".pkl",))
    if len(files) == len(clip.pictures):
        return dict(zip(clip.pictures, files, strict=True))
    return files_of(folder, clip, (".pkl",)) or {}


def _mean_shape(source: Path) -> np.ndarray | None:
    """The person's betas, which all takes share; None where the take is not in its person's folder."""
    path = source.resolve().parent.parent / MEAN_SHAPE
    return numbers(read_npy(path, _REMEDY), (-1,), str(path), _REMEDY) if path.is_file() else None


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


def _poses(
    files: dict[int, Path], cameras: dict[int, Extrinsics], shape: np.ndarray | None
) -> InitialPoses | None:
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
    betas = np.median(joined["betas"], axis=0) if shape is None else shape
    root = np.array(ROOT)
    return initial_poses(list(known), rotation, joined["expression"], betas, place, root, joined["hands"])


def _place(transl: np.ndarray, shift: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """The root joint in the cameras, R (J_0 + transl) + t, relative to J_0 of SMPL-X's mean body."""
    root = np.array(ROOT)
    return np.einsum("tij,tj->ti", turns, root + transl) + shift - root


ROOT = (0.0031, -0.3514, 0.0120)
"""J_0 of SMPL-X's neutral mean body, metres. A person's own differs by some mm to 2 cm."""
