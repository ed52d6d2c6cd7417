"""Observations that the fit aims at: points of the body, where they were seen, and which to trust.

The binary mask m_j of Eq. 2 is made here. A point is masked when its score is under tau, when it lies
outside the picture, or when one of these rules says that it is a guess:

- hips of somebody whose knees are not in the picture;
- the pose estimator's face where a face mesh was found, and its hand where a hand was found;
- a hand that ``hand_trust.py`` does not trust, and the face where ``face_direction.py`` finds it turned away.

Without the mask, which is the paper's ablation, every detection counts that the estimator returned at all.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from torch import Tensor

from pipeline.body.landmarks import Landmarks, PointSet, join
from pipeline.clip import keypoints as coco
from pipeline.clip.clock import times_of_numbers
from pipeline.clip.keypoints import Keypoints
from stages.fit.face_direction import POSE_TURNED, TURNED, mesh_facing, points_facing
from stages.fit.hand_trust import trusted_flat_hands, trusted_hands

GROUPS = ("body", "left_hand", "right_hand", "face")
"""The groups that residuals are reported by; ``Observations.group`` holds indices into it."""

# MediaPipe's pose: nose, 6 eye points, 2 ears, 2 mouth corners, shoulders, elbows, wrists, 6 points of
# the hands, hips, knees, ankles, heels, toes.
POSE_FACE = slice(0, 11)
POSE_SHOULDERS, POSE_HIPS, POSE_KNEES = (11, 12), (23, 24), (25, 26)
POSE_OF_HAND = ((15, 17, 19, 21), (16, 18, 20, 22))
POSE_FINGERS = slice(17, 23)
LIMBS = (
    (11, 13), (13, 15), (12, 14), (14, 16), (23, 25), (25, 27), (24, 26), (26, 28), (11, 12), (23, 24),
)  # fmt: skip
PALM_BONES = ((0, 5), (0, 17))
HAND_BONES = PALM_BONES + tuple((a, a + 1) for first in (1, 5, 9, 13, 17) for a in range(first, first + 3))

_BODY_SCALE = 4.0  # there are few body points beside 478 of the face, and each carries a limb
_MESH_WEIGHT, _FACE68_WEIGHT, _HAND_WEIGHT = 0.3, 1.0, 0.8
# The palm's direction weighs much: seen in 2D alone, a hand turned the wrong way is a minimum of its own.
_LIMB_DIRECTION, _PALM_DIRECTION, _FINGER_DIRECTION = 60.0, 10.0, 0.2
_GUESSED_DIRECTION = 20.0  # of a limb that reaches out of the picture


@dataclasses.dataclass(frozen=True)
class Directions:
    """Directions of L bones in three dimensions.

    Attributes:
        start, end: [L], indices of observed points.
        unit: [T, L, 3], unit vectors in the camera's axes.
        weight: [T, L], how much each counts, 0 where nothing is known.
    """

    start: Tensor
    end: Tensor
    unit: Tensor
    weight: Tensor


@dataclasses.dataclass(frozen=True)
class Observations:
    """N points of the body over T frames.

    Attributes:
        frames: [T], frame numbers of the source clip.
        points: where the N points lie on the body.
        group: [N], index into ``GROUPS``.
        pixels: K, [T, N, 2], pixels.
        mask: m, [T, N] bool, Eq. 2.
        weight: [N], how much a seen point counts.
        limbs, hand_bones: directions in 3D.
        vague: [N] bool, points that say how head or hand is turned, but nothing of mouth, eyes or fingers.
        hands: [N] bool, points of wrists and hands.
        shoulders: the points of the left and the right shoulder.
    """

    frames: Tensor
    points: PointSet
    group: Tensor
    pixels: Tensor
    mask: Tensor
    weight: Tensor
    limbs: Directions
    hand_bones: Directions
    vague: Tensor
    hands: Tensor
    shoulders: tuple[int, int]

    def of(self, group: str) -> Tensor:
        """The points of a group: [N] bool."""
        return self.group == GROUPS.index(group)


def observe(
    keypoints: Keypoints,
    landmarks: Landmarks,
    threshold: float,
    sizes: np.ndarray,
    masked: bool = True,
    facing: np.ndarray | None = None,
    times: np.ndarray | None = None,
) -> Observations:
    """Choose the point sets that the estimator gave and mask what cannot be trusted.

    Args:
        threshold: tau, the score under which a point is masked.
        sizes: [T, 2], width and height of each frame in pixels.
        masked: False sets m = 1 for every finite detection with a place or a score.
        facing: [T], cosine between the initial pose's face and the way to the camera, where one is
            known (``face_direction.pose_facing``); asked only where the face's points have no depth.
        times: [T], of the frames, see :mod:`pipeline.clip.clock`; by default their numbers.
    """
    times = times_of_numbers(keypoints.frames) if times is None else times
    if (keypoints.pose_image[..., 3] > 0).any():
        return _from_mediapipe(keypoints, landmarks, threshold, sizes, masked, times)
    return _from_whole_body(keypoints, landmarks, threshold, sizes, masked, facing, times)


def _from_mediapipe(
    keypoints: Keypoints,
    landmarks: Landmarks,
    threshold: float,
    sizes: np.ndarray,
    masked: bool,
    times: np.ndarray,
) -> Observations:
    """33 pose points, 2 x 21 hand points and 478 face points."""
    sets = pose, hands, mesh = keypoints.pose_image, keypoints.hands, keypoints.face_mesh
    world, count = keypoints.pose_world, len(mesh)
    if masked:
        pose_mask, hand_mask, face_mask = _mediapipe_masks(keypoints, threshold, sizes, times)
        world_mask = world[..., 3] >= threshold
    else:
        pose_mask, hand_mask, face_mask = (detected(points) for points in sets)
        world_mask = detected(world)
    mask = np.concatenate([pose_mask, hand_mask.reshape(count, 42), face_mask], axis=1)
    pixels = np.concatenate([pose[..., :2], hands.reshape(count, 42, 4)[..., :2], mesh[..., :2]], axis=1)
    group = np.repeat([0, 1, 2, 3], [33, 21, 21, 478])
    weight = np.concatenate([_pose_weights(), np.full(42, _HAND_WEIGHT), np.full(478, _MESH_WEIGHT)])
    limbs = _directions(world[..., :3], LIMBS, 0, _both(world_mask, LIMBS))
    both_seen = torch.from_numpy(_both(visible(pose, threshold, sizes), LIMBS))
    limbs.weight.mul_(torch.where(both_seen, _LIMB_DIRECTION, _GUESSED_DIRECTION))
    limbs.weight[:, _limbs_of_hips()] *= torch.from_numpy(pose_mask[:, POSE_HIPS].any(1)).float()[:, None]
    return _assemble(
        keypoints,
        join(landmarks.pose, landmarks.hands, landmarks.face_mesh),
        (group, pixels, mask, weight),
        (limbs, _hand_directions(hands, hand_mask)),
        vague=np.r_[POSE_FACE, POSE_FINGERS],
        hands=np.r_[15:23, 33:75],
        shoulders=POSE_SHOULDERS,
    )


def _mediapipe_masks(
    keypoints: Keypoints, threshold: float, sizes: np.ndarray, times: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Masks of pose [T, 33], hands [T, 2, 21] and face [T, 478]."""
    pose, hands, mesh = keypoints.pose_image, keypoints.hands, keypoints.face_mesh
    seen_hand = trusted_hands(hands, pose, keypoints.pose_world, threshold, times)
    seen_face = ((mesh[..., 3] >= threshold).mean(1) > 0.5) & (mesh_facing(mesh) >= TURNED)
    pose_mask = visible(pose, threshold, sizes)
    pose_mask[:, POSE_FACE] &= ~seen_face[:, None]
    drop_guesses(pose_mask, POSE_HIPS, POSE_KNEES, times)
    hand_mask = visible(hands, threshold, sizes) & seen_hand[..., None]
    for side, (wrist, *fingers) in enumerate(POSE_OF_HAND):
        pose_mask[:, fingers] &= ~seen_hand[:, side, None]
        pose_mask[:, wrist] &= ~hand_mask[:, side, 0]  # a hand at the edge may lack its own wrist
    return pose_mask, hand_mask, visible(mesh, threshold, sizes) & seen_face[:, None]


