"""The one picture of the person that a generator is given: which frame, and how it is made whole.

A frame is better the more it faces the camera, the sharper it is, the more of face and hands it shows
and the more a confident mask covers of the fitted body. The chosen frame is moved and scaled so that its
person stands where the turn's skeleton stands; what the clip never framed is filled with the textured
body, which is a guess, but one of the right size in the right place.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import torch

from pipeline.body import Landmarks, locate, pose_frame
from pipeline.clip.camera import Camera, project
from pipeline.clip.fitted_clip import FittedClip
from pipeline.clip.keypoints import FACE, LEFT_HAND, RIGHT_HAND
from pipeline.texture import FineSurface, paint
from stages.auxiliary.crop import Framing, pixel_map
from stages.auxiliary.skeleton import driven_keypoints, head_facing
from stages.auxiliary.turntable_motion import TurntableMotion

LOOKED_AT = 60  # frames that are scored
WEIGHTS = {"facing": 2.0, "sharpness": 1.0, "face": 1.0, "hands": 0.5, "mask": 1.0}
_ANCHORS = (0, 5, 6, 11, 12)  # nose, shoulders and hips, which set place and size
_FEATHER = 0.01  # of the picture's height, over which the clip's picture runs into the guess


@dataclasses.dataclass(frozen=True)
class Score:
    """The reasons for which a frame is chosen; every part lies in [0, 1].

    Attributes:
        frame: its number.
        facing: the cosine between the head's front and the view, cut at 0.
        sharpness: of the person, in parts of the sharpest frame's.
        face, hands: mean scores of their keypoints.
        mask: how sure the mask is: the share of it that is wholly the person's.
    """

    frame: int
    facing: float
    sharpness: float
    face: float
    hands: float
    mask: float

    @property
    def total(self) -> float:
        """The weighted mean of the parts."""
        return sum(weight * getattr(self, name) for name, weight in WEIGHTS.items()) / sum(WEIGHTS.values())


def score_frames(clip: FittedClip) -> list[Score]:
    """Score some training frames, best first."""
    looks = []
    for frame in clip.spread(LOOKED_AT):
        image, mask = clip.colors(frame), clip.mask(frame)
        points = clip.keypoints.whole_body[clip.keypoints.index(frame)]
        facing = max(
            0.0, head_facing(clip, clip.pose(frame), clip.camera(frame), clip.vertices(frame).mean(0))
        )
        looks.append((frame, facing, sharpness(image, mask), points, mask_confidence(mask)))
    sharpest = max(max(look[2] for look in looks), 1e-9)
    scores = [
        Score(
            frame=frame,
            facing=turned,
            sharpness=sharp / sharpest,
            face=float(points[FACE, 2].mean()),
            hands=float((points[LEFT_HAND, 2].mean() + points[RIGHT_HAND, 2].mean()) / 2),
            mask=sure,
        )
        for frame, turned, sharp, points, sure in looks
    ]
    return sorted(scores, key=lambda score: (-score.total, score.frame))


def sharpness(image: np.ndarray, mask: np.ndarray) -> float:
    """The mean squared Laplacian of the person's inside, 0 where there is none."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    inside = cv2.erode((mask > 250).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    return float(np.square(cv2.Laplacian(grey, cv2.CV_32F))[inside].mean()) if inside.any() else 0.0


def mask_confidence(mask: np.ndarray) -> float:
    """The share of a mask's pixels that are wholly the person's."""
    touched = mask > 8
    return float((mask[touched] > 247).mean()) if touched.any() else 0.0


@dataclasses.dataclass(frozen=True)
class Reference:
    """The picture of the person that a generator is given.

    Attributes:
        image: [H, W, 3] uint8 RGB, of the turn's camera's size.
        keypoints: [133, 3], of the person in it.
        score: why this frame.
        padded: whether part of the body was guessed.
    """

    image: np.ndarray
    keypoints: np.ndarray
    score: Score
    padded: bool


