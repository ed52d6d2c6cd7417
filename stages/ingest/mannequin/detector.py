"""A keypoint detector with known errors: what an estimator would say of the mannequin.

Seen points are a little off, by an error that drifts from frame to frame. Points outside the picture or
behind something are returned all the same, as real detectors do: wrong, inside the picture, and with a
low score. Hands sometimes fail, half of the time with a high score: they collapse into the palm, or land
on the other hand. A face that is turned away and a hand of which little is seen are guessed as a whole.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from pipeline.camera import Camera, project, to_camera
from pipeline.keypoints import FACE, LEFT_HAND, RIGHT_HAND, Keypoints, empty_keypoints
from stages.ingest.mannequin.spec import MannequinSpec
from stages.ingest.mannequin.truth import OUTSIDE, SEEN, Places

_LIMBS = np.array([5, 5, 5, 7, 7, 13, 13, 13, 13, 12, 12, 20, 20, 15, 15, 14, 14]) / 1000  # COCO's 17, metres
_POSE = np.repeat([5, 7, 6, 13, 12, 10, 20, 15, 14, 14], [7, 2, 2, 4, 2, 6, 2, 2, 2, 4]) / 1000
_FEET, _FACE, _HAND = 0.014, 0.0012, 0.005  # metres
_FLOOR = 0.3  # pixels, of a heatmap's own grain
_DRIFT = 0.8  # how much of a frame's drift is left in the next
_GUESS = 0.12  # metres: how far off a guessed point is
_WORLD = (0.015, 0.03)  # metres, across and along the view
_DEPTH = 0.4  # of a point's relative depth, how far it is off
_FEW = 0.25  # of a hand's or a face's points: less seen than that is guessed


@dataclasses.dataclass(frozen=True)
class _Set:
    """One set of points as the detector sees it: T frames, K points.

    Attributes:
        camera: [T, K, 3], metres in the camera's frame of reference.
        pixels: [T, K, 2].
        state: [T, K].
    """

    camera: np.ndarray
    pixels: np.ndarray
    state: np.ndarray

    def __getitem__(self, columns: slice) -> _Set:
        return _Set(self.camera[:, columns], self.pixels[:, columns], self.state[:, columns])


def detect(spec: MannequinSpec, camera: Camera, places: Places, state: np.ndarray) -> Keypoints:
    """The detections of the whole clip.

    Args:
        spec: noise, hand_failures and seed are read.
        camera: the pipeline's.
        places: where joints and landmarks are.
        state: [T, K], of each of them.
    """
    detector = _Detector(spec, camera)
    whole, pose, hands, mesh = (
        detector.look(places, state, name) for name in ("whole_body", "pose", "hands", "face_mesh")
    )
    found = empty_keypoints(np.arange(spec.frames))
    guessed_hands = np.stack(
        [_few_seen(hands[side]) for side in (slice(0, 21), slice(21, 42))], axis=1
    )  # [T, 2]
    guessed_face = _few_seen(mesh)
    for side in (0, 1):
        one = hands[slice(21 * side, 21 * side + 21)]
        found.hands[:, side] = detector.points(one, np.full(21, _HAND), guessed_hands[:, side])
    detector.fail_hands(found.hands)
    found.face_mesh[:] = detector.points(mesh, np.full(478, _FACE), guessed_face)
    found.pose_image[:] = detector.points(pose, _POSE, np.zeros(spec.frames, bool))
    found.pose_world[:] = detector.world(pose, found.pose_image[..., 3])
    limbs = detector.points(
        whole[slice(0, 23)], np.concatenate([_LIMBS, np.full(6, _FEET)]), np.zeros(spec.frames, bool)
    )
    found.whole_body[:, :23] = limbs[..., [0, 1, 3]]
    face = detector.points(whole[FACE], np.full(68, _FACE), guessed_face)
    found.whole_body[:, FACE] = face[..., [0, 1, 3]]
    found.whole_body[:, LEFT_HAND] = found.hands[:, 0][..., [0, 1, 3]]
    found.whole_body[:, RIGHT_HAND] = found.hands[:, 1][..., [0, 1, 3]]
    return found


class _Detector:
    """The detector's state: its random draws."""

    def __init__(self, spec: MannequinSpec, camera: Camera) -> None:
        self.spec, self.camera = spec, camera
        self.size = np.array([camera.width, camera.height], float)
        self.focal = float(camera.intrinsics[0, 0])
        self.rng = np.random.default_rng([spec.seed, 7])

    def look(self, places: Places, state: np.ndarray, name: str) -> _Set:
        """The points of one set in the camera."""
        rows = places.sets[name]
        world = places.world[:, rows]
        return _Set(
            to_camera(self.camera, world).double().numpy(),
            project(self.camera, world).double().numpy(),
            state[:, rows],
        )

    def points(self, truth: _Set, error: np.ndarray, guessed: np.ndarray) -> np.ndarray:
        """Detections [T, K, 4] float32: x, y, z in pixels, z about the set's middle, and a score.

        Args:
            truth: the set.
            error: [K], metres, standard deviation in each direction on seen points.
            guessed: [T] bool, frames in which the set as a whole is not really seen.
        """
        per_metre = self.focal / np.maximum(truth.camera[..., 2], 0.1)  # [T, K]
        seen = (truth.state == SEEN) & ~guessed[:, None]
        sure = self.spec.noise * (_FLOOR + error * per_metre)
        sigma = np.where(seen, sure, (_GUESS + error) * per_metre)
        xy = truth.pixels + self._drifting(sigma.shape + (2,)) * sigma[..., None]
        # A guess stays in the picture: heatmaps end there.
        margin = 0.01 * self.size
        low, high = margin, self.size - margin
        inward = np.abs(self._drifting(sigma.shape + (2,))) * 0.08 * self.size
        # Points far outside end up in a margin, not all on its very edge.
        clamped = np.where(xy < low, low + inward, np.where(xy > high, high - inward, xy))
        xy = np.where(seen[..., None], xy, np.clip(clamped, low, high))
        depth = truth.camera[..., 2] - truth.camera[..., 2].mean(1, keepdims=True)
        z = depth * per_metre + self._drifting(sigma.shape) * sigma * (1 + _DEPTH)
        score = self._scores(truth.state, seen)
        return np.concatenate([xy, z[..., None], score[..., None]], axis=-1).astype(np.float32)

    def world(self, pose: _Set, visibility: np.ndarray) -> np.ndarray:
        """The 33 points in metres about the hips, [T, 33, 4]; a guess is worse by its score."""
        hips = pose.camera[:, 23:25].mean(1, keepdims=True)
        scale = 1 + 0.03 * self.spec.noise * self.rng.standard_normal()
        sigma = np.array([_WORLD[0], _WORLD[0], _WORLD[1]]) * self.spec.noise
        sigma = np.where((pose.state == SEEN)[..., None], sigma, _GUESS)
        places = (pose.camera - hips) * scale + self._drifting(pose.camera.shape) * sigma
        return np.concatenate([places, visibility[..., None]], axis=-1).astype(np.float32)

    def fail_hands(self, hands: np.ndarray) -> None:
        """Spoil some hands [T, 2, 21, 4], in place, for one to three frames each."""
        count = len(hands)
        for side in (0, 1):
            starts = np.flatnonzero(self.rng.random(count) < self.spec.hand_failures)
            for start in starts.tolist():
                rows = np.arange(start, min(start + int(self.rng.integers(1, 4)), count))
                silent, jumps = self.rng.random(2) < 0.5
                own = hands[rows, side]
                if jumps:
                    hands[rows, side, :, :3] = hands[rows, 1 - side, :, :3] + self.rng.normal(
                        0, 1, own[..., :3].shape
                    )
                else:
                    palm = own[:, [0, 5, 17], :3].mean(1, keepdims=True)
                    hands[rows, side, :, :3] = palm + 0.25 * (own[..., :3] - palm)
                if not silent:
                    hands[rows, side, :, 3] *= 0.3

    def _scores(self, state: np.ndarray, seen: np.ndarray) -> np.ndarray:
        shape = state.shape
        high = np.clip(0.88 + 0.05 * self._drifting(shape), 0.5, 1.0)
        low = np.clip(0.24 + 0.06 * self._drifting(shape), 0.02, 0.38)
        least = np.clip(0.12 + 0.05 * self._drifting(shape), 0.01, 0.3)
        return np.where(seen, high, np.where(state == OUTSIDE, least, low))

    def _drifting(self, shape: tuple[int, ...]) -> np.ndarray:
        """Standard normal numbers [T, ...], of which most drifts over time and some is new in each frame."""
        fresh = self.rng.standard_normal(shape)
        drift = self.rng.standard_normal(shape)
        for row in range(1, shape[0]):
            drift[row] = _DRIFT * drift[row - 1] + np.sqrt(1 - _DRIFT**2) * drift[row]
        return np.sqrt(0.6) * drift + np.sqrt(0.4) * fresh


def _few_seen(points: _Set) -> np.ndarray:
    """Frames in which hardly any point of a set is seen, [T] bool."""
    return (points.state == SEEN).mean(1) < _FEW
