"""A fit's own judgement: each frame measured against mask and keypoints, and whether the clip passes.

The numbers and their limits are those of :mod:`pipeline.clip.fit_quality`. A frame that fails is left out of
training and evaluation. A clip of which most frames fail, in every camera, is refused with what was seen
and what to do; ``fit.accept=any`` goes on regardless.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from pipeline.body import PARTS, BodyModel, Identity, Poses, part_labels, posed_vertices
from pipeline.body.rasterize import rasterize
from pipeline.clip.camera import Camera
from pipeline.clip.fit_quality import LEAST_COVERED, MOST_OUTSIDE, MOST_REPROJECTION, FitQuality
from pipeline.clip.frames import read_mask
from pipeline.clip.keypoints import FACE, LEFT_HAND, RIGHT_HAND, Keypoints
from pipeline.clip.records import SHOT_STEP
from pipeline.errors import UserError

LONG_SIDE = 256  # pixels at which body and mask are compared: enough for shares, and cheap
LEAST_PASSED = 0.5  # of the frames of a rig's best camera: below, the clip fails
UPRIGHT = 60.0  # degrees by which the face may be turned in the picture before it is named as the cause
_LISTED = 8  # frames that the log names

_WITNESSES = {
    "left_arm": (7, 9), "right_arm": (8, 10), "left_leg": (13, 15), "right_leg": (14, 16),
    "left_hand": (9,), "right_hand": (10,),
}  # fmt: skip
"""Points of COCO-WholeBody of which one must be trusted for a part of the body to count."""


def measure_fit(
    body: BodyModel,
    identity: Identity,
    poses: Poses,
    keypoints: Keypoints,
    cameras: Mapping[int, Camera],
    error: Tensor | None,
    masks: Path,
    threshold: float,
    advance: Callable[[], object] = lambda: None,
) -> FitQuality:
    """The quality of every frame of a fit; every frame that passes is accepted.

    Args:
        poses: as published, T frames.
        keypoints: the clip's detections; only their scores are asked.
        error: [T, N], reprojection errors in pixels, NaN where masked; None where the poses were not fitted.
        masks: the folder of the person's masks.
        threshold: the score from which a keypoint is trusted.
        advance: called after each frame.
    """
    labels = part_labels(body).numpy()[body.faces[:, 0].numpy()]
    rows = []
    for row, frame in enumerate(poses.frames):
        camera, mask = cameras[frame], read_mask(masks, frame)
        scale = min(1.0, LONG_SIDE / max(camera.width, camera.height))
        small = camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
        with torch.no_grad():
            vertices = posed_vertices(body, identity, poses.pose(frame))
        drawn = rasterize(small, vertices, body.faces)
        shrunk = cv2.resize(mask, (small.width, small.height), interpolation=cv2.INTER_AREA)
        counted = counted_parts(keypoints.whole_body[keypoints.index(frame)], threshold)
        seen = None if error is None else error[row][~error[row].isnan()].numpy()
        off = 0.0 if seen is None or not len(seen) else float(seen.mean())
        size = math.sqrt(float((mask > 127).sum()))
        shares = overlap(drawn.face, shrunk > 127, counted[labels])
        rows.append((0 if seen is None else len(seen), size, off, *shares))
        advance()
    columns = np.array(rows, np.float64).reshape(len(rows), 5).T
    measured = dict(zip(("points", "size", "error", "covered", "outside"), columns, strict=True))
    every = np.ones(len(rows), bool)
    quality = FitQuality(np.array(poses.frames, np.int64), **measured, accepted=every)
    return dataclasses.replace(quality, accepted=quality.passed)


def overlap(face: np.ndarray, mask: np.ndarray, counted: np.ndarray) -> tuple[float, float]:
    """The share of a mask that a body covers, and the share of the body outside of the mask.

    Args:
        face: [H, W] int, the triangle that each pixel sees, -1 for none.
        mask: [H, W] bool.
        counted: [F] bool, the triangles whose pixels outside of the mask count.

    Returns:
        1 and 0 where there is no mask; 0 and 0 where the body is not in the picture.
    """
    body = face >= 0
    if not mask.any():
        return 1.0, 0.0
    asked = body & counted[np.maximum(face, 0)]
    covered = float((body & mask).sum() / mask.sum())
    return covered, float((asked & ~mask).sum() / max(int(asked.sum()), 1))


def counted_parts(points: np.ndarray, threshold: float) -> np.ndarray:
    """The parts of the body that a trusted keypoint speaks for: [133, 3] -> bool, one for each of ``PARTS``.

    Torso and head always count, and hands of which points were found.
    """
    trusted = points[:, 2] >= threshold
    hands = {"left_hand": trusted[LEFT_HAND].any(), "right_hand": trusted[RIGHT_HAND].any()}
    return np.array(
        [
            part not in _WITNESSES or bool(trusted[list(_WITNESSES[part])].any() or hands.get(part, False))
            for part in PARTS
        ]
    )


def decide(quality: FitQuality, name: str, turned: float, accept_any: bool) -> tuple[FitQuality, str]:
    """The quality with its accepted frames, and the log's line on those that are left out.

    Args:
        quality: of all frames.
        name: of the clip, for messages.
        turned: degrees by which faces are turned in the picture, see ``turned_faces``.
        accept_any: accept every frame, whatever is measured.

    Returns:
        The quality and a line; empty where every frame passes.

    Raises:
        UserError: too many frames fail in every camera.
    """
    failed = quality.frames[~quality.passed].tolist()
    if not failed:
        return quality, ""
    total = len(quality.frames)
    if accept_any:
        every = dataclasses.replace(quality, accepted=np.ones(total, bool))
        return every, f"{len(failed)} of {total} frames fail, accepted by fit.accept=any"
    shots = quality.frames // SHOT_STEP
    if max(quality.passed[shots == shot].mean() for shot in np.unique(shots)) < LEAST_PASSED:
        raise UserError(
            f"{name}: the fitted body is not on the person in {len(failed)} of {total} frames: "
            f"{quality.figures()}. {remedy(quality, turned)}, or go on regardless: fit.accept=any"
        )
    named = ", ".join(map(str, failed[:_LISTED])) + (" and more" if len(failed) > _LISTED else "")
    return quality, (
        f"{len(failed)} of {total} frames are left out of training and evaluation, the body is not "
        f"on the person there: {named}"
    )


def remedy(quality: FitQuality, turned: float) -> str:
    """What to do about a clip that failed, by what was seen."""
    if abs(turned) > UPRIGHT:
        return f"Faces are turned by {abs(turned):.0f} degrees in the picture: turn the clip upright"
    tests = {
        "points": float(np.median(quality.reprojection)) / MOST_REPROJECTION,
        "mask": LEAST_COVERED / max(float(np.median(quality.covered)), 1e-3),
        "body": float(np.median(quality.outside)) / MOST_OUTSIDE,
    }
    if max(tests, key=lambda one: tests[one]) == "points":
        return (
            "Detections and body disagree: turn the clip upright if it is not, name the person "
            "(ingest.person=), or give keypoints (ingest.keypoints=FOLDER)"
        )
    return (
        "Give a clip that shows head and shoulders, turned upright, name the person (ingest.person=), "
        "or give keypoints (ingest.keypoints=FOLDER)"
    )


def turned_faces(keypoints: Keypoints, threshold: float) -> float:
    """Degrees by which faces are turned in the picture, in [-180, 180]; 0 for upright, or for no face.

    The median over the frames that show a face, from the chin to the middle of the brows.
    """
    points = keypoints.whole_body[:, FACE]
    seen = (points[..., 2] >= threshold).mean(1) > 0.5
    if seen.mean() <= 0.5:
        return 0.0
    chin, brows = points[seen, 8, :2], points[seen, 17:27, :2].mean(1)
    up = (brows - chin) / np.maximum(np.linalg.norm(brows - chin, axis=1, keepdims=True), 1e-6)
    middle = np.median(up, axis=0)
    return math.degrees(math.atan2(middle[0], -middle[1]))
