"""Hands and feet that a mask lost: where the detector saw them, the colours say which pixels are theirs.

Segmentations work on 256 pixels of a person, and a hand that hangs beside dark furniture is a few of these.
Around each detected hand and foot the colours of what is surely the person and of what surely is not are
learnt, and the pixels between are divided by a cut (GrabCut, Rother et al. 2004). A part only gains: what the
mask has is kept, and where the picture contradicts the detector, the cut gives the part nothing.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import cv2
import numpy as np

from pipeline.clip.keypoints import LEFT_HAND, RIGHT_HAND

SEEN = 0.5  # score of a point that says where a part is
WIDE = 2.2  # times the bones' thickness: how far from them a part may reach
CORE = 0.5  # times their thickness: what is surely the part, where the mask does not object
OBJECTS, SURE = 0.15, 0.95  # alpha under which the mask objects to a core, and from which it is sure
ELSEWHERE = 0.1  # alpha under which a pixel beyond a part's reach is background
FEWEST = 10  # pixels of either kind that colours can be learnt from
ROUNDS = 2  # of GrabCut
SOFT = 0.8  # pixels by which the cut's edge is blurred

_ARMS, _FEET = ((7, 9), (8, 10)), ((15, 17, 18, 19), (16, 20, 21, 22))  # elbow, wrist; ankle, toes, heel
_FINGERS = tuple((a, a + 1) for first in (1, 5, 9, 13, 17) for a in range(first, first + 3))
_HAND = (*_FINGERS, (0, 1), (0, 5), (5, 9), (9, 13), (13, 17), (0, 17))
_PALM = (0, 1, 5, 9, 13, 17)
_HAND_WIDTH, _FOOT_WIDTH, _ARM_WIDTH = 0.22, 0.25, 0.14  # of palm, foot and forearm
_REACHES = 0.45  # of the forearm, how far beyond the wrist a hand that was not found reaches


@dataclasses.dataclass(frozen=True)
class BodyPart:
    """A hand or a foot in the picture.

    Attributes:
        points: [K, 2], pixels.
        bones: pairs of points.
        flat: points whose hull is part of it.
        thickness: pixels, of the bones.
    """

    points: np.ndarray
    bones: tuple[tuple[int, int], ...]
    flat: tuple[int, ...]
    thickness: float

    def drawn(self, shape: tuple[int, int], scale: float) -> np.ndarray:
        """Where it lies, with bones ``scale`` times as thick: [H, W] bool."""
        picture = np.zeros(shape, np.uint8)
        places = np.round(np.clip(self.points, -1e4, 1e4)).astype(np.int32)
        thick = max(1, round(self.thickness * scale))
        for a, b in self.bones:
            cv2.line(picture, places[a].tolist(), places[b].tolist(), 255, thick)
        if len(self.flat) > 2:
            cv2.fillConvexPoly(picture, cv2.convexHull(places[list(self.flat)]), 255)
        return picture > 0


def body_parts(points: np.ndarray) -> Iterator[BodyPart]:
    """The hands and feet that 133 points [133, 3], pixels and a score, show.

    A hand without points of its own goes on from the forearm.
    """
    xy, seen = points[:, :2], points[:, 2] >= SEEN
    for rows, (elbow, wrist) in zip((LEFT_HAND, RIGHT_HAND), _ARMS, strict=True):
        hand = xy[rows]
        if seen[rows].mean() > 0.5:
            yield BodyPart(hand, _HAND, _PALM, _HAND_WIDTH * float(np.linalg.norm(hand[9] - hand[0])))
        elif seen[elbow] and seen[wrist]:
            along = xy[wrist] - xy[elbow]
            ends = np.stack([xy[wrist], xy[wrist] + _REACHES * along])
            yield BodyPart(ends, ((0, 1),), (), _ARM_WIDTH * float(np.linalg.norm(along)))
    for foot in _FEET:
        if seen[list(foot)].all():
            ends = xy[list(foot)]
            length = float(np.linalg.norm(ends[1] - ends[3]))
            yield BodyPart(ends, ((0, 1), (0, 3), (1, 3), (2, 3), (1, 2)), (0, 1, 2, 3), _FOOT_WIDTH * length)


def complete_parts(alpha: np.ndarray, image: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The mask with hands and feet that it lacked, [H, W] float32 in [0, 1].

    Args:
        alpha: [H, W] in [0, 1].
        image: [H, W, 3] uint8.
        points: [133, 3], COCO-WholeBody's, pixels and a score.
    """
    whole = alpha.astype(np.float32)
    for part in body_parts(points):
        whole = _complete(whole, image, part)
    return whole


def _complete(alpha: np.ndarray, image: np.ndarray, part: BodyPart) -> np.ndarray:
    reach = cv2.dilate(part.drawn(alpha.shape, WIDE).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    rows, columns = np.flatnonzero(reach.any(1)), np.flatnonzero(reach.any(0))
    if not len(rows):
        return alpha
    margin = int(0.5 * max(np.ptp(rows), np.ptp(columns))) + 6
    box = tuple(
        slice(max(0, int(places[0]) - margin), int(places[-1]) + margin) for places in (rows, columns)
    )
    own, near, core = alpha[box], reach[box], part.drawn(alpha.shape, CORE)[box]
    label = np.where(own > 0.5, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    label[near & (own > 2 * ELSEWHERE)] = cv2.GC_PR_FGD
    label[core] = cv2.GC_PR_FGD
    label[(own < ELSEWHERE) & ~near] = cv2.GC_BGD
    label[(own > SURE) | (core & (own > OBJECTS))] = cv2.GC_FGD
    if min((label == cv2.GC_BGD).sum(), (label == cv2.GC_FGD).sum()) < FEWEST:
        return alpha
    cv2.setRNGSeed(0)  # its clusters start at random
    models = np.zeros((1, 65)), np.zeros((1, 65))
    no_box = (0, 0, 0, 0)  # the labels say where to begin
    cv2.grabCut(np.ascontiguousarray(image[box]), label, no_box, *models, ROUNDS, cv2.GC_INIT_WITH_MASK)
    found = np.isin(label, (cv2.GC_FGD, cv2.GC_PR_FGD)).astype(np.float32)
    gained = np.where(near, np.maximum(own, cv2.GaussianBlur(found, (0, 0), SOFT)), own)
    whole = alpha.copy()
    whole[box] = gained
    return whole
