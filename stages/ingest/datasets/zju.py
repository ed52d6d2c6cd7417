"""ZJU-MoCap: 23 cameras in a room that stand still.

::

    annots.npy                    a pickled dictionary: cams {K, D, R, T}, ims [{ims: [path, ...]}, ...]
    images/<camera>/000123.jpg    as annots names them; in the original release <camera>/000123.jpg
    mask/<camera>/000123.png      not zero is the person; in the original release mask_cihp/
    smpl_params/123.npy           a pickled dictionary: Rh, Th, shapes, poses; originally new_params/

Source: the readers of GauHuman (scene/dataset_readers.py) and GART (lib_data/zju_mocap.py) for the refined
release (my_377), neuralbody's (lib/datasets/light_stage) for the original one (CoreView_377), and EasyMocap
for Rh and Th. A mask's path is the picture's with mask/ in the place of images/, or below mask_cihp/; a
pose has the number in the picture's name. Conversions: T is millimetres. K and D are OpenCV's, which counts
from the centre of the first pixel, so half a pixel is added; the distortion is taken out of the pictures.
EasyMocap turns the posed body about the ORIGIN, x = R(Rh) x_posed + Th with the root's own rotation zero, so
SMPL's root joint comes to be at R(Rh) J_0 + Th (``smplx_poses`` says what J_0 is, and how 72 numbers become
SMPL-X's).

Read in two ways. As the paper and FlexiAvatar do: one camera as a video, ``ingest.camera_name`` says which
by its number, 4 if nothing is said. As GauHuman does: ``ingest.test_cameras=others``, or numbers, holds out
other cameras: then the frames learnt from are 0 to 495, every fifth, and those held out 0 to 480 of each,
every thirtieth. (GauHuman halves the pictures; here ``ingest.long_side`` says how large they are.)
"""

from __future__ import annotations

import dataclasses
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from pipeline.clip.records import SHOT_STEP
from pipeline.errors import UserError
from pipeline.pose_files import InitialPoses
from pipeline.untrusted import inside, read_npy
from stages.ingest.cameras.calibration import EVERY_FRAME, CalibratedCamera, Calibration, check_rotation
from stages.ingest.cameras.extrinsics import to_upright_world
from stages.ingest.datasets.recording import Recording, Shot, entry, lacking, numbers, read_array
from stages.ingest.datasets.smplx_poses import SMPL_ROOT, smpl_poses
from stages.ingest.settings import IngestSettings
from stages.ingest.video import folder_clip

FPS = 50.0
TRAIN_CAMERA = 4
TRAIN_FRAMES, TEST_FRAMES = range(0, 500, 5), range(0, 17 * 30, 30)
_MASKS = ("mask", "mask_cihp")
_PARAMETERS = ("smpl_params", "new_params", "params")
_REMEDY = "unpack the ZJU-MoCap subject again"


@dataclasses.dataclass(frozen=True)
class RigCamera:
    """A camera in our world, and as annots.npy has it (world-to-camera, metres)."""

    calibrated: CalibratedCamera
    rotation: np.ndarray
    translation: np.ndarray


def recognises(folder: Path) -> bool:
    """Its index is there."""
    return (folder / "annots.npy").is_file()


def read(source: Path, settings: IngestSettings) -> Recording:
    """Read a subject's folder; UserError where a file of it is malformed."""
    path = source / "annots.npy"
    annots = read_npy(path, _REMEDY)
    names = _names(annots, path)
    count = len(names[0])
    train = _camera(settings.camera_name or str(TRAIN_CAMERA), count, path)
    test = _held_out(settings.test_cameras, train, count, path)
    cameras = _cameras(annots, [train, *test], source, names)
    several = bool(test)
    shots = [_shot(source, names, train, 0, cameras[0], list(TRAIN_FRAMES) if several else None, path)]
    for place, camera in enumerate(test, start=1):
        shots.append(_shot(source, names, camera, place * SHOT_STEP, cameras[place], list(TEST_FRAMES), path))
    notes = _notes(shots)
    if not several:
        return Recording("zju", tuple(shots), notes=notes)
    held = frozenset(frame for shot in shots[1:] for frame in shot.clip.pictures)
    return Recording("zju", tuple(shots), frozenset(shots[0].clip.pictures), held, notes)


def _notes(shots: list[Shot]) -> tuple[str, ...]:
    """What the folder promises and does not have."""
    frames = sum(len(shot.clip.pictures) for shot in shots)
    poses = sum(len(shot.poses.frames) for shot in shots if shot.poses)
    notes = (
        lacking("masks", sum(len(shot.masks or ()) for shot in shots), frames, "mask/ and mask_cihp/"),
        lacking("poses", poses, frames, " and ".join(f"{name}/" for name in _PARAMETERS)),
    )
    return tuple(note for note in notes if note)


def _names(annots: Any, path: Path) -> list[list[str]]:
    """The picture names, by frame and camera."""
    frames = entry(annots, "ims", path, _REMEDY)
    if not isinstance(frames, list) or not frames:
        raise UserError(f"{path}: 'ims' is no list of frames: {_REMEDY}")
    names = [entry(frame, "ims", path, _REMEDY) for frame in frames]
    names = [list(np.ravel(one)) if isinstance(one, np.ndarray) else one for one in names]
    fits = all(isinstance(one, list) and len(one) == len(names[0]) > 0 for one in names)
    if not fits or not all(isinstance(name, str) for one in names for name in one):
        raise UserError(f"{path}: 'ims' does not name as many pictures in each frame: {_REMEDY}")
    return names


def _camera(name: str, count: int, path: Path) -> int:
    if not (name.isdigit() and int(name) < count):
        raise UserError(f"{path} has cameras 0 to {count - 1}, not '{name}': set ingest.camera_name to one")
    return int(name)


