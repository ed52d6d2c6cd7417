"""Cameras from the user's files: COLMAP models, rigs, ``cam_params`` folders, our own ``cameras.parquet``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import torch

from pipeline.clip.records import read_cameras
from pipeline.errors import UserError
from pipeline.untrusted import parse_json
from stages.ingest.cameras.calibration import (
    CalibratedCamera,
    Calibration,
    check_rotation,
    pinhole_lens,
)
from stages.ingest.cameras.model_bytes import check_model_bytes
from stages.ingest.cameras.rig import read_rig
from stages.ingest.video import Clip

WORDS = ("auto", "pinhole", "sfm")
PLACES = (".", "sparse", "sparse/0", "0")
LOOKED_AT = 20  # pictures whose points say how far the scene is
_KINDS = (
    "a COLMAP model (a folder with cameras.txt or cameras.bin), a Qualisys .qca.txt or Pose2Sim .toml file, "
    "a folder of {R, t, focal, princpt} files, or a cameras.parquet"
)


def open_calibration(cameras: str, name: str, clip: Clip) -> Calibration | None:
    """The calibration that ``ingest.cameras`` names; None where it is one of ``WORDS``.

    Args:
        cameras: the setting.
        name: ``ingest.camera_name``, which camera of a rig filmed the clip.
        clip: the footage, for files that do not say the picture's size.

    Raises:
        UserError: nothing there, of no known kind, or damaged.
    """
    if cameras in WORDS:
        return None
    path = Path(cameras)
    if not path.exists():
        raise UserError(f"{path} does not exist: ingest.cameras must be {', '.join(WORDS)}, or {_KINDS}")
    if path.is_dir():
        model = find_model(path)
        return read_model(model) if model is not None else _read_folder(path, clip)
    if path.suffix == ".parquet":
        return _read_own(path)
    if path.name.endswith((".toml", ".qca.txt", ".qca", ".xml")):
        return read_rig(path, name)
    raise UserError(f"{path} is no calibration that is known here: give {_KINDS}")


def find_model(folder: Path) -> Path | None:
    """The folder in or under ``folder`` that holds a model; None where there is none."""
    for place in PLACES:
        if any((folder / place / f"cameras.{kind}").is_file() for kind in ("txt", "bin")):
            return folder / place
    return None


def read_model(folder: Path) -> Calibration:
    """The registered pictures of a model. Its unit is arbitrary, and so are the axes of its world.

    Raises:
        UserError: damaged, or without a registered picture.
    """
    check_model_bytes(folder)
    try:
        return model_views(pycolmap.Reconstruction(str(folder)), folder)
    except UserError:
        raise
    except Exception as error:  # pycolmap raises what its C++ does: ValueError, RuntimeError, IndexError
        reason = str(error).splitlines()[-1] if str(error) else type(error).__name__
        raise UserError(f"{folder} cannot be read as a COLMAP model ({reason}): export it again") from None


def model_views(model: pycolmap.Reconstruction, folder: Path) -> Calibration:
    """The registered pictures of a model that is in memory; UserError where there are none."""
    views = {}
    for number in sorted(model.reg_image_ids()):
        image = model.image(number)
        pose = image.cam_from_world()
        lens = model.camera(image.camera_id)
        views[image.name] = CalibratedCamera(lens, pose.rotation.matrix(), np.array(pose.translation))
    if not views:
        raise UserError(f"{folder} is a COLMAP model without a registered picture: run COLMAP again")
    return Calibration(folder, "COLMAP", views, metric=False, upright=False, depth=scene_depth(model))


def scene_depth(model: pycolmap.Reconstruction) -> float:
    """The median depth of the points that some pictures see, in the model's unit; NaN without points."""
    numbers = sorted(model.reg_image_ids())
    depths = []
    for number in numbers[:: max(1, len(numbers) // LOOKED_AT)]:
        image = model.image(number)
        seen = [point.point3D_id for point in image.points2D if point.has_point3D()]
        if seen:
            points = np.array([model.point3D(one).xyz for one in seen])
            pose = image.cam_from_world()
            depths.append((points @ pose.rotation.matrix().T + pose.translation)[:, 2])
    return float(np.median(np.concatenate(depths))) if depths else float("nan")


def _read_own(path: Path) -> Calibration:
    """The cameras of a ``cameras.parquet`` of this stage's or the user's own."""
    views = {}
    for frame, camera in read_cameras(path, torch.float64).items():
        k = camera.intrinsics.numpy()
        lens = pinhole_lens(camera.width, camera.height, (k[0, 0], k[1, 1]), (k[0, 2], k[1, 2]))
        views[str(frame)] = CalibratedCamera(lens, camera.rotation.numpy(), camera.translation.numpy())
    if not views:
        raise UserError(f"{path} holds no camera: give another file, or set ingest.cameras=auto")
    return Calibration(path, "cameras.parquet", views, metric=True, upright=True, by_frame=True)


def _read_folder(path: Path, clip: Clip) -> Calibration:
    """``<idx>.json`` files of ``R`` [3, 3], ``t`` [3], ``focal`` [2] and ``princpt`` [2], a file a frame."""
    files = [file for file in sorted(path.glob("*.json")) if not file.name.startswith(".")]
    if not files:
        raise UserError(f"{path} holds neither a COLMAP model nor <frame>.json files: give {_KINDS}")
    views = {file.name: _read_json_view(file, clip) for file in files}
    return Calibration(path, "cam_params", views, metric=False, upright=False)


def _read_json_view(file: Path, clip: Clip) -> CalibratedCamera:
    value = parse_json(file, "write it again with R [3, 3], t [3], focal [2] and princpt [2]")
    parts = {}
    for key, shape in (("R", (3, 3)), ("t", (3,)), ("focal", (2,)), ("princpt", (2,))):
        try:
            parts[key] = np.array(value[key], np.float64).reshape(shape)
        except (KeyError, TypeError, ValueError, OverflowError):
            raise UserError(f"{file}: '{key}' is not {list(shape)} numbers: write the file again") from None
    check_rotation(parts["R"], f"{file}")
    if parts["focal"].min() <= 0:
        raise UserError(f"{file}: the focal lengths must be positive pixels, not {parts['focal'].tolist()}")
    lens = pinhole_lens(clip.width, clip.height, tuple(parts["focal"]), tuple(parts["princpt"]))
    return CalibratedCamera(lens, parts["R"], parts["t"])
