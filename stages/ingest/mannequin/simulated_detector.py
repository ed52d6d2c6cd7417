"""Simulated keypoint detectors, whose errors on the mannequin are known.

``mediapipe`` errs as MediaPipe 0.10.21 (holistic) was measured to, on pictures of mannequins in the three
framings (against their truth: 4 clips of 60 frames in each, two people, 256 px; for hidden points 3 clips
of 40 frames, three people, 384 px), and as its detections in four real clips look. d is how far a point
lies outside the picture, in metres:

- Outside points come back outside: 0% inside the picture but for hands a few centimetres out (0-45%) and,
  once in a while, hips. They are steady (20 mm about their course, which drifts), and wrong by a share of
  d towards the picture that lasts for the whole clip: trunk and legs 0.17 (0.01 to 0.4), elbows 0.18,
  hands 0.4 and a quarter of d sideways. In the real clips, too, unseen hips, knees and ankles lie outside
  as a body too short by 10-20%, moving by 0.2-1% of the shoulders' width a frame.
- Their score falls with d, and what lies just outside is scored as if it were seen: hips at d = 0.1 m
  0.24-0.60 (real: 0.60-0.87), wrists at 0.04 m 0.67-0.98, elbows at 0.18 m 0.07-0.43 (real, elbows of a
  cropped driver: 0.31 and 0.43), wrists at 0.4 m 0.01-0.11, knees and ankles under 0.15.
- Hidden points inside the picture are barely worse than seen ones (15-45 mm) and score well: shoulders,
  hips and face 1.0, elbows 0.61, wrists 0.52, knees 0.79. A quarter of the wrists is under 0.4, and little
  of the rest.
- Hands are missed as a whole: always where none of a hand is in the picture, in 78% of the frames where
  less than a quarter is, in 25% of the others (3% in a real clip; 15% here). All points of a hand that is
  found are good to 6-10 mm; those of a hand or face that lie outside have no score. A face is found until
  about half of its points are turned away.

``heatmap`` is for detectors that search a box of the picture (DWPose and its like, of which only the 133
points exist): what lies outside is put somewhere inside, near the picture's edge. None could be measured
here; errors and scores are those above for want of better, and every point has a score.

With either, some hands fail, half of the time with a high score: they collapse into the palm, or land on
the other hand.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.special import expit, ndtr

from pipeline.clip.camera import Camera, project, to_camera
from pipeline.clip.keypoints import FACE, LEFT_HAND, RIGHT_HAND, Keypoints, empty_keypoints
from stages.ingest.mannequin.framing import in_picture
from stages.ingest.mannequin.spec import MannequinSpec
from stages.ingest.mannequin.truth import HIDDEN, OUTSIDE, SEEN, BodyPoints


@dataclasses.dataclass(frozen=True)
class _Part:
    """The errors of one kind of point; metres, standard deviations in each direction.

    Attributes:
        seen: error of a seen point.
        hidden: error of a hidden one.
        score: of a hidden one.
        share: of its distance outside, how far a guess lies towards the picture; mean.
        aside: of its distance outside, how far a guess lies elsewhere.
    """

    seen: float
    hidden: float
    score: float
    share: float = 0.17
    aside: float = 0.05


_PARTS = {
    "eye": _Part(0.005, 0.02, 0.99),
    "ear": _Part(0.007, 0.02, 0.99),
    "mouth": _Part(0.006, 0.02, 0.99),
    "shoulder": _Part(0.013, 0.022, 0.99),
    "elbow": _Part(0.013, 0.045, 0.62, share=0.18, aside=0.1),
    "wrist": _Part(0.012, 0.036, 0.54, share=0.4, aside=0.25),
    "finger": _Part(0.010, 0.036, 0.57, share=0.4, aside=0.25),
    "hip": _Part(0.020, 0.022, 0.99),
    "knee": _Part(0.015, 0.015, 0.80),
    "ankle": _Part(0.014, 0.016, 0.84),
    "foot": _Part(0.014, 0.025, 0.87),
}
_ORDERS = {
    "pose": (
        ("eye", 7), ("ear", 2), ("mouth", 2), ("shoulder", 2), ("elbow", 2), ("wrist", 2), ("finger", 6),
        ("hip", 2), ("knee", 2), ("ankle", 2), ("foot", 4),
    ),
    "limbs": (
        ("eye", 3), ("ear", 2), ("shoulder", 2), ("elbow", 2), ("wrist", 2), ("hip", 2), ("knee", 2),
        ("ankle", 2), ("foot", 6),
    ),
}  # fmt: skip
_FACE, _HAND = _Part(0.0012, 0.004, 0.9), _Part(0.005, 0.007, 0.9, share=0.4, aside=0.25)
_FLOOR = 0.3  # pixels, of a heatmap's own grain
_DRIFT = 0.8  # how much of a frame's drift is left in the next
_SHARE_VARIES = 0.1  # from clip to clip
_NEAR, _WAVERS = 0.02, (0.02, 0.01)  # metres, of a guess over the clip; from frame to frame, and of d
_WORLD = (0.015, 0.03)  # metres, across and along the view
_DEPTH = 0.4  # of a point's relative depth, how far it is off
_LOGIT = (1.8, 17.0, -4.5)  # of a score outside: at the picture's edge, its fall by metre, its least
_LOGIT_VARIES = (0.7, 0.4)  # over the clip and from frame to frame
_FEW_OF_FACE, _FEW_OF_HAND = 0.5, 0.25  # shares of points: less seen than that is missed
_FEW_FOUND, _FOUND = 0.22, 0.85  # of the frames in which a little or more of a hand is seen


@dataclasses.dataclass(frozen=True)
class _TruePoints:
    """The true places and states of one set of points, T frames, K points.

    Attributes:
        camera: [T, K, 3], metres in the camera's frame of reference.
        pixels: [T, K, 2].
        state: [T, K].
    """

    camera: np.ndarray
    pixels: np.ndarray
    state: np.ndarray

    def __getitem__(self, columns: slice) -> _TruePoints:
        return _TruePoints(self.camera[:, columns], self.pixels[:, columns], self.state[:, columns])

    @property
    def share_seen(self) -> np.ndarray:
        """The share of points in view, [T]."""
        return (self.state == SEEN).mean(1)


def simulate_detections(
    spec: MannequinSpec, camera: Camera, places: BodyPoints, state: np.ndarray
) -> Keypoints:
    """The detections of the whole clip.

    Args:
        spec: detector, noise, hand_failures and seed are read.
        camera: the pipeline's.
        places: where joints and landmarks are.
        state: [T, K], of each of them.
    """
    detector = _Detector(spec, camera)
    whole, pose, hands, mesh = (
        detector.truth_of(places, state, name) for name in ("whole_body", "pose", "hands", "face_mesh")
    )
    found = empty_keypoints(np.arange(spec.frames))
    for side in (0, 1):
        one = hands[slice(21 * side, 21 * side + 21)]
        found.hands[:, side] = detector.points(detector.as_a_whole(one), (_HAND,) * 21)
        detector.miss(found.hands[:, side], detector.misses_hand(one))
    detector.fail_hands(found.hands)
    found.face_mesh[:] = detector.points(detector.as_a_whole(mesh), (_FACE,) * 478)
    missed_face = mesh.share_seen < _FEW_OF_FACE
    detector.miss(found.face_mesh, missed_face)
    found.pose_image[:] = detector.points(pose, _parts("pose"))
    found.pose_world[:] = detector.world(pose, found.pose_image)
    limbs = detector.points(whole[slice(0, 23)], _parts("limbs"))
    face = detector.points(detector.as_a_whole(whole[FACE]), (_FACE,) * 68)
    detector.miss(face, missed_face)
    found.whole_body[:, :23] = limbs[..., [0, 1, 3]]
    found.whole_body[:, FACE] = face[..., [0, 1, 3]]
    found.whole_body[:, LEFT_HAND] = found.hands[:, 0][..., [0, 1, 3]]
    found.whole_body[:, RIGHT_HAND] = found.hands[:, 1][..., [0, 1, 3]]
    if detector.keeps_inside:
        blank = empty_keypoints(found.frames)
        return dataclasses.replace(blank, whole_body=found.whole_body)
    found.whole_body[~in_picture(camera, found.whole_body[..., :2])] = 0  # as the ingest stage writes them
    return found


class _Detector:
    """A detector with its random draws; with ``keeps_inside`` it puts every point inside the picture."""

    def __init__(self, spec: MannequinSpec, camera: Camera) -> None:
        self.spec, self.camera = spec, camera
        self.keeps_inside = spec.detector == "heatmap"
        self.size = np.array([camera.width, camera.height], float)
        self.focal = float(camera.intrinsics[0, 0])
        self.rng = np.random.default_rng([spec.seed, 7])
        self.too_short = self.rng.standard_normal()  # a guessed body is too short as a whole

    def truth_of(self, places: BodyPoints, state: np.ndarray, name: str) -> _TruePoints:
        """The points of one set in the camera."""
        rows = places.sets[name]
        world = places.world[:, rows]
        return _TruePoints(
            to_camera(self.camera, world).double().numpy(),
            project(self.camera, world).double().numpy(),
            state[:, rows],
        )

    def as_a_whole(self, truth: _TruePoints) -> _TruePoints:
        """A hand or face as a model of its own sees it: found with its points outside, or not at all."""
        if self.keeps_inside:
            return truth
        return dataclasses.replace(truth, state=np.maximum(truth.state, HIDDEN))

    def points(self, truth: _TruePoints, parts: tuple[_Part, ...]) -> np.ndarray:
        """Detections [T, K, 4] float32: x, y, z in pixels, z about the set's middle, and a score.

        Args:
            truth: the set.
            parts: of its K points.
        """
        per_metre = self._per_metre(truth)
        away = self._outside(truth)
        outside = (truth.state == OUTSIDE)[..., None]
        off = np.where(outside, self._guessed(away, parts), self._found(truth, parts))
        xy = truth.pixels + off * per_metre[..., None]
        if self.keeps_inside:
            seen = (truth.state == SEEN)[..., None]
            xy = np.where(seen, np.clip(xy, 0, self.size), self._pulled_in(xy))
        depth = truth.camera[..., 2] - truth.camera[..., 2].mean(1, keepdims=True)
        sigma = np.linalg.norm(off, axis=-1) * per_metre
        z = depth * per_metre + self._drifting(sigma.shape) * sigma * (1 + _DEPTH)
        score = self._scores(truth.state, np.linalg.norm(away, axis=-1), parts)
        return np.concatenate([xy, z[..., None], score[..., None]], axis=-1).astype(np.float32)

    def world(self, pose: _TruePoints, found: np.ndarray) -> np.ndarray:
        """The 33 points in metres about the hips, [T, 33, 4]; a guess is as wrong as in the picture.

        Args:
            pose: the truth.
            found: [T, 33, 4], the same points in pixels, whose scores are taken over.
        """
        unseen = (pose.state != SEEN)[..., None]
        off = (found[..., :2] - pose.pixels) / self._per_metre(pose)[..., None]
        depth = self._drifting(off.shape[:2]) * np.linalg.norm(off, axis=-1)
        guess = np.concatenate([off, depth[..., None]], axis=-1)
        sigma = np.array([_WORLD[0], _WORLD[0], _WORLD[1]]) * self.spec.noise
        places = pose.camera + np.where(unseen, guess, self._drifting(guess.shape) * sigma)
        scale = 1 + 0.03 * self.spec.noise * self.rng.standard_normal()
        places = (places - places[:, 23:25].mean(1, keepdims=True)) * scale
        return np.concatenate([places, found[..., 3:]], axis=-1).astype(np.float32)

    def misses_hand(self, hand: _TruePoints) -> np.ndarray:
        """In which frames a hand is not found, [T] bool."""
        share = hand.share_seen
        chance = np.where(share >= _FEW_OF_HAND, _FOUND, np.where(share > 0, _FEW_FOUND, 0.0))
        return ndtr(self._drifting(share.shape)) >= chance

    def miss(self, points: np.ndarray, missed: np.ndarray) -> None:
        """Spoil a set of points [T, K, 4] in place: all of it in some frames, and what lies outside.

        A detector that has to return something somewhere scores it low; the other returns nothing.
        """
        if self.keeps_inside:
            points[missed, :, 3] = np.minimum(points[missed, :, 3], 0.2)
        else:
            points[missed] = 0
            points[~in_picture(self.camera, points[..., :2])] = 0

    def fail_hands(self, hands: np.ndarray) -> None:
        """Spoil some hands [T, 2, 21, 4], in place, for one to three frames each."""
        count = len(hands)
        for side in (0, 1):
            starts = np.flatnonzero(self.rng.random(count) < self.spec.hand_failures)
            for start in starts.tolist():
                rows = np.arange(start, min(start + int(self.rng.integers(1, 4)), count))
                silent, jumps = self.rng.random(2) < 0.5
                own, other = hands[rows, side], hands[rows, 1 - side]
                failed = own.copy()
                if jumps:
                    failed[..., :3] = other[..., :3] + self.rng.normal(0, 1, own[..., :3].shape)
                else:
                    palm = own[:, [0, 5, 17], :3].mean(1, keepdims=True)
                    failed[..., :3] = palm + 0.25 * (own[..., :3] - palm)
                if not silent:
                    failed[..., 3] *= 0.3
                exists = (own[..., 3:] > 0) & ((other[..., 3:] > 0) if jumps else True)
                hands[rows, side] = np.where(exists, failed, own)

    def _per_metre(self, truth: _TruePoints) -> np.ndarray:
        """Pixels of a metre at each point, [T, K]."""
        return self.focal / np.maximum(truth.camera[..., 2], 0.1)

    def _outside(self, truth: _TruePoints) -> np.ndarray:
        """The way from each point to the picture, [T, K, 2] metres; zero for what is inside."""
        nearest = np.clip(truth.pixels, 0, self.size)
        return (nearest - truth.pixels) / self._per_metre(truth)[..., None]

    def _found(self, truth: _TruePoints, parts: tuple[_Part, ...]) -> np.ndarray:
        """The error of points inside the picture, [T, K, 2] metres."""
        floor = _FLOOR / self._per_metre(truth)
        seen = self.spec.noise * (floor + np.array([part.seen for part in parts]))
        hidden = np.array([part.hidden for part in parts]) + floor
        sigma = np.where(truth.state == SEEN, seen, hidden)
        return self._drifting(truth.pixels.shape) * sigma[..., None]

    def _guessed(self, away: np.ndarray, parts: tuple[_Part, ...]) -> np.ndarray:
        """The error of points outside the picture, [T, K, 2] metres, most of it the same in all frames."""
        distance = np.linalg.norm(away, axis=-1, keepdims=True)
        share, aside = (np.array([getattr(part, name) for part in parts]) for name in ("share", "aside"))
        own = self.rng.standard_normal((2, len(parts), 2))
        share = share + _SHARE_VARIES * (self.too_short + 0.3 * own[0, :, 0])
        lasting = share[:, None] * away + (_NEAR + aside[:, None] * distance) * own[1]
        return lasting + (_WAVERS[0] + _WAVERS[1] * distance) * self._drifting(away.shape)

    def _pulled_in(self, xy: np.ndarray) -> np.ndarray:
        """Guesses [T, K, 2] that a heatmap can hold: inside the picture, not all on its very edge."""
        low, high = 0.01 * self.size, 0.99 * self.size
        inward = np.abs(self._drifting(xy.shape)) * 0.08 * self.size
        clamped = np.where(xy < low, low + inward, np.where(xy > high, high - inward, xy))
        return np.clip(clamped, low, high)

    def _scores(self, state: np.ndarray, distance: np.ndarray, parts: tuple[_Part, ...]) -> np.ndarray:
        """[T, K], from the state, the distance outside in metres, and what each point is."""
        shape = state.shape
        seen = np.clip(0.93 + 0.05 * self._drifting(shape), 0.5, 1.0)
        hidden = np.array([part.score for part in parts]) + 0.1 * self._drifting(shape)
        edge, fall, least = _LOGIT
        lasting = _LOGIT_VARIES[0] * self.rng.standard_normal(shape[1])
        varies = lasting + _LOGIT_VARIES[1] * self._drifting(shape)
        guessed = expit(np.maximum(edge - fall * distance, least) + varies)
        inside_score = np.where(state == SEEN, seen, np.clip(hidden, 0.05, 1.0))
        return np.where(state == OUTSIDE, guessed, inside_score)

    def _drifting(self, shape: tuple[int, ...]) -> np.ndarray:
        """Standard normal numbers [T, ...], of which most drifts over time and some is new in each frame."""
        fresh = self.rng.standard_normal(shape)
        drift = self.rng.standard_normal(shape)
        for row in range(1, shape[0]):
            drift[row] = _DRIFT * drift[row - 1] + np.sqrt(1 - _DRIFT**2) * drift[row]
        return np.sqrt(0.6) * drift + np.sqrt(0.4) * fresh


def _parts(name: str) -> tuple[_Part, ...]:
    """The kind of each point of a set, in order."""
    return tuple(_PARTS[kind] for kind, count in _ORDERS[name] for _ in range(count))
