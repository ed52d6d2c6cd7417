"""INSTA: heads, with FLAME tracked by the metrical tracker; also as RGBAvatar and FATE keep it.

::

    images/00012.png                  RGBA; the alpha is the person
    alpha/00012.png                   FATE's mask, clothes in it; taken where images/ has no alpha
    transforms{,_train,_test}.json    frames [{file_path, transform_matrix, ...}]; cx cy fl_x fl_y w h
    checkpoint/00012.frame            torch file: flame {exp, jaw, eyes, ...}, opencv {R, t, K}, img_size
    flame/exp/00012.txt               expression, a number a line; flame/{jaw,eyes} where FATE's

Source: INSTA (Zielon/INSTA, scripts/transforms.py), FATE (train/dataset.py) and RGBAvatar. transform_matrix
is camera-to-world: the inverse of the tracker's opencv R, t as it stands, so its axes are OpenCV's. Some
programs write the same file with OpenGL's axes (y up, z towards the viewer), as instant-ngp has it. The
world is the head's own, with its origin in the head, and a head that was filmed lies before the camera:
where the origin's depth is negative in OpenCV's axes, they are OpenGL's, and the second and third columns
change sign. Metres; each frame has a camera of its own. Where there is no transforms.json, the camera of
the .frame files stands still and opencv R, t is the head in it.

FLAME's numbers start the fit, see ``insta_heads``. The body is given the head's direction; its place is
left to the keypoints, since FLAME's origin is no joint of SMPL-X.

With transforms_train.json and transforms_test.json the split is theirs; ``ingest.test_frames=350`` is that of
the paper and of RGBAvatar. A folder of GaussianAvatars (VHAP's export) has a transforms.json, too, of several
cameras and with FLAME in ``flame_param/``; it is none of INSTA's.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.clip.frame_files import match_names, number_files
from pipeline.errors import UserError
from pipeline.untrusted import inside, parse_json
from stages.ingest.cameras.calibration import (
    EVERY_FRAME,
    CalibratedCamera,
    Calibration,
    check_rotation,
    pinhole_lens,
)
from stages.ingest.datasets.insta_heads import TrackedHead, poses_of, read_texts, read_tracker
from stages.ingest.datasets.recording import (
    Recording,
    Shot,
    entry,
    files_of,
    numbers,
    pinhole_of_matrix,
    read_array,
)
from stages.ingest.mask_files import has_own_alpha
from stages.ingest.settings import IngestSettings
from stages.ingest.video import PICTURES, Clip, clip_frames, folder_clip

_REMEDY = "unpack the INSTA subject again"
_GAUSSIAN_AVATARS = ("flame_param", "canonical_flame_param.npz")
_FLIP = np.diag([1.0, -1.0, -1.0])
_SAME_SIDE = 0.9  # share of the frames whose head must be on one side of the camera


def recognises(folder: Path) -> bool:
    """Images with the metrical tracker's files."""
    tracked = (folder / "transforms.json").is_file() or (folder / "checkpoint").is_dir()
    return (folder / "images").is_dir() and tracked and not _of_gaussian_avatars(folder)


def read(source: Path, settings: IngestSettings) -> Recording:
    """Read an actor's folder; UserError where a file of it is malformed."""
    if _of_gaussian_avatars(source):
        raise _another_layout(source)
    pictures = number_files(source / "images", PICTURES)
    clip = folder_clip(source / "images", pictures, 25.0)
    heads = read_tracker(source, clip)
    path, notes = source / "transforms.json", []
    if path.is_file():
        table = parse_json(path, _REMEDY)
        if any("flame_param_path" in frame for frame in _frames(table, path) if isinstance(frame, dict)):
            raise _another_layout(source)
        views, axes = _views(source, table, path, clip)
        notes.append(f"its cameras have {axes}'s axes")
        heads = heads or read_texts(source, clip, views)
        calibration = Calibration(path, "INSTA", views, metric=True, upright=False, by_frame=True)
    elif heads:
        calibration = _tracked_camera(source, heads, clip)
    else:
        raise UserError(f"{source} has neither transforms.json nor checkpoint/*.frame: {_REMEDY}")
    masks = None
    if not has_own_alpha(pictures):
        masks = files_of(source / "alpha", clip)
        notes += [] if masks else ["no masks, neither in images/ as alpha nor in alpha/"]
    notes += [] if heads else ["no expressions, neither in checkpoint/ nor in flame/exp/"]
    shot = Shot(clip, calibration, None, masks, "white", poses_of(heads))
    train, test = (_listed(source, part, clip) for part in ("train", "test"))
    return Recording("insta", (shot,), train, test, notes=tuple(notes))


