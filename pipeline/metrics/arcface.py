"""The paper's face consistency FC (supplement E.2): the cosine of two ArcFace embeddings of 512 numbers.

ArcFace's weights may not be passed on, so the user names an ONNX file; insightface's ``w600k_r50.onnx`` and
``glintr100.onnx`` are such. OpenCV runs it. A face is turned, scaled and moved so that five of its points lie
where ArcFace's training pictures of 112 x 112 have them, the best in the least squares (Umeyama 1991); RGB
from 0 to 255 becomes (x - 127.5) / 127.5, unless the model begins with that itself (Deng et al. 2019 and
insightface's arcface_onnx).

The points are those that were detected in the true frame, for the render as well: both pictures show the same
pose, and a face that a render has in another place is to cost something. The paper detects a face in each.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from pipeline.clip.keypoints import FACE
from pipeline.errors import UserError
from pipeline.metrics.regions import SCORE
from pipeline.untrusted import GIGABYTE, OnnxHeader, bounded_bytes, parse_onnx_header

SIDE, NUMBERS = 112, 512
TEMPLATE = np.array(
    [[38.2946, 51.6963], [73.5318, 51.5014], [56.0252, 71.7366], [41.5493, 92.3655], [70.7299, 92.2041]]
)
"""Pixels: the eye at the picture's left, that at its right, the nose's tip, the mouth's corners likewise."""

_PARTS = (range(36, 42), range(42, 48), (30,), (48,), (54,))  # of the 68 face points
_REMEDY = "name ArcFace's ONNX file, [1, 3, 112, 112] to 512 numbers, or leave evaluate.arcface out"
_FIRST = 8  # operations among which a model's own normalisation stands


class ArcFace:
    """Embeds faces by a model that the user names."""

    def __init__(self, path: Path) -> None:
        """Load the model.

        Raises:
            UserError: the file is missing, or is no model of 112 x 112 pixels to 512 numbers.
        """
        content = bounded_bytes(path, GIGABYTE, _REMEDY)
        try:
            header = parse_onnx_header(content)
        except ValueError as error:
            raise UserError(f"{path} is no ONNX model ({error}): {_REMEDY}") from None
        problem = _mismatch(header)
        if problem:
            raise UserError(f"{path} is not ArcFace's, {problem}: {_REMEDY}")
        self._normalises = {"Sub", "Mul"} <= set(header.operations[:_FIRST])
        try:
            self._network = cv2.dnn.readNetFromONNX(np.frombuffer(content, np.uint8))
            count = self._forward(np.zeros((SIDE, SIDE, 3), np.uint8)).size
        except cv2.error as error:
            raise UserError(
                f"{path} cannot be run by OpenCV ({error.err or error.code}): {_REMEDY}"
            ) from None
        if count != NUMBERS:
            raise UserError(f"{path} is not ArcFace's, it gives {count} numbers: {_REMEDY}")

    def embed(self, image: np.ndarray, points: np.ndarray) -> np.ndarray:
        """The embedding of a face, [512] float64.

        Args:
            image: [H, W, 3] uint8 RGB.
            points: [5, 2], pixels, in the order of ``TEMPLATE``.
        """
        return self._forward(aligned(image, points)).reshape(-1).astype(np.float64)

    def _forward(self, face: np.ndarray) -> np.ndarray:
        mean, scale = (0.0, 1.0) if self._normalises else (127.5, 1 / 127.5)
        self._network.setInput(cv2.dnn.blobFromImage(face, scale, (SIDE, SIDE), (mean, mean, mean)))
        return np.asarray(self._network.forward())


def five_points(whole_body: np.ndarray) -> np.ndarray | None:
    """ArcFace's five points [5, 2] among 133 whole-body points [133, 3]; None where one is not trusted."""
    face = whole_body[FACE]
    parts = [face[list(part)] for part in _PARTS]
    if any(not np.isfinite(part).all() or part[:, 2].min() <= SCORE for part in parts):
        return None
    return np.stack([part[:, :2].mean(0) for part in parts]).astype(np.float64)


def similarity(points: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The turn, scale and shift [2, 3] that brings points [N, 2] nearest to target [N, 2], least squares.

    As complex numbers p and q, less their means, it is q = a p with a = sum(conj(p) q) / sum(|p|^2).

    Raises:
        ValueError: all points lie in one place.
    """
    middle, goal = points.mean(0), target.mean(0)
    p, q = ((one - mean) @ np.array([1, 1j]) for one, mean in ((points, middle), (target, goal)))
    size = float((np.abs(p) ** 2).sum())
    if not size:
        raise ValueError("the points lie in one place")
    a = (p.conj() * q).sum() / size
    turn = np.array([[a.real, -a.imag], [a.imag, a.real]])
    return np.column_stack([turn, goal - turn @ middle])


def aligned(image: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The face of a picture [H, W, 3] uint8 as ArcFace's training pictures have it, [112, 112, 3] uint8.

    Args:
        image: the picture; black is beyond its edges.
        points: [5, 2], pixels, in the order of ``TEMPLATE``.
    """
    matrix = similarity(points, TEMPLATE)
    # A large face is made smaller first, as the interpolation looks at four pixels alone.
    shrink = int(1 / max(np.hypot(*matrix[:, 0]), 1e-9))
    if shrink > 1:
        height, width = (max(1, side // shrink) for side in image.shape[:2])
        scale = np.array([width / image.shape[1], height / image.shape[0]])
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        matrix = similarity((points + 0.5) * scale - 0.5, TEMPLATE)
    return cv2.warpAffine(image, matrix, (SIDE, SIDE), flags=cv2.INTER_LINEAR)


def _mismatch(header: OnnxHeader) -> str:
    """What a model has in the place of ArcFace's input and output; empty where they are its."""
    if len(header.inputs) != 1 or len(header.outputs) != 1:
        return f"it has {len(header.inputs)} inputs and {len(header.outputs)} outputs"
    (taken,), (given,) = header.inputs.values(), header.outputs.values()
    wanted = (3, SIDE, SIDE)
    if len(taken) != 4 or any(side not in (0, want) for side, want in zip(taken[1:], wanted, strict=True)):
        return f"it takes {list(taken)}"
    if given and given[-1] not in (0, NUMBERS):
        return f"it gives {list(given)}"
    return ""