def _from_whole_body(
    keypoints: Keypoints,
    landmarks: Landmarks,
    threshold: float,
    sizes: np.ndarray,
    masked: bool,
    facing: np.ndarray | None,
    times: np.ndarray,
) -> Observations:
    """The 133 points of COCO-WholeBody, which have no depth."""
    points = keypoints.whole_body
    mask = _whole_body_mask(points, threshold, sizes, facing, times) if masked else detected(points)
    group = np.repeat([0, 3, 1, 2], [23, 68, 21, 21])
    body = np.ones(23)
    body[1:3], body[5:11], body[11:13] = 0.3, 1.5, 0.5
    weight = np.concatenate([_BODY_SCALE * body, np.full(68, _FACE68_WEIGHT), np.full(42, _HAND_WEIGHT)])
    nothing = _directions(points, (), 0, np.zeros((len(points), 0), bool))
    return _assemble(
        keypoints,
        landmarks.whole_body,
        (group, points[..., :2], mask, weight),
        (nothing, nothing),
        vague=np.r_[0:5],
        hands=np.r_[9:11, coco.LEFT_HAND, coco.RIGHT_HAND],
        shoulders=(5, 6),
    )


def _whole_body_mask(
    points: np.ndarray, threshold: float, sizes: np.ndarray, facing: np.ndarray | None, times: np.ndarray
) -> np.ndarray:
    """The mask of the 133 points: [T, 133]."""
    mask = visible(points, threshold, sizes)
    looks = points_facing(points[:, coco.FACE], points[:, 3:5], threshold) >= TURNED
    if facing is not None:
        looks &= facing >= POSE_TURNED
    seen_face = (mask[:, coco.FACE].mean(1) > 0.5) & looks
    mask[:, coco.FACE] &= seen_face[:, None]
    mask[:, :5] &= ~seen_face[:, None]
    drop_guesses(mask, (11, 12), (13, 14), times)
    hands, seen = (np.stack([a[:, coco.LEFT_HAND], a[:, coco.RIGHT_HAND]], axis=1) for a in (points, mask))
    seen_hands = trusted_flat_hands(hands, seen, points[:, 9:11], mask[:, 9:11])
    for side, hand in enumerate((coco.LEFT_HAND, coco.RIGHT_HAND)):
        mask[:, hand] &= seen_hands[:, side, None]
        mask[:, 9 + side] &= ~seen_hands[:, side]
    return mask


