"""Calibrated rigs of cameras that stand still: files of Qualisys, and TOML of Pose2Sim, Anipose, Caliscope.

All have a world whose Z axis points up; here X stays, Y becomes up and Z what was -Y, so that several
cameras of one rig share one world.
"""

from __future__ import annotations

import tomllib
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap

from pipeline.errors import UserError
from pipeline.files.text_encoding import decode_text
from pipeline.untrusted import bounded_bytes
from stages.ingest.cameras.calibration import EVERY_FRAME, CalibratedCamera, Calibration, check_rotation

_Z_UP_TO_Y_UP = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])  # coordinates there -> coordinates here
_FIXED_POINT = 64.0  # Qualisys writes pixels in 64ths
_MILLIMETRES = 1e-3


def read_rig(path: Path, name: str) -> Calibration:
    """One camera of a rig's calibration, Pose2Sim's where the file is TOML, else Qualisys'.

    Args:
        path: the file.
        name: which camera; may be empty where there is one only.

    Raises:
        UserError: not such a file, damaged, or no camera of that name.
    """
    cameras = _read_cameras(path)
    camera = cameras[_choose(path, name, list(cameras))]
    return _pose2sim(path, camera) if path.suffix == ".toml" else _qualisys(path, camera)


def camera_names(path: Path) -> list[str]:
    """The cameras of a rig's calibration, in its order; UserError where it is malformed."""
    return list(_read_cameras(path))


def _read_cameras(path: Path) -> dict[str, Any]:
    """Name -> TOML table or XML element."""
    content = bounded_bytes(path, 16 << 20, "calibrate again")
    try:
        if path.suffix != ".toml":
            return {
                one.get("serial", ""): one for one in ElementTree.fromstring(content).findall(".//camera")
            }
        tables = tomllib.loads(decode_text(content))
    except (tomllib.TOMLDecodeError, ElementTree.ParseError, ValueError) as error:
        kind = "Pose2Sim" if path.suffix == ".toml" else "Qualisys"
        raise UserError(f"{path} is no {kind} calibration ({error}): export it again") from None
    return {str(one.get("name", key)): one for key, one in _camera_tables(tables) if not one.get("ignore")}


def _camera_tables(tables: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """The cameras with their keys: ``[cam_01]``, ``[cameras.0]`` or ``[[cameras]]``."""
    for key, one in tables.items():
        if isinstance(one, dict) and "matrix" in one:
            yield key, one
        elif isinstance(one, dict):
            yield from _camera_tables(one)
        elif isinstance(one, list) and all(isinstance(part, dict) for part in one):
            yield from _camera_tables({str(place): part for place, part in enumerate(one)})


def _qualisys(path: Path, camera: ElementTree.Element) -> Calibration:
    """A camera of Qualisys' XML.

    The rotation is camera-to-world by columns of axes that look along -Z with Y up; the translation is the
    camera's place in millimetres. Focal lengths and centre are in 1/64 pixel; distortion is OpenCV's.
    """
    try:
        place, lens, frame = (_numbers(camera, part) for part in ("transform", "intrinsic", "fov_video"))
        axes = np.array([[place[f"r{row}{column}"] for column in (1, 2, 3)] for row in (1, 2, 3)])
        centre = np.array([place[axis] for axis in "xyz"]) * _MILLIMETRES
        focal = [lens[f"focalLength{axis}"] / _FIXED_POINT for axis in "UV"]
        middle = [lens[f"centerPoint{a}"] / _FIXED_POINT - frame[b] for a, b in (("U", "left"), ("V", "top"))]
        bend = [lens[key] for key in ("radialDistortion1", "radialDistortion2",
                                      "tangentalDistortion1", "tangentalDistortion2")]  # fmt: skip
        size = [int(frame[b] - frame[a]) + 1 for a, b in (("left", "right"), ("top", "bottom"))]
    except KeyError as error:
        raise UserError(
            f"{path}: the camera '{camera.get('serial')}' has no {error}: export it again"
        ) from None
    rotation = np.diag([1.0, -1.0, -1.0]) @ axes
    check_rotation(rotation, f"{path}, camera '{camera.get('serial')}'")
    return _standing(path, "Qualisys", _lens(size, focal, middle, bend), rotation, -rotation @ centre)


def _pose2sim(path: Path, table: dict[str, Any]) -> Calibration:
    """A camera of a TOML file: size, matrix, distortions, rotation as a vector or a matrix, metres."""
    try:
        matrix = np.array(table["matrix"], np.float64).reshape(3, 3)
        turn = np.array(table["rotation"], np.float64)
        rotation = turn.reshape(3, 3) if turn.size == 9 else cv2.Rodrigues(turn.reshape(3))[0]
        translation = np.array(table["translation"], np.float64).reshape(3)
        bend = np.array(table.get("distortions", [0.0] * 4), np.float64).reshape(-1)
        size = [int(side) for side in np.array(table["size"]).reshape(2)]
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise UserError(f"{path}: a camera's table is not complete ({error}): export it again") from None
    if table.get("fisheye"):
        raise UserError(f"{path}: fisheye lenses are not known here: give undistorted footage")
    if len(bend) > 8 and np.abs(bend[8:]).max() > 0:
        raise UserError(
            f"{path}: distortions beyond k6 (thin prism, tilt) are not known here: calibrate without"
        )
    check_rotation(rotation, str(path))
    # OpenCV counts from the centre of the first pixel.
    lens = _lens(size, [matrix[0, 0], matrix[1, 1]], [matrix[0, 2] + 0.5, matrix[1, 2] + 0.5], list(bend[:8]))
    return _standing(path, "Pose2Sim", lens, rotation, translation)


def _standing(
    path: Path, kind: str, lens: pycolmap.Camera, rotation: np.ndarray, translation: np.ndarray
) -> Calibration:
    view = CalibratedCamera(lens, rotation @ _Z_UP_TO_Y_UP.T, translation)
    return Calibration(path, kind, {EVERY_FRAME: view}, metric=True, upright=True)


def _lens(size: list[int], focal: list[float], middle: list[float], bend: list[float]) -> pycolmap.Camera:
    """A lens with OpenCV's distortions k1, k2, p1, p2 and, where there are more, k3 to k6."""
    bend = [*bend, *[0.0] * 8][:8]
    model = "FULL_OPENCV" if any(bend[4:]) else "OPENCV"
    bend = bend if any(bend[4:]) else bend[:4]
    return pycolmap.Camera(model=model, width=size[0], height=size[1], params=[*focal, *middle, *bend])


def _choose(path: Path, name: str, names: list[str]) -> str:
    """The camera that is meant; UserError where it is not said or not there."""
    if not names:
        raise UserError(f"{path} holds no camera: export the calibration again")
    if name in names:
        return name
    if not name and len(names) == 1:
        return names[0]
    what = f"has no camera '{name}'" if name else "holds several cameras"
    raise UserError(f"{path} {what}: set ingest.camera_name to one of {', '.join(sorted(names))}")


def _numbers(camera: ElementTree.Element, part: str) -> dict[str, float]:
    """The numeric attributes of a part of a camera; KeyError where the part is not there."""
    element = camera.find(part)
    if element is None:
        raise KeyError(part)
    numbers: dict[str, Any] = {}
    for key, text in element.attrib.items():
        try:
            numbers[key] = float(text)
        except ValueError:
            continue
    return numbers
