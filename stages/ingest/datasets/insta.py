"""INSTA: heads, with FLAME tracked by the metrical tracker; also as RGBAvatar and FATE keep it.

::

    images/00012.png                  RGBA; the alpha is the person
    alpha/00012.png                   where FATE's: taken in its place
    transforms{,_train,_test}.json    frames [{file_path, transform_matrix, ...}]; cx cy fl_x fl_y w h
    checkpoint/00012.frame            torch file: flame {exp, jaw, eyes, ...}, opencv {R, t, K}, img_size

Source: INSTA (Zielon/INSTA, scripts/transforms.py), RGBAvatar and FATE. transform_matrix is camera-to-world
with OpenGL's axes (x right, y up, z towards the viewer), as instant-ngp takes it: the second and third
columns change sign to become OpenCV's, and the inverse is world-to-camera. The world is the head's own, in
metres, so each frame has a camera of its own. Where there is no transforms.json, the camera of the .frame
files stands still and opencv R, t is the head in it.

FLAME's numbers start the fit: expression (FLAME's first coefficients are what SMPL-X's expressions are built
from), and the rotations of jaw and eyes, rotation vectors or the first two ROWS of a matrix (pytorch3d's six
numbers), left eye first. The body is given the head's direction; its place is left to the keypoints, since
FLAME's origin is no joint of SMPL-X.

With transforms_train.json and transforms_test.json the split is theirs; ``ingest.test_frames=350`` is that of
the paper and of RGBAvatar.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.clip.frame_files import match_names, number_files
from pipeline.errors import UserError
from pipeline.pose_files import InitialPoses
from pipeline.untrusted import inside, parse_json, read_torch
from stages.ingest.cameras.calibration import (
    EVERY_FRAME,
    CalibratedCamera,
    Calibration,
    check_rotation,
    pinhole_lens,
)
from stages.ingest.datasets.recording import (
    Recording,
    Shot,
    entry,
    files_of,
    numbers,
    pinhole_of_matrix,
    read_array,
)
from stages.ingest.datasets.smplx_poses import initial_poses
from stages.ingest.settings import IngestSettings
from stages.ingest.video import PICTURES, Clip, clip_frames, folder_clip

_REMEDY = "unpack the INSTA subject again"
_FLIP = np.diag([1.0, -1.0, -1.0])
_FRAME_BYTES = 64 << 20


def recognises(folder: Path) -> bool:
    """Images with a tracker's files."""
    tracked = (folder / "transforms.json").is_file() or (folder / "checkpoint").is_dir()
    return (folder / "images").is_dir() and tracked


def read(source: Path, settings: IngestSettings) -> Recording:
    """Read an actor's folder; UserError where a file of it is malformed."""
    pictures = number_files(source / "images", PICTURES)
    clip = folder_clip(source / "images", pictures, 25.0)
    tracked = files_of(source / "checkpoint", clip, (".frame",)) or {}
    heads = {frame: _head(path) for frame, path in tracked.items()}
    path = source / "transforms.json"
    if path.is_file():
        views = _views(source, parse_json(path, _REMEDY), path, clip)
        calibration = Calibration(path, "INSTA", views, metric=True, upright=False, by_frame=True)
    elif heads:
        lens = pinhole_of_matrix(next(iter(heads.values()))["K"], clip, source / "checkpoint", _REMEDY)
        still = CalibratedCamera(lens, np.eye(3), np.zeros(3))
        calibration = Calibration(path, "INSTA tracker", {EVERY_FRAME: still}, metric=True, upright=False)
    else:
        raise UserError(f"{source} has neither transforms.json nor checkpoint/*.frame: {_REMEDY}")
    masks = files_of(source / "alpha", clip)
    shot = Shot(clip, calibration, None, masks, "white", _poses(heads))
    return Recording("insta", (shot,), _listed(source, "train", clip), _listed(source, "test", clip))


