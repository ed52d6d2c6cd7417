"""MediaPipe 0.10.21: one person's landmarks and soft segmentations.

The package is an asset, not a dependency: its folder is put on the path when an estimator is made.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pipeline.clip.boxes import Box
from pipeline.errors import UserError

BOX_LEVEL, BOX_MARGIN = 0.3, 0.12  # the person's box: where the pose mask exceeds this, and this much around
HEAVY_MODEL = "pose_landmark_heavy.tflite"
BLANK = np.zeros((64, 64, 3), np.uint8)


@dataclasses.dataclass(frozen=True)
class Estimate:
    """MediaPipe's landmarks and masks of one picture; coordinates as fractions of the picture's size.

    z has the scale of x, smaller nearer to the camera. What was not found is None.

    Attributes:
        pose: [33, 4], x, y, z, visibility.
        world: [33, 4], metres about the hips, visibility.
        face: [478, 3], x, y, z.
        hands: left and right, [21, 3] each.
        body_mask: [H, W] float32 in [0, 1], the pose model's segmentation.
        selfie_mask: [H, W] float32 in [0, 1], the segmentation made for heads and upper bodies,
            of the person's box; 0 outside it.
    """

    pose: np.ndarray
    world: np.ndarray
    face: np.ndarray | None
    hands: tuple[np.ndarray | None, np.ndarray | None]
    body_mask: np.ndarray
    selfie_mask: np.ndarray

    def placed(self, box: Box, width: int, height: int) -> Estimate:
        """The estimate of a whole picture, of which this is that of a box.

        Args:
            box: in the picture, inside it.
            width, height: of the picture, in pixels of the box.
        """
        scale = self.body_mask.shape[1] / box.width
        size = (max(1, round(height * scale)), max(1, round(width * scale)))
        top, left = min(round(box.top * scale), size[0] - 1), min(round(box.left * scale), size[1] - 1)

        def points(found: np.ndarray | None) -> np.ndarray | None:
            if found is None:
                return None
            moved = found.copy()
            moved[:, 0] = (box.left + found[:, 0] * box.width) / width
            moved[:, 1] = (box.top + found[:, 1] * box.height) / height
            moved[:, 2] = found[:, 2] * box.width / width
            return moved

        def mask(found: np.ndarray) -> np.ndarray:
            whole = np.zeros(size, np.float32)
            part = found[: size[0] - top, : size[1] - left]
            whole[top : top + part.shape[0], left : left + part.shape[1]] = part
            return whole

        left_hand, right_hand = (points(hand) for hand in self.hands)
        pose = points(self.pose)
        assert pose is not None
        masks = mask(self.body_mask), mask(self.selfie_mask)
        return Estimate(pose, self.world, points(self.face), (left_hand, right_hand), *masks)


class Estimator:
    """Follows one person through a clip; pictures must come in order, unless each stands for itself."""

    def __init__(self, asset: Path, native_log: Path, still: bool = False, heavy: Path | None = None) -> None:
        """Load the models from the asset's folder; UserError if they cannot be loaded.

        Args:
            asset: the folder that holds ``mediapipe/``.
            native_log: where the models' native code may write its remarks.
            still: look at every picture as if it were the first.
            heavy: the folder of the heavy pose model, an asset of its own; None takes the package's own.
        """
        solutions = load_mediapipe(asset)
        if heavy is not None:
            place_heavy_model(asset, heavy)
        self._native_log = native_log
        with native_errors_to(native_log):
            self._holistic = solutions.holistic.Holistic(
                static_image_mode=still,
                model_complexity=1 if heavy is None else 2,
                enable_segmentation=True,
                smooth_segmentation=False,  # masks are made steady later, along the motion
                refine_face_landmarks=True,
            )
            self._selfie = solutions.selfie_segmentation.SelfieSegmentation(model_selection=0)
            self._holistic.process(BLANK), self._selfie.process(BLANK)  # the models finish loading here

    def estimate(self, image: np.ndarray) -> Estimate | None:
        """The person in ``image`` [H, W, 3] uint8 RGB, or None where there is none."""
        with native_errors_to(self._native_log):
            found = self._holistic.process(image)
        if found.pose_landmarks is None or found.segmentation_mask is None:
            return None
        world = _array(found.pose_world_landmarks, visibility=True)
        pose = _array(found.pose_landmarks, visibility=True)
        if pose is None or world is None:
            return None
        hands = (_array(found.left_hand_landmarks), _array(found.right_hand_landmarks))
        body = np.clip(found.segmentation_mask, 0, 1)
        return Estimate(pose, world, _array(found.face_landmarks), hands, body, self._segment(image, body))

    def _segment(self, image: np.ndarray, body: np.ndarray) -> np.ndarray:
        """The selfie segmentation of the person's box, where its 256 pixels go further than on the whole."""
        rows, columns = (np.flatnonzero((body > BOX_LEVEL).any(axis)) for axis in (1, 0))
        whole = np.zeros_like(body)
        if not len(rows):
            return whole
        box = []
        for places, length in ((rows, body.shape[0]), (columns, body.shape[1])):
            margin = round(BOX_MARGIN * (places[-1] + 1 - places[0]))
            box.append(slice(max(0, places[0] - margin), min(length, places[-1] + 1 + margin)))
        part = np.ascontiguousarray(image[box[0], box[1]])
        with native_errors_to(self._native_log):
            whole[box[0], box[1]] = np.clip(self._selfie.process(part).segmentation_mask, 0, 1)
        return whole