def _assemble(
    keypoints: Keypoints,
    points: PointSet,
    arrays: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    directions: tuple[Directions, Directions],
    vague: np.ndarray,
    hands: np.ndarray,
    shoulders: tuple[int, int],
) -> Observations:
    """Observations from group, pixels, mask and weight of N points; ``vague`` and ``hands`` are indices."""
    group, pixels, mask, weight = arrays
    rows = np.arange(len(group))
    return Observations(
        frames=torch.from_numpy(keypoints.frames.astype(np.int64)),
        points=points,
        group=torch.from_numpy(group),
        pixels=torch.from_numpy(np.where(mask[..., None], pixels, 0).astype(np.float32)),
        mask=torch.from_numpy(mask),
        weight=torch.from_numpy(weight.astype(np.float32)),
        limbs=directions[0],
        hand_bones=directions[1],
        vague=torch.from_numpy(np.isin(rows, vague)),
        hands=torch.from_numpy(np.isin(rows, hands)),
        shoulders=shoulders,
    )


def visible(points: np.ndarray, threshold: float, sizes: np.ndarray) -> np.ndarray:
    """The points that are scored at least ``threshold``, finite, and inside the picture: [T, ...] bool.

    Args:
        points: [T, ..., C], x and y first, the score last.
        sizes: [T, 2], width and height.
    """
    limit = sizes.reshape(len(points), *[1] * (points.ndim - 2), 2)
    with np.errstate(invalid="ignore"):
        inside = ((points[..., :2] > 0) & (points[..., :2] < limit)).all(-1)
        return inside & (points[..., -1] >= threshold) & (points[..., -1] > 0) & np.isfinite(points).all(-1)