def _views(source: Path, table: Any, path: Path, clip: Clip) -> dict[str, CalibratedCamera]:
    """Frame number -> camera."""
    views = {}
    for number, frame in _entries(source, table, path, clip).items():
        where = f"{path}, frame {number}"
        matrix = read_array(frame, "transform_matrix", (4, 4), where, _REMEDY)
        rotation = (matrix[:3, :3] @ _FLIP).T
        check_rotation(rotation, where)
        own = {**table, **frame}
        size = [float(own.get(name, side)) for name, side in (("w", clip.width), ("h", clip.height))]
        focal = [read_array(own, key, (), where, _REMEDY) for key in ("fl_x", "fl_y")]
        centre = [
            numbers(own.get(k, s / 2), (), where, _REMEDY) for k, s in zip(("cx", "cy"), size, strict=True)
        ]
        scale = [clip.width / size[0], clip.height / size[1]] if min(size) > 0 else [1.0, 1.0]
        if min(focal) <= 0:
            raise UserError(f"{where}: the focal length is not positive: {_REMEDY}")
        params = [(float(f * s), float(c * s)) for f, c, s in zip(focal, centre, scale, strict=True)]
        lens = pinhole_lens(
            clip.width, clip.height, (params[0][0], params[1][0]), (params[0][1], params[1][1])
        )
        views[str(number)] = CalibratedCamera(lens, rotation, -rotation @ matrix[:3, 3])
    return views


def _entries(source: Path, table: Any, path: Path, clip: Clip) -> dict[int, dict[str, Any]]:
    """Frame number -> its entry; each picture must lie inside the folder."""
    frames = entry(table, "frames", path, _REMEDY)
    if not isinstance(frames, list):
        raise UserError(f"{path}: 'frames' is no list: {_REMEDY}")
    named = {str(entry(frame, "file_path", path, _REMEDY)): frame for frame in frames}
    for name in named:
        inside(source, name, path)
    match = match_names(named, clip_frames(clip), path)
    for name in named:
        if name not in match.frames:
            raise UserError(f"{path} names '{name[:60]}', which is no picture of {clip.path}: {_REMEDY}")
    return {frame: named[name] for name, frame in match.frames.items()}


def _listed(source: Path, part: str, clip: Clip) -> frozenset[int] | None:
    path = source / f"transforms_{part}.json"
    return frozenset(_entries(source, parse_json(path, _REMEDY), path, clip)) if path.is_file() else None


def _head(path: Path) -> dict[str, np.ndarray]:
    """Jaw and eyes as rotation vectors [3, 3], expression, and the head in the camera."""
    value = read_torch(path, _REMEDY, _FRAME_BYTES)
    flame, camera = entry(value, "flame", path, _REMEDY), entry(value, "opencv", path, _REMEDY)
    shapes = (("R", (3, 3)), ("t", (3,)), ("K", (3, 3)))
    found = {key: read_array(camera, key, shape, path, _REMEDY) for key, shape in shapes}
    check_rotation(found["R"], str(path))
    found["exp"] = read_array(flame, "exp", (-1,), path, _REMEDY)
    turns = [_rotation_vectors(flame, key, count, path) for key, count in (("jaw", 1), ("eyes", 2))]
    return {**found, "turns": np.concatenate(turns)}


def _rotation_vectors(flame: Any, key: str, count: int, path: Path) -> np.ndarray:
    """[count, 3]; zero where the file says nothing."""
    if key not in flame:
        return np.zeros((count, 3))
    flat = read_array(flame, key, (-1,), path, _REMEDY)
    if len(flat) == 3 * count:
        return flat.reshape(count, 3)
    rows = numbers(flat, (count, 2, 3), f"{path}, {key}", _REMEDY)
    first = rows[:, 0] / np.maximum(np.linalg.norm(rows[:, 0], axis=1, keepdims=True), 1e-9)
    second = rows[:, 1] - (rows[:, 1] * first).sum(1, keepdims=True) * first
    second = second / np.maximum(np.linalg.norm(second, axis=1, keepdims=True), 1e-9)
    third = np.cross(first, second)
    return Rotation.from_matrix(np.stack([first, second, third], axis=1)).as_rotvec()


def _poses(heads: dict[int, dict[str, np.ndarray]]) -> InitialPoses | None:
    if not heads:
        return None
    rotation = np.zeros((len(heads), 55, 3))
    rotation[:, 0] = Rotation.from_matrix(np.stack([one["R"] for one in heads.values()])).as_rotvec()
    rotation[:, 22:25] = np.stack([one["turns"] for one in heads.values()])
    width = min(len(one["exp"]) for one in heads.values())
    expression = np.stack([one["exp"][:width] for one in heads.values()])
    return initial_poses(list(heads), rotation, expression)