def _held_out(names: tuple[str, ...], train: int, count: int, path: Path) -> list[int]:
    if names == ("others",):
        return [camera for camera in range(count) if camera != train]
    return [camera for camera in (_camera(name, count, path) for name in names) if camera != train]


def _cameras(annots: Any, cameras: list[int], source: Path, names: list[list[str]]) -> list[RigCamera]:
    """The cameras in one upright world, whose origin is the first one (``cameras.extrinsics``)."""
    path = source / "annots.npy"
    tables = entry(annots, "cams", path, _REMEDY)
    rotations, translations, lenses = [], [], []
    for camera in cameras:
        parts = {}
        for key, shape in (("K", (3, 3)), ("D", (-1,)), ("R", (3, 3)), ("T", (3,))):
            table = entry(tables, key, path, _REMEDY)
            if camera >= len(table):
                raise UserError(f"{path}: '{key}' has no camera {camera}: {_REMEDY}")
            parts[key] = numbers(table[camera], shape, f"{path}, '{key}' of camera {camera}", _REMEDY)
        check_rotation(parts["R"], f"{path}, camera {camera}")
        rotations.append(parts["R"])
        translations.append(parts["T"] / 1000.0)
        clip = folder_clip(source, {0: inside(source, names[0][camera], path)})
        lenses.append(_lens(parts["K"], parts["D"], clip.width, clip.height))
    settled = to_upright_world(np.stack(rotations), np.stack(translations))
    rows = zip(lenses, *settled, rotations, translations, strict=True)
    return [
        RigCamera(CalibratedCamera(lens, turn, shift), *original) for lens, turn, shift, *original in rows
    ]


def _lens(matrix: np.ndarray, bend: np.ndarray, width: int, height: int) -> pycolmap.Camera:
    bend = np.concatenate([bend, np.zeros(5)])[:5]  # k1, k2, p1, p2, k3
    place = [matrix[0, 0], matrix[1, 1], matrix[0, 2] + 0.5, matrix[1, 2] + 0.5]
    params = [*place, *bend, 0.0, 0.0, 0.0]
    return pycolmap.Camera(model="FULL_OPENCV", width=width, height=height, params=params)


def _shot(
    source: Path,
    names: list[list[str]],
    camera: int,
    first: int,
    view: RigCamera,
    chosen: list[int] | None,
    path: Path,
) -> Shot:
    """One camera's frames, numbered from ``first``."""
    frames = [frame for frame in chosen or range(len(names)) if frame < len(names)]
    shown = {frame: names[frame][camera] for frame in frames}
    pictures = {frame: inside(source, name, path) for frame, name in shown.items()}
    found = {first + frame: mask for frame, mask in _masks(source, shown, path).items()}
    clip = folder_clip(source, {first + frame: file for frame, file in pictures.items()}, FPS)
    calibration = Calibration(path, "ZJU-MoCap", {EVERY_FRAME: view.calibrated}, metric=True, upright=True)
    return Shot(clip, calibration, None, found or None, "nonzero", _poses(source, shown, first, view))


def _masks(source: Path, names: dict[int, str], path: Path) -> dict[int, Path]:
    """Frame -> mask, of the first folder that has any.

    The original release has both folders, and its readers take the second.
    """
    refined = any(name.startswith("images") for name in names.values())
    for folder in _MASKS if refined else reversed(_MASKS):
        paths = {frame: _mask(source, folder, name, path) for frame, name in names.items()}
        found = {frame: mask for frame, mask in paths.items() if mask.is_file()}
        if found:
            return found
    return {}


def _mask(source: Path, folder: str, name: str, path: Path) -> Path:
    """A picture's mask in a folder that lies beside ``images/``, or that holds all of the picture's path."""
    parts = PurePosixPath(name.replace("\\", "/")).parts
    below = parts[1:] if parts[0] == "images" and len(parts) > 1 else parts
    return inside(source / folder, str(PurePosixPath(*below)), path).with_suffix(".png")


def _number(name: str, place: int) -> int:
    """The number in a picture's name: of 000123, or the fifth part of CoreView_313_Camera_(1)_0124_2019."""
    stem = PurePosixPath(name.replace("\\", "/")).stem
    parts = [stem, *stem.split("_")[4:5]]
    return next((int(part) for part in parts if part.isascii() and part.isdigit() and len(part) < 10), place)


def _poses(source: Path, names: dict[int, str], first: int, view: RigCamera) -> InitialPoses | None:
    """SMPL's poses in the axes of one camera."""
    folder = next(
        (source / name for name in _PARAMETERS if (source / name).is_dir()), source / _PARAMETERS[0]
    )
    paths = {frame: folder / f"{_number(name, frame)}.npy" for frame, name in names.items()}
    known = [frame for frame, path in paths.items() if path.is_file()]
    if not known:
        return None
    turns, places, poses, shapes = [], [], [], []
    for frame in known:
        value = read_npy(paths[frame], _REMEDY)
        parts = {
            key: read_array(value, key, shape, paths[frame], _REMEDY)
            for key, shape in (("Rh", (3,)), ("Th", (3,)), ("poses", (72,)), ("shapes", (-1,)))
        }
        turn = Rotation.from_rotvec(parts["Rh"]).as_matrix()
        turns.append(view.rotation @ turn)
        places.append(view.rotation @ (turn @ SMPL_ROOT + parts["Th"]) + view.translation)
        poses.append(parts["poses"])
        shapes.append(parts["shapes"])
    placed = [first + frame for frame in known]
    return smpl_poses(placed, np.stack(poses), np.stack(turns), np.stack(places), np.median(shapes, axis=0))