def detected(points: np.ndarray) -> np.ndarray:
    """The points that an estimator returned, finite and with a place or a score: [T, ..., C] -> [T, ...]."""
    return np.isfinite(points).all(-1) & ((points[..., :2] != 0).any(-1) | (points[..., -1] > 0))


def drop_guesses(
    mask: np.ndarray,
    doubtful: tuple[int, int],
    witness: tuple[int, int],
    times: np.ndarray | None = None,
    reach: float = 12.0,
) -> None:
    """Mask the doubtful points (in place) where, within ``reach``, a witness is seen in under 20%.

    ``reach`` and ``times`` [T] are in 30ths of a second; without times the frames follow one another so.

    The hips of a seated or cropped person score well and are guesses.
    """
    times = np.arange(float(len(mask))) if times is None else times
    seen = np.concatenate([[0], np.cumsum(mask[:, witness].any(1))])
    first, stop = np.searchsorted(times, times - reach - 1e-6), np.searchsorted(times, times + reach + 1e-6)
    share = (seen[stop] - seen[first]) / np.maximum(stop - first, 1)
    mask[:, doubtful] &= (share >= 0.2)[:, None]


def _pose_weights() -> np.ndarray:
    """Weights of the 33 pose points: joints count most, the vague points of face and hand least."""
    weight = np.ones(33)
    weight[[1, 2, 3, 4, 5, 6, 9, 10]] = 0.3
    weight[11:17] = 1.5
    weight[POSE_FINGERS] = 0.3
    weight[23:25] = 0.5
    return _BODY_SCALE * weight


def _directions(
    places: np.ndarray, bones: tuple[tuple[int, int], ...], offset: int, known: np.ndarray
) -> Directions:
    """Unit vectors along bones: places [T, K, 3], known [T, L]; ``offset`` is the first place's index."""
    pairs = np.array(bones, np.int64).reshape(-1, 2)
    vector = np.nan_to_num(places[:, pairs[:, 1]] - places[:, pairs[:, 0]])
    length = np.linalg.norm(vector, axis=-1, keepdims=True)
    known = known & (length[..., 0] > 1e-6)
    return Directions(
        start=torch.from_numpy(pairs[:, 0] + offset),
        end=torch.from_numpy(pairs[:, 1] + offset),
        unit=torch.from_numpy((vector / np.maximum(length, 1e-6)).astype(np.float32)),
        weight=torch.from_numpy(known.astype(np.float32)),
    )


def _hand_directions(hands: np.ndarray, mask: np.ndarray) -> Directions:
    known = [_both(mask[:, side], HAND_BONES) for side in (0, 1)]
    parts = [_directions(hands[:, s, :, :3], HAND_BONES, 33 + 21 * s, known[s]) for s in (0, 1)]
    for part in parts:
        part.weight[:, : len(PALM_BONES)] *= _PALM_DIRECTION
        part.weight[:, len(PALM_BONES) :] *= _FINGER_DIRECTION
    both = {f.name: [getattr(part, f.name) for part in parts] for f in dataclasses.fields(Directions)}
    return Directions(*(torch.cat(values, dim=0 if values[0].ndim == 1 else 1) for values in both.values()))


def _both(mask: np.ndarray, bones: tuple[tuple[int, int], ...]) -> np.ndarray:
    """Bones of which both ends are seen: [T, K] bool -> [T, L] bool."""
    pairs = np.array(bones, np.int64)
    return mask[:, pairs[:, 0]] & mask[:, pairs[:, 1]]


def _limbs_of_hips() -> list[int]:
    return [row for row, (a, b) in enumerate(LIMBS) if a in POSE_HIPS or b in POSE_HIPS]