def _another_layout(source: Path) -> UserError:
    return UserError(
        f"{source} is a folder of GaussianAvatars (FLAME in npz files, several cameras), not of INSTA: "
        "give one camera's pictures as a folder of their own, with ingest.layout=plain"
    )


def _frames(table: Any, path: Path) -> list[Any]:
    """The entries of a transforms file."""
    frames = entry(table, "frames", path, _REMEDY)
    if not isinstance(frames, list):
        raise UserError(f"{path}: 'frames' is no list: {_REMEDY}")
    return frames


def _of_gaussian_avatars(folder: Path) -> bool:
    return any((folder / name).exists() for name in _GAUSSIAN_AVATARS)


def _tracked_camera(source: Path, heads: Mapping[int, TrackedHead], clip: Clip) -> Calibration:
    """The still camera of ``checkpoint/``."""
    folder = source / "checkpoint"
    matrix = next(iter(heads.values())).intrinsics
    assert matrix is not None  # a .frame file has them
    still = CalibratedCamera(pinhole_of_matrix(matrix, clip, folder, _REMEDY), np.eye(3), np.zeros(3))
    return Calibration(folder, "INSTA tracker", {EVERY_FRAME: still}, metric=True, upright=False)


def _views(source: Path, table: Any, path: Path, clip: Clip) -> tuple[dict[str, CalibratedCamera], str]:
    """Frame number -> camera, and whose axes the file has."""
    entries = _entries(source, table, path, clip)
    if not entries:
        raise UserError(f"{path} names no picture of {clip.path}: {_REMEDY}")
    matrices = {
        number: read_array(frame, "transform_matrix", (4, 4), f"{path}, frame {number}", _REMEDY)
        for number, frame in entries.items()
    }
    axes = _axes(np.stack(list(matrices.values())), path)
    views = {}
    for number, frame in entries.items():
        where, matrix = f"{path}, frame {number}", matrices[number]
        rotation = matrix[:3, :3].T if axes == "OpenCV" else (matrix[:3, :3] @ _FLIP).T
        check_rotation(rotation, where)
        lens = _lens({**table, **frame}, clip, where)
        views[str(number)] = CalibratedCamera(lens, rotation, -rotation @ matrix[:3, 3])
    return views, axes


def _axes(matrices: np.ndarray, path: Path) -> str:
    """Whose axes cameras-to-world [T, 4, 4] have, by the side on which the head, the origin, lies."""
    depths = -np.einsum("ti,ti->t", matrices[:, :3, 2], matrices[:, :3, 3])  # along the third axis
    before, behind = (depths > 0).mean(), (depths < 0).mean()
    if max(before, behind) < _SAME_SIDE:
        raise UserError(
            f"{path}: the head, the origin of its world, lies before {before:.0%} of the cameras and behind "
            f"{behind:.0%}, so its axes are in doubt: {_REMEDY}"
        )
    return "OpenCV" if before > behind else "OpenGL"


def _lens(own: Mapping[str, Any], clip: Clip, where: str) -> Any:
    """The lens of a frame's entry, for pictures of the clip's size."""
    size = [
        float(numbers(own.get(name, side), (), where, _REMEDY))
        for name, side in (("w", clip.width), ("h", clip.height))
    ]
    focal = [read_array(own, key, (), where, _REMEDY) for key in ("fl_x", "fl_y")]
    centre = [
        numbers(own.get(key, side / 2), (), where, _REMEDY)
        for key, side in zip(("cx", "cy"), size, strict=True)
    ]
    if min(focal) <= 0:
        raise UserError(f"{where}: the focal length is not positive: {_REMEDY}")
    scale = [clip.width / size[0], clip.height / size[1]] if min(size) > 0 else [1.0, 1.0]
    fx, fy = (float(f * s) for f, s in zip(focal, scale, strict=True))
    cx, cy = (float(c * s) for c, s in zip(centre, scale, strict=True))
    return pinhole_lens(clip.width, clip.height, (fx, fy), (cx, cy))


def _entries(source: Path, table: Any, path: Path, clip: Clip) -> dict[int, dict[str, Any]]:
    """Frame number -> its entry; each picture must lie inside the folder."""
    named = {str(entry(one, "file_path", path, _REMEDY)): one for one in _frames(table, path)}
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
