"""The lens of the stored frames, its distortion, and frames and points without it."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from pipeline.clip.frames import read_frame, read_mask, write_frame, write_mask
from pipeline.clip.keypoints import Keypoints
from pipeline.detection.wholebody import inside_picture
from pipeline.errors import UserError
from stages.ingest.cameras.calibration import CalibratedCamera, check_rotation, pinhole_lens
from stages.ingest.video import Clip

SAME_SHAPE = 0.02  # by how much the calibrated picture's proportions may differ from the clip's
LEFT_ALONE = 1.0  # pixels of the stored frame; resampling would cost more than a smaller distortion
_LARGEST = 1e12  # of a camera's numbers; beyond it sums overflow
GRID = 33  # points a side at which distortion is measured


def for_stored_frames(
    view: CalibratedCamera, clip: Clip, width: int, height: int, path: Path
) -> CalibratedCamera:
    """A calibrated view with the lens of the stored frames [height, width]: turned as they were, and scaled.

    Args:
        view, path: as calibrated, and its file for messages.
        clip: the footage, upright.
        width, height: of the stored frames, pixels.

    Raises:
        UserError: the calibration is of pictures with other proportions, or of none.
    """
    lens = view.lens
    numbers = (*lens.params, *np.ravel(view.rotation), *np.ravel(view.translation))
    usable = bool((np.abs(numbers) < _LARGEST).all()) and min(lens.focal_length_x, lens.focal_length_y) > 0
    if min(lens.width, lens.height) < 1 or not usable:
        raise UserError(
            f"{path} has a camera of an empty picture, or numbers that no lens has: calibrate again"
        )
    check_rotation(view.rotation, str(path))
    if not _same_shape(lens.width, lens.height, clip) and _same_shape(lens.height, lens.width, clip):
        if clip.orientation.mirrored:
            raise UserError(f"{path} is of the pictures before they were mirrored: calibrate upright ones")
        view = _turned(view, clip.orientation.turns, path)
        lens = view.lens
    if not _same_shape(lens.width, lens.height, clip):
        raise UserError(
            f"{path} was made for pictures of {lens.width}x{lens.height}, {clip.path.name} has "
            f"{clip.width}x{clip.height}: give this footage's calibration, upright and with square pixels"
        )
    scaled = pycolmap.Camera(lens.todict())
    scaled.rescale(width, height)
    return dataclasses.replace(view, lens=scaled)


def without_distortion(lens: pycolmap.Camera) -> pycolmap.Camera:
    """The lens without its distortion: the same focal lengths and centre."""
    focal = (lens.focal_length_x, lens.focal_length_y)
    return pinhole_lens(lens.width, lens.height, focal, (lens.principal_point_x, lens.principal_point_y))


def distortion_pixels(lens: pycolmap.Camera) -> float:
    """The largest distance within the picture between a point and where a pinhole would show it, pixels."""
    if lens.is_undistorted():
        return 0.0
    x, y = np.meshgrid(np.linspace(0, lens.width, GRID), np.linspace(0, lens.height, GRID))
    there = np.stack([x, y], axis=-1).reshape(-1, 2)
    moved = undistort_points(lens, there) - there
    return float(np.nanmax(np.linalg.norm(moved, axis=1))) if np.isfinite(moved).any() else float("inf")


def undistort_points(lens: pycolmap.Camera, points: np.ndarray) -> np.ndarray:
    """Pixels of the lens as pixels of its pinhole, [N, 2] -> [N, 2]; NaN where the lens maps no ray there."""
    rays = np.asarray(lens.cam_from_img(points.astype(np.float64)))
    centre = [lens.principal_point_x, lens.principal_point_y]
    return rays * [lens.focal_length_x, lens.focal_length_y] + centre


def undistort_frames(output: Path, lenses: Mapping[int, pycolmap.Camera], keypoints: Keypoints) -> Keypoints:
    """Take the distortion out of the stored frames and masks, in place, and out of the keypoints.

    Args:
        output: the folder with ``frames`` and ``masks``.
        lenses: frame number -> lens of the stored frame; frames without one are left as they are.
        keypoints: of all frames.

    Returns:
        The keypoints of the straightened frames; points that left the picture have lost their scores.
    """
    maps = functools.cache(_maps)
    names = ("whole_body", "face_mesh", "pose_image", "hands")
    fields = {name: getattr(keypoints, name).copy() for name in names}
    for row, frame in enumerate(keypoints.frames.tolist()):
        lens = lenses.get(frame)
        if lens is None:
            continue
        where = maps(lens.width, lens.height, lens.model_name, tuple(lens.params))
        image = cv2.remap(read_frame(output / "frames", frame), *where, cv2.INTER_CUBIC)
        write_frame(output / "frames", frame, image)
        mask = cv2.remap(read_mask(output / "masks", frame), *where, cv2.INTER_LINEAR)
        write_mask(output / "masks", frame, mask)
        for name, points in fields.items():
            _straighten(points[row], lens, keeps_outside=name == "pose_image")
    return dataclasses.replace(keypoints, **fields)


def _straighten(points: np.ndarray, lens: pycolmap.Camera, keeps_outside: bool) -> None:
    """Points [..., K] of x, y, ..., score, changed in place; what was not found, all zero, stays so."""
    flat = points.reshape(-1, points.shape[-1])
    found = flat[:, -1] > 0
    flat[found, :2] = undistort_points(lens, flat[found, :2])
    lost = found & ~np.isfinite(flat).all(1)
    if not keeps_outside:
        lost |= found & (inside_picture(flat, np.array([lens.width, lens.height])) == 0)
    flat[lost] = 0


def _maps(width: int, height: int, model: str, params: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """The place in the lens's picture of each pixel of the pinhole's, for ``cv2.remap``, two [H, W]."""
    lens = pycolmap.Camera(model=model, width=width, height=height, params=list(params))
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    across = (x - lens.principal_point_x) / lens.focal_length_x
    down = (y - lens.principal_point_y) / lens.focal_length_y
    rays = np.stack([across, down, np.ones_like(x)], axis=-1)
    pixels = np.asarray(lens.img_from_cam(rays.reshape(-1, 3))).reshape(height, width, 2)
    pixels = np.nan_to_num(pixels.astype(np.float32) - 0.5, nan=-1e4)
    return np.ascontiguousarray(pixels[..., 0]), np.ascontiguousarray(pixels[..., 1])


def _same_shape(width: int, height: int, clip: Clip) -> bool:
    return abs(width / height * clip.height / clip.width - 1) <= SAME_SHAPE


def _turned(view: CalibratedCamera, turns: int, path: Path) -> CalibratedCamera:
    """The view of the picture turned counter-clockwise by ``turns`` quarters, as the clip's frames were."""
    if turns % 2 == 0:
        return view
    if not view.lens.is_undistorted():
        raise UserError(f"{path} has a distorted lens of pictures on their side: calibrate upright ones")
    width, height = view.lens.width, view.lens.height
    fx, fy = view.lens.focal_length_x, view.lens.focal_length_y
    x, y = view.lens.principal_point_x, view.lens.principal_point_y
    centre = (y, width - x) if turns % 4 == 1 else (height - y, x)
    sign = 1.0 if turns % 4 == 1 else -1.0
    turn = np.array([[0, sign, 0], [-sign, 0, 0], [0, 0, 1.0]])
    lens = pinhole_lens(height, width, (fy, fx), centre)
    return CalibratedCamera(lens, turn @ view.rotation, turn @ view.translation)
