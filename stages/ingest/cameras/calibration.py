"""Cameras that the user's files give, whatever wrote them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pycolmap

from pipeline.clip.records import read_cameras
from pipeline.errors import UserError
from pipeline.untrusted import parse_json
from stages.ingest.video import Clip

WORDS = ("auto", "pinhole", "sfm")
EVERY_FRAME = ""
_KINDS = (
    "a COLMAP model (a folder with cameras.txt or cameras.bin), a Qualisys .qca.txt or Pose2Sim .toml file, "
    "a folder of {R, t, focal, princpt} files, or a cameras.parquet"
)


@dataclasses.dataclass(frozen=True)
class CalibratedCamera:
    """One camera as a file gives it.

    Attributes:
        lens: pixels -> rays, any of COLMAP's camera models; the first pixel's centre is (0.5, 0.5).
        rotation: [3, 3] float64, world-to-camera, OpenCV axes.
        translation: [3] float64, world-to-camera, in the file's unit.
    """

    lens: pycolmap.Camera
    rotation: np.ndarray
    translation: np.ndarray


@dataclasses.dataclass(frozen=True)
class Calibration:
    """The cameras of a clip as its files give them.

    Attributes:
        path: the file or folder.
        kind: what it is, for messages.
        views: picture name -> camera; a single one named ``EVERY_FRAME`` is a camera that stands still.
        metric: whether the unit is the metre.
        upright: whether the world's Y axis points up.
        depth: how far the scene's points lie from the cameras, median, in the file's unit; NaN if unknown.
    """

    path: Path
    kind: str
    views: Mapping[str, CalibratedCamera]
    metric: bool
    upright: bool
    depth: float = float("nan")


def open_calibration(cameras: str, name: str, clip: Clip) -> Calibration | None:
    """The calibration that ``ingest.cameras`` names; None where it is a word.

    Args:
        cameras: the setting.
        name: ``ingest.camera_name``, which camera of a rig filmed the clip.
        clip: the footage, for files that do not say the picture's size.

    Raises:
        UserError: nothing there, of no known kind, or damaged.
    """
    from stages.ingest.cameras.colmap import find_model, read_model
    from stages.ingest.cameras.rig import read_qualisys, read_toml_rig

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
    if path.suffix == ".toml":
        return read_toml_rig(path, name)
    if path.name.endswith((".qca.txt", ".qca", ".xml")):
        return read_qualisys(path, name)
    raise UserError(f"{path} is no calibration that is known here: give {_KINDS}")


def pinhole_lens(
    width: int, height: int, focal: tuple[float, float], centre: tuple[float, float]
) -> pycolmap.Camera:
    """A lens without distortion; everything in pixels."""
    return pycolmap.Camera(model="PINHOLE", width=width, height=height, params=[*focal, *centre])


def _read_own(path: Path) -> Calibration:
    """Cameras that this stage, or a script of the user's, wrote."""
    import torch

    views = {}
    for frame, camera in read_cameras(path, torch.float64).items():
        k = camera.intrinsics.numpy()
        lens = pinhole_lens(camera.width, camera.height, (k[0, 0], k[1, 1]), (k[0, 2], k[1, 2]))
        views[str(frame)] = CalibratedCamera(lens, camera.rotation.numpy(), camera.translation.numpy())
    if not views:
        raise UserError(f"{path} holds no camera: give another file, or set ingest.cameras=auto")
    return Calibration(path, "cameras.parquet", views, metric=True, upright=True)


def _read_folder(path: Path, clip: Clip) -> Calibration:
    """``<idx>.json`` files of ``R`` [3, 3], ``t`` [3], ``focal`` [2] and ``princpt`` [2], a file a frame."""
    files = [file for file in sorted(path.glob("*.json")) if not file.name.startswith(".")]
    if not files:
        raise UserError(f"{path} holds neither a COLMAP model nor <frame>.json files: give {_KINDS}")
    views = {file.stem: _read_json_view(file, clip) for file in files}
    return Calibration(path, "cam_params", views, metric=False, upright=False)


def _read_json_view(file: Path, clip: Clip) -> CalibratedCamera:
    value = parse_json(file, "write it again with R [3, 3], t [3], focal [2] and princpt [2]")
    parts = {}
    for key, shape in (("R", (3, 3)), ("t", (3,)), ("focal", (2,)), ("princpt", (2,))):
        try:
            parts[key] = np.array(value[key], np.float64).reshape(shape)
        except (KeyError, TypeError, ValueError):
            raise UserError(f"{file}: '{key}' is not {list(shape)} numbers: write the file again") from None
    check_rotation(parts["R"], f"{file}")
    if parts["focal"].min() <= 0:
        raise UserError(f"{file}: the focal lengths must be positive pixels, not {parts['focal'].tolist()}")
    lens = pinhole_lens(clip.width, clip.height, tuple(parts["focal"]), tuple(parts["princpt"]))
    return CalibratedCamera(lens, parts["R"], parts["t"])


def check_rotation(rotation: np.ndarray, where: str) -> None:
    """UserError where a matrix [3, 3] turns and mirrors, shears or scales."""
    proper = np.isfinite(rotation).all() and np.linalg.det(rotation) > 0
    if not proper or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3):
        raise UserError(f"{where}: the rotation is not one: write it as a rotation matrix, world-to-camera")