def place_heavy_model(asset: Path, heavy: Path) -> None:
    """Copies the heavy pose model to where MediaPipe looks for it, beside those of its package.

    Raises:
        UserError: the asset's folder cannot be written.
    """
    source, target = heavy / HEAVY_MODEL, asset / "mediapipe" / "modules" / "pose_landmark" / HEAVY_MODEL
    if target.is_file() and target.stat().st_size == source.stat().st_size:
        return
    half = target.with_name(f".{HEAVY_MODEL}.{os.getpid()}")
    try:
        shutil.copyfile(source, half)
        half.replace(target)  # at once: another process may be looking
    except OSError as error:
        with contextlib.suppress(OSError):
            half.unlink(missing_ok=True)
        raise UserError(f"{target}: cannot be written ({error}); or set ingest.pose_model=full") from None


class FaceFinder:
    """Looks for faces in single pictures."""

    def __init__(self, asset: Path, native_log: Path) -> None:
        """Load the model from the asset's folder; the arguments are those of ``Estimator``."""
        solutions = load_mediapipe(asset)
        self._native_log = native_log
        with native_errors_to(native_log):
            self._faces = solutions.face_detection.FaceDetection(model_selection=1)

    def __call__(self, image: np.ndarray) -> bool:
        """True where [H, W, 3] uint8 RGB shows a face."""
        with native_errors_to(self._native_log):
            return bool(self._faces.process(image).detections)


def estimator_scale(width: int, height: int, short_side: int, long_side: int) -> float:
    """The factor by which a picture is resized for the estimator: at most 3, below 1 for large ones."""
    if max(width, height) > long_side:
        return long_side / max(width, height)
    most = min(3, max(1, long_side // max(width, height)))
    return float(np.clip(round(short_side / min(width, height)), 1, most))


def resize(image: np.ndarray, scale: float) -> np.ndarray:
    """``image`` resized by ``scale``, averaged where it shrinks and interpolated where it grows."""
    if scale == 1:
        return image
    size = tuple(max(1, round(side * scale)) for side in image.shape[1::-1])
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)


def load_mediapipe(asset: Path) -> Any:
    """``mediapipe.solutions`` from the asset's folder."""
    os.environ.setdefault("GLOG_minloglevel", "3")
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    if str(asset) not in sys.path:
        sys.path.insert(0, str(asset))
    try:
        return importlib.import_module("mediapipe.python.solutions")
    except ImportError as error:
        raise UserError(
            f"{asset} cannot be loaded as MediaPipe ({error}): fetch it again (doit run assets:mediapipe), "
            "with Python 3.11 or 3.12"
        ) from None


@contextlib.contextmanager
def native_errors_to(log: Path) -> Iterator[None]:
    """Send what native code prints to the terminal's error stream to the file ``log`` instead."""
    sys.stderr.flush()
    kept, target = os.dup(2), os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    try:
        os.dup2(target, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(target)


def _array(landmarks: Any, visibility: bool = False) -> np.ndarray | None:
    if landmarks is None:
        return None
    points = [(p.x, p.y, p.z, p.visibility) if visibility else (p.x, p.y, p.z) for p in landmarks.landmark]
    array = np.array(points, np.float32)
    return array if np.isfinite(array).all() else None
