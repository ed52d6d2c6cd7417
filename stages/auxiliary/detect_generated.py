"""Detections in generated frames: keypoints, a mask, the face's embedding, and a thumbnail for flicker."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import cv2
import numpy as np

from pipeline.clip.boxes import Box
from pipeline.clip.fitted_clip import FittedClip
from pipeline.clip.keypoints import FACE
from pipeline.detection.mediapipe import Estimate, Estimator, resize
from pipeline.detection.wholebody import to_keypoints, to_pixels
from pipeline.metrics.face_identity import FaceRecognizer, medoid
from stages.auxiliary.generator_output import GeneratedPicture

if TYPE_CHECKING:
    from pipeline.run.stage import Context

LONGEST = 1280  # pixels of the longer side that the estimator is shown
THUMB = 64  # pixels, of the small copy's longer side
FACES = 9  # frames of the clip whose faces say who it is
SMALLEST_FACE = 40  # pixels of a face's longer side under which its embedding says nothing
FACE_ROOM = 0.8  # of the face's size, around it, for the face finder
_SURE = 1e-3  # segmentations are kept this far from 0 and 1 before logarithms are taken


@dataclasses.dataclass(frozen=True)
class DetectedPicture:
    """One generated frame.

    Attributes:
        frame: its number.
        keypoints: [133, 3].
        found: whether anybody was found.
        mask: [H, W] uint8.
        embedding: of the face, or None where none was found.
        thumb: [h, w, 3] float32, the person small, on black.
    """

    frame: int
    keypoints: np.ndarray
    found: bool
    mask: np.ndarray
    embedding: np.ndarray | None
    thumb: np.ndarray


class PictureDetector:
    """Detects the person in generated frames, each by itself."""

    def __init__(self, context: Context) -> None:
        """Load the estimator and the face reader."""
        log = context.work / "mediapipe.log"
        self._estimator = Estimator(context.assets["mediapipe"], log, still=True)
        self._faces = FaceRecognizer(context.assets["dlib"], context.assets["identity"])

    def detect(self, picture: GeneratedPicture) -> DetectedPicture:
        """The detections in one frame."""
        height, width = picture.image.shape[:2]
        keypoints, mask, estimate = picture.keypoints, picture.mask, None
        if keypoints is None or mask is None:
            scale = min(1.0, LONGEST / max(width, height))
            estimate = self._estimator.estimate(resize(picture.image, scale))
        if keypoints is None:
            keypoints = _keypoints(picture.frame, estimate, width, height)
        if mask is None:
            mask = fused(estimate, width, height)
        return DetectedPicture(
            frame=picture.frame,
            keypoints=keypoints,
            found=bool((keypoints[:17, 2] > 0.3).sum() >= 4 and (mask > 127).any()),
            mask=mask,
            embedding=self.embedding(picture.image, keypoints),
            thumb=thumbnail(picture.image, mask),
        )

    def embedding(self, image: np.ndarray, keypoints: np.ndarray) -> np.ndarray | None:
        """The embedding of the face that the keypoints show, or None."""
        face = keypoints[FACE]
        face = face[face[:, 2] > 0.3, :2]
        if len(face) < 10:
            return None
        low, high = face.min(0), face.max(0)
        if float((high - low).max()) < SMALLEST_FACE:
            return None
        room = FACE_ROOM * float((high - low).max())
        box = Box(*(int(value) for value in (*(low - room), *(high + room))))
        found = self._faces.read(image, box)
        return found.embedding if found else None

    def subject(self, clip: FittedClip) -> np.ndarray | None:
        """The clip's own face; None where the finder sees none in it that is large enough."""
        points, index = clip.keypoints.whole_body, clip.keypoints.index
        scored = [(points[index(f), FACE, 2].mean(), f) for f in clip.split.train]
        best = [frame for score, frame in sorted(scored, key=lambda one: (-one[0], one[1])) if score > 0.3]
        best = best[:: max(1, len(best) // (4 * FACES))][:FACES]
        found = []
        for frame in best:
            found.append(self.embedding(clip.frame(frame), points[index(frame)]))
        known = [one for one in found if one is not None]
        return medoid(known) if known else None


def fused(estimate: Estimate | None, width: int, height: int) -> np.ndarray:
    """The person's mask from both segmentations: the largest component of their mean in log-odds."""
    if estimate is None:
        return np.zeros((height, width), np.uint8)
    odds = np.zeros((height, width), np.float32)
    for mask in (estimate.body_mask, estimate.selfie_mask):
        safe = np.clip(cv2.resize(mask, (width, height), interpolation=cv2.INTER_LINEAR), _SURE, 1 - _SURE)
        odds += np.log(safe / (1 - safe)) / 2
    alpha = 1 / (1 + np.exp(-odds))
    count, labels, stats, _ = cv2.connectedComponentsWithStats((alpha > 0.5).astype(np.uint8))
    if count > 1:
        largest = 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
        near = cv2.dilate((labels == largest).astype(np.uint8), np.ones((7, 7), np.uint8))
        alpha = alpha * near
    return np.round(255 * alpha).astype(np.uint8)


def thumbnail(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The person on black, ``THUMB`` pixels along the longer side: [h, w, 3] float32."""
    scale = THUMB / max(image.shape[:2])
    person = image.astype(np.float32) * (mask[..., None] / np.float32(255))
    return cv2.resize(person, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def _keypoints(frame: int, estimate: Estimate | None, width: int, height: int) -> np.ndarray:
    if estimate is None:
        return np.zeros((133, 3), np.float32)
    landmarks = [to_pixels(estimate, width, height)]
    return to_keypoints(np.array([frame]), landmarks, width, height, 1.0).whole_body[0]
