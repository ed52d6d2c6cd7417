"""WildAvatar: people in clips from the web.

::

    metadata.json    frame id -> {cam_intrinsics 3x3, cam_extrinsics 4x4, poses 72, betas 10}; and "start"
    images/<id>.png or .jpg
    masks/<id>.png or .jpg    white is the person

Source: WildAvatar's release (zenodo 11526806) and its toolbox (wildavatar/WildAvatar_Toolbox:
prepare_data.py, vis_smpl.py, lib/gauhuman/dataset.py). The poses are SMPL's and have no translation: the
body turns about its root joint at the origin of its own axes, and the extrinsics (world-to-camera, OpenCV
axes, metres) say where the camera is. So each frame has a camera of its own, and the world is the person's.
Conversion of the 72 numbers: ``smplx_poses``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.clip.frame_files import number_files
from pipeline.errors import UserError
from pipeline.pose_files import InitialPoses
from pipeline.untrusted import parse_json
from stages.ingest.cameras.calibration import CalibratedCamera, Calibration, check_rotation
from stages.ingest.datasets.recording import (
    Recording,
    Shot,
    files_of,
    lacking,
    pinhole_of_matrix,
    read_array,
)
from stages.ingest.datasets.smplx_poses import SMPL_ROOT, smpl_poses
from stages.ingest.settings import IngestSettings
from stages.ingest.video import PICTURES, Clip, folder_clip

_REMEDY = "unpack the WildAvatar subject again"
_SHAPES = (("cam_intrinsics", (3, 3)), ("cam_extrinsics", (4, 4)), ("poses", (72,)), ("betas", (-1,)))


def recognises(folder: Path) -> bool:
    """Its index is beside images."""
    return (folder / "metadata.json").is_file() and (folder / "images").is_dir()


def read(source: Path, settings: IngestSettings) -> Recording:
    """Read a subject's folder; UserError where a file of it is malformed."""
    clip = folder_clip(source / "images", number_files(source / "images", PICTURES))
    path = source / "metadata.json"
    frames = _frames(parse_json(path, _REMEDY), path)
    frames = {frame: one for frame, one in frames.items() if frame in clip.pictures}
    if not frames:
        raise UserError(f"{path} describes none of the pictures in {clip.path}: {_REMEDY}")
    views = {str(frame): _view(one, clip, f"{path}, frame {frame}") for frame, one in frames.items()}
    calibration = Calibration(path, "WildAvatar", views, metric=True, upright=False, by_frame=True)
    masks = files_of(source / "masks", clip)
    shot = Shot(clip, calibration, None, masks, "white", _poses(frames))
    notes = (
        lacking("masks", len(masks or ()), len(clip.pictures), "masks/"),
        lacking("poses", len(frames), len(clip.pictures), path.name),
    )
    return Recording("wildavatar", (shot,), notes=tuple(note for note in notes if note))


def _frames(table: Any, path: Path) -> dict[int, dict[str, np.ndarray]]:
    if not isinstance(table, dict):
        raise UserError(f"{path} is no table of frames: {_REMEDY}")
    found = {}
    for name, value in table.items():
        if not name.isdigit():
            continue  # "start", the clip's second in the video
        where = f"{path}, frame {name}"
        found[int(name)] = {key: read_array(value, key, shape, where, _REMEDY) for key, shape in _SHAPES}
    return dict(sorted(found.items()))


def _view(frame: dict[str, np.ndarray], clip: Clip, where: str) -> CalibratedCamera:
    extrinsics = frame["cam_extrinsics"]
    check_rotation(extrinsics[:3, :3], where)
    lens = pinhole_of_matrix(frame["cam_intrinsics"], clip, where, _REMEDY)
    return CalibratedCamera(lens, extrinsics[:3, :3], extrinsics[:3, 3])


def _poses(frames: dict[int, dict[str, np.ndarray]]) -> InitialPoses:
    poses = np.stack([one["poses"] for one in frames.values()])
    extrinsics = np.stack([one["cam_extrinsics"] for one in frames.values()])
    root = extrinsics[:, :3, :3] @ Rotation.from_rotvec(poses[:, :3]).as_matrix()
    pelvis = extrinsics[:, :3, :3] @ SMPL_ROOT + extrinsics[:, :3, 3]  # the root joint stays where it rests
    betas = np.median([one["betas"] for one in frames.values()], axis=0)
    return smpl_poses(list(frames), poses, root, pelvis, betas)
