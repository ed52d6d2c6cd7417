"""Checks of generated frames; each refusal has a reason that is counted.

Two looks at the whole sequence come first: if most of its frontal faces are another person's, all of it
is; and what is usual from frame to frame says what flickers.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np
from torch import Tensor

from pipeline.body import PARTS, part_labels, rasterize
from pipeline.clip.camera import Camera
from pipeline.clip.fitted_clip import FittedClip
from pipeline.clip.keypoints import BODY, FACE
from pipeline.metrics.face_identity import identity_distance
from stages.auxiliary.detect_generated import DetectedPicture
from stages.auxiliary.register import MIRRORED, POINTS, TRUSTED
from stages.auxiliary.settings import AuxiliarySettings

NOBODY = "nobody found"
POSE = "keypoints far from the driving pose"
AWAY = "faces the wrong way"
MASK = "mask off the body"
FACE_OF = "face of another person"
FLICKER = "flicker"

FRONTAL = 0.8  # cosine between the head's front and the view from which faces are compared
TOWARDS, BACKWARD = 0.6, -0.5  # cosines beyond which a face has to be seen, or must not be
FACE_SCORE = 0.5  # mean score from which a face counts as seen
TOLERANCE = 0.008  # of the body's height, by which a registration may be off
SMALL_PART = 0.015  # of the body's pixels; a part that shows less is not asked for
LIMBS = ("left_arm", "right_arm", "left_leg", "right_leg", "head", "face", "torso")


@dataclasses.dataclass(frozen=True)
class KeypointMatch:
    """A frame's keypoints against the driving ones.

    Attributes:
        distance: mean over trusted body points, in parts of the driving pose's height; infinite where
            fewer than four are.
        mirrored: whether left and right had to be exchanged: detectors do that with backs.
    """

    distance: float
    mirrored: bool


def match_keypoints(found: np.ndarray, driven: np.ndarray, cosine: float = -1.0) -> KeypointMatch:
    """Compare [133, 3] keypoints with the driving pose's [133, 3].

    Args:
        found: what was detected.
        driven: what was asked for.
        cosine: between the head's front and the view; sides may be exchanged in backs only.
    """
    body, there = found[BODY], driven[BODY]
    inside = driven[BODY, 2] > 0
    if inside.sum() < 4:
        return KeypointMatch(np.inf, False)
    height = max(1.0, float(np.ptp(there[inside, 1])), float(np.ptp(there[inside, 0])))
    straight = _distance(body, there)
    exchanged = _distance(body[MIRRORED[:17]], there) if cosine < 0 else np.inf
    return KeypointMatch(min(straight, exchanged) / height, exchanged < 0.7 * straight)


def _distance(found: np.ndarray, driven: np.ndarray) -> float:
    both = (found[:, 2] >= TRUSTED) & (driven[:, 2] > 0)
    if both.sum() < 4:
        return np.inf
    return float(np.linalg.norm(found[both, :2] - driven[both, :2], axis=1).mean())


def usable_points(found: np.ndarray, matched: KeypointMatch) -> np.ndarray:
    """The points that a registration may use, left and right as the driving pose has them: [23, 3]."""
    points = found[POINTS]
    return points[MIRRORED] if matched.mirrored else points


def wrong_way(look: DetectedPicture, cosine: float) -> bool:
    """True if a face is seen where there should be a back of a head, or none where there should be one."""
    seen = float(look.keypoints[FACE, 2].mean()) >= FACE_SCORE
    return (cosine > TOWARDS and not seen) or (cosine < BACKWARD and seen)


def mask_fits(
    clip: FittedClip, vertices: Tensor, camera: Camera, mask: np.ndarray, settings: AuxiliarySettings
) -> bool:
    """True if a mask covers every limb that should be seen and not much beside the body."""
    raster = rasterize(camera, vertices, clip.body.faces)
    body, person = raster.covered, mask > 127
    area = int(body.sum())
    if not area:
        return False
    if int((person & ~body).sum()) > settings.mask_outside * area:
        return False
    rows = np.flatnonzero(body.any(1))
    reach = 2 * max(1, round(TOLERANCE * (rows[-1] - rows[0] + 1))) + 1
    person = cv2.dilate(person.astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0
    labels = part_labels(clip.body).numpy()[clip.body.faces[:, 0].numpy()]
    parts = np.where(body, labels[np.maximum(raster.face, 0)], -1)
    for name in LIMBS:
        limb = parts == PARTS.index(name)
        if limb.sum() >= SMALL_PART * area and float((~person)[limb].mean()) > settings.mask_missing:
            return False
    return True


def other_faces(
    looks: Sequence[DetectedPicture], cosines: Sequence[float], subject: np.ndarray | None, limit: float
) -> tuple[list[float | None], bool]:
    """Each frame's distance from the subject's face, and whether most of the frontal ones are too far.

    A distance is None where there is no face to compare, or none in the clip.
    """
    distances: list[float | None] = []
    for look, cosine in zip(looks, cosines, strict=True):
        comparable = subject is not None and look.embedding is not None and cosine > FRONTAL
        distances.append(identity_distance(look.embedding, subject) if comparable else None)  # type: ignore[arg-type]
    known = [distance for distance in distances if distance is not None]
    return distances, bool(known) and float(np.median(known)) > limit


def flickering(looks: Sequence[DetectedPicture], times: float) -> list[bool]:
    """Frames that differ from both neighbours by more than ``times`` what is usual."""
    if len(looks) < 4:
        return [False] * len(looks)
    same = len({look.thumb.shape for look in looks}) == 1
    if not same:
        return [False] * len(looks)
    steps = [float(np.abs(a.thumb - b.thumb).mean()) for a, b in zip(looks, looks[1:], strict=False)]
    usual = max(float(np.median(steps)), 1e-6)
    before, after = [steps[0], *steps], [*steps, steps[-1]]
    return [min(pair) > times * usual for pair in zip(before, after, strict=True)]
