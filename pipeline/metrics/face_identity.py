"""Recognition of faces by dlib's 128-number embedding (the paper's face consistency, supplement E.2).

The paper compares ArcFace embeddings; dlib's stands in for it, since its weights can be had. Two faces
of one person lie at most about 0.5 apart and those of two people at least about 0.66; cosines are
compressed (0.97 and 0.83), so both are reported.

dlib is an asset put on the path, as MediaPipe is. Only the two model files that data/assets.toml pins
are given to its own reader.
"""

from __future__ import annotations

import dataclasses
import importlib
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pipeline.clip.boxes import Box
from pipeline.errors import UserError

ASSETS = ("dlib", "identity")
_RESNET = "dlib_face_recognition_resnet_model_v1.dat"
_POINTS = "shape_predictor_5_face_landmarks.dat"
_SMALLEST = 80  # pixels; the finder knows no smaller face, so pictures are enlarged until it does
_LARGEST_PICTURE = 1200  # pixels of the longer side that the finder is shown


@dataclasses.dataclass(frozen=True)
class RecognizedFace:
    """A face that was found, and its embedding.

    Attributes:
        box: of the picture.
        embedding: [128] float64; its length is about 1.4.
    """

    box: Box
    embedding: np.ndarray


class FaceRecognizer:
    """Finds the largest face in a picture and embeds it."""

    def __init__(self, dlib_folder: Path, models: Path) -> None:
        """Load the models.

        Args:
            dlib_folder: the folder of the asset ``dlib``.
            models: the folder of the asset ``identity``.

        Raises:
            UserError: dlib cannot be imported here, or a model file is missing.
        """
        dlib = _load(dlib_folder)
        for name in (_RESNET, _POINTS):
            if not (models / name).is_file():
                raise UserError(f"{models / name} is missing: doit run assets:identity")
        self._dlib: Any = dlib
        self._find = dlib.get_frontal_face_detector()
        self._align = dlib.shape_predictor(str(models / _POINTS))
        self._embed = dlib.face_recognition_model_v1(str(models / _RESNET))

    def read(self, image: np.ndarray, box: Box | None = None) -> RecognizedFace | None:
        """The face in ``image`` [H, W, 3] uint8 RGB, or None where the finder sees none.

        Args:
            image: the picture.
            box: where to look, so that small faces are enlarged enough; it may reach out of the picture.
        """
        box = box or Box.whole(image)
        left, top = max(0, box.left), max(0, box.top)
        part = image[top : max(box.bottom, top), left : max(box.right, left)]
        if min(part.shape[:2]) < 8:
            return None
        scale = _scale(part.shape[1], part.shape[0])
        part = np.ascontiguousarray(cv2.resize(part, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC))
        found = self._find(part, 0)
        if not len(found):
            return None
        face = max(found, key=lambda one: one.width() * one.height())
        embedding = np.array(self._embed.compute_face_descriptor(part, self._align(part, face)))
        sides = (face.left(), face.top(), face.right(), face.bottom())
        corner = (left, top, left, top)
        placed = (round(side / scale) + start for side, start in zip(sides, corner, strict=True))
        return RecognizedFace(Box(*placed), embedding)


def identity_distance(first: np.ndarray, second: np.ndarray) -> float:
    """The Euclidean distance of two embeddings; beyond 0.6 it is probably another person."""
    return float(np.linalg.norm(np.asarray(first) - np.asarray(second)))


def identity_cosine(first: np.ndarray, second: np.ndarray) -> float:
    """The cosine of the angle between two embeddings, the form in which the paper reports FC."""
    first, second = np.asarray(first, np.float64), np.asarray(second, np.float64)
    length = np.linalg.norm(first) * np.linalg.norm(second)
    if not length:
        raise ValueError("an embedding of length 0 has no direction")
    return float(first @ second / length)


def medoid(embeddings: list[np.ndarray]) -> np.ndarray:
    """The embedding with the least summed distance to the others: a real one, robust to a few bad faces.

    Raises:
        ValueError: there are none.
    """
    if not embeddings:
        raise ValueError("there are no embeddings to choose from")
    stack = np.stack(embeddings)
    return stack[np.linalg.norm(stack[:, None] - stack[None], axis=-1).sum(1).argmin()]


def _scale(width: int, height: int) -> float:
    """The factor by which a picture is resized for the finder, which knows no face under 80 pixels."""
    return min(max(1.0, 3 * _SMALLEST / min(width, height)), _LARGEST_PICTURE / max(width, height))


def _load(folder: Path) -> Any:
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))
    try:
        return importlib.import_module("dlib")
    except ImportError as error:
        raise UserError(
            f"{folder} cannot be loaded as dlib ({error}): fetch it again (doit run assets:dlib), "
            "with Python 3.11 or 3.12"
        ) from None