def make_reference(
    clip: FittedClip,
    turn: TurntableMotion,
    landmarks: Landmarks,
    framing: Framing,
    surface: FineSurface,
    colors: np.ndarray,  # [N, 3]
) -> Reference:
    """The best frame, its person where the turn's stands, made whole."""
    score = score_frames(clip)[0]
    frame = score.frame
    vertices, joints = pose_frame(clip.body, clip.identity, clip.pose(frame))
    camera = moved_camera(clip, turn, landmarks, frame, joints, vertices)
    width, height = camera.width, camera.height
    image, mask = clip.colors(frame), clip.mask(frame)
    change = _change(clip.cameras[frame], camera)
    warped = cv2.warpAffine(
        image, change, (width, height), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )
    alpha = cv2.warpAffine(mask, change, (width, height), flags=cv2.INTER_LINEAR) / np.float32(255)
    covered = _filmed(image.shape[:2], change, (width, height))
    guess, body, _ = paint(camera, surface, vertices, colors)
    plain = _backdrop(image, mask)
    behind = plain + (guess - plain) * (body[..., None] / np.float32(255)) * (1 - covered)[..., None]
    person = (alpha * covered)[..., None]
    picture = behind + (warped - behind) * person
    keypoints = driven_keypoints(clip, landmarks, joints, vertices, camera)
    whole = bool(framing.shown.mean() > 0.99)
    return Reference(np.clip(np.round(picture), 0, 255).astype(np.uint8), keypoints, score, not whole)


def moved_camera(
    clip: FittedClip, turn: TurntableMotion, landmarks: Landmarks, frame, joints, vertices
) -> Camera:
    """The clip's camera with its picture moved and scaled onto the turn's first skeleton."""
    camera = clip.cameras[frame]
    there = pose_frame(clip.body, clip.identity, turn.poses.pose(0))
    anchors = landmarks.whole_body[torch.tensor(_ANCHORS)]
    source = project(camera, locate(anchors, joints, vertices)).numpy()
    target = project(turn.camera, locate(anchors, there[1], there[0])).numpy()
    centred = source - source.mean(0)
    # Heights alone: a person who stands half turned is narrow, not small.
    scale = float(
        (centred[:, 1] * (target - target.mean(0))[:, 1]).sum() / max((centred[:, 1] ** 2).sum(), 1e-9)
    )
    shift = target.mean(0) - scale * source.mean(0)
    intrinsics = camera.intrinsics.clone()
    intrinsics[:2] *= scale
    intrinsics[:2, 2] += torch.from_numpy(shift).to(intrinsics)
    return dataclasses.replace(
        camera, width=turn.camera.width, height=turn.camera.height, intrinsics=intrinsics
    )


def _change(source: Camera, target: Camera) -> np.ndarray:
    """The affine map of pixels between two cameras that differ in their intrinsics: [2, 3]."""
    scale, shift = pixel_map(source, target)
    # OpenCV puts the first pixel's centre at 0, we at 0.5.
    shift = shift + 0.5 * scale - 0.5
    return np.array([[scale[0], 0, shift[0]], [0, scale[1], shift[1]]], np.float64)


def _filmed(size: tuple[int, int], change: np.ndarray, canvas: tuple[int, int]) -> np.ndarray:
    """[H, W] float32: 1 where the clip's picture lies, running out over a few pixels at its borders."""
    inside = cv2.warpAffine(np.ones(size, np.float32), change, canvas, flags=cv2.INTER_NEAREST)
    padded = cv2.copyMakeBorder((inside > 0.5).astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_REPLICATE)
    away = cv2.distanceTransform(padded, cv2.DIST_L2, 5)[1:-1, 1:-1]
    return np.clip(away / max(1.0, _FEATHER * canvas[1]), 0, 1).astype(np.float32)


def _backdrop(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """A plain colour: the median of what is not the person, [3] float32."""
    rest = image[mask < 8]
    return np.median(rest, axis=0).astype(np.float32) if len(rest) else np.full(3, 128, np.float32)
