"""The mannequin's motion: generated layers that add up, or motion capture. Radians and metres."""

from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import roma
import torch
from torch import Tensor

from pipeline.body import JOINT_NAMES, joint_index
from pipeline.motion.bvh import read_bvh
from pipeline.motion.retarget import retarget
from stages.ingest.mannequin.spec import MannequinSpec

ARMS_DOWN = 1.12
"""Radians from the T pose to arms that hang beside the body without touching it."""

_CLOSING, _SHUT, _OPENING = 0.08, 0.08, 0.14  # seconds of a blink
_BETWEEN_BLINKS, _LOOKS_FOR = (0.3, 0.9), (0.2, 0.7)  # seconds; oftener than in life, so that clips are short
_GAZE = np.array([0.22, 0.42])  # radians up or down and aside, at most

_SIDES = (("left", 1.0), ("right", -1.0))


@dataclasses.dataclass(frozen=True)
class MannequinMotion:
    """A motion before it is placed in the world, T frames, float32.

    Attributes:
        rotation: [T, 55, 3], rotation vectors relative to the parent joint.
        expression: [T, E].
        root: [T, 3], metres, where the pelvis is relative to where it begins; the body faces +Z.
        notes: what a user should know of the capture that was read, a sentence each.
    """

    rotation: Tensor
    expression: Tensor
    root: Tensor
    notes: tuple[str, ...] = ()


@dataclasses.dataclass
class _Draft:
    """A motion in the making: layers add angles, which are composed at the end.

    ``turns`` are angles about the joint's X, Y and Z axes, applied in the order Y, Z, X: an arm of the
    T pose is swung forwards, then lowered, then raised forwards.
    """

    seconds: np.ndarray  # [T]
    turns: np.ndarray  # [T, 55, 3]
    expression: np.ndarray  # [T, E]
    rng: np.random.Generator
    shut_eyes: np.ndarray  # [E]

    def add(self, joint: str, axis: int, angle: np.ndarray | float) -> None:
        self.turns[:, joint_index(joint), axis] += angle

    def wave(self, low: float, high: float, slow: float = 0.15, quick: float = 0.7) -> np.ndarray:
        """A smooth random course between two values, [T]; ``slow`` and ``quick`` in hertz."""
        frequencies = self.rng.uniform(slow, quick, 3)
        phases = self.rng.uniform(0, 2 * np.pi, 3)
        course = np.sin(2 * np.pi * frequencies * self.seconds[:, None] + phases) @ np.array([0.5, 0.3, 0.2])
        return low + (high - low) * (0.5 + 0.5 * course)

    def bursts(self, height: float, slow: float, quick: float, threshold: float = 0.1) -> np.ndarray:
        """A course that rests at zero between smooth bumps up to ``height``, [T]."""
        return height * np.clip((self.wave(-1, 1, slow, quick) - threshold) / (1 - threshold), 0, 1)


def make_motion(
    spec: MannequinSpec, joints: Tensor, parents: tuple[int, ...], shut_eyes: Tensor
) -> MannequinMotion:
    """The motion that a spec names.

    Args:
        spec: motion, frames, fps and seed are read.
        joints, parents: the body's rest joints [55, 3] and its kinematic tree.
        shut_eyes: [E], the expression that shuts the body's eyes; zero where none does.

    Raises:
        UserError: the BVH file is missing or cannot be used.
    """
    draft = _Draft(
        np.arange(spec.frames) / spec.fps,
        np.zeros((spec.frames, len(JOINT_NAMES), 3)),
        np.zeros((spec.frames, len(shut_eyes))),
        np.random.default_rng([spec.seed, 1]),
        shut_eyes.numpy(),
    )
    for name in spec.layers:
        # Every layer has its own draws, so that adding one leaves the others as they were.
        draft.rng = np.random.default_rng([spec.seed, zlib.crc32(name.encode())])
        _LAYERS[name](draft)
    if not spec.is_bvh:
        _stand(draft)
        return MannequinMotion(
            _composed(draft.turns), torch.from_numpy(draft.expression).float(), torch.zeros(spec.frames, 3)
        )
    capture = read_bvh(Path(spec.motion))
    carried = retarget(capture, joints, parents, spec.frames, spec.fps, origin=spec.motion)
    rotation = carried.rotation.clone()
    face = [joint_index(name) for name in ("jaw", "left_eye", "right_eye")]
    rotation[:, face] = _composed(draft.turns)[:, face]
    expression = torch.from_numpy(draft.expression).float()
    return MannequinMotion(rotation, expression, carried.root, (f"{spec.motion}: {carried.note}",))


def _composed(turns: np.ndarray) -> Tensor:
    """Angles about X, Y and Z [T, 55, 3] as rotation vectors."""
    # The root turns about Y alone: kept as it is, it stays continuous over a whole turn.
    angles = torch.from_numpy(turns)
    rotation = roma.rotmat_to_rotvec(roma.euler_to_rotmat("XZY", angles[..., [0, 2, 1]]))
    rotation[:, 0] = torch.from_numpy(turns[:, 0])
    return rotation.float()


def _stand(draft: _Draft) -> None:
    """Arms down with slightly bent elbows and fingers; the others are added to this."""
    for side, sign in _SIDES:
        draft.add(f"{side}_shoulder", 2, -sign * ARMS_DOWN)
        draft.add(f"{side}_elbow", 1, -sign * 0.25)
        _curl_fingers(draft, side, sign, np.full(len(draft.seconds), 0.18))


def _turn(draft: _Draft) -> None:
    """One whole turn about the vertical over the clip, to the subject's left."""
    count = len(draft.seconds)
    draft.add("pelvis", 1, 2 * np.pi * np.arange(count) / count)


def _sway(draft: _Draft) -> None:
    """The trunk leans and turns a little, the weight shifts, and the head looks about."""
    draft.add("pelvis", 1, draft.wave(-0.35, 0.35, 0.08, 0.3))
    for joint in ("spine1", "spine2", "spine3"):
        draft.add(joint, 0, draft.wave(-0.03, 0.07, 0.1, 0.4))
        draft.add(joint, 1, draft.wave(-0.07, 0.07, 0.1, 0.4))
        draft.add(joint, 2, draft.wave(-0.04, 0.04, 0.1, 0.4))
    _look(draft, 0.5)


def _nod(draft: _Draft) -> None:
    """The head turns, nods and tilts."""
    draft.add("pelvis", 1, draft.wave(-0.2, 0.2, 0.08, 0.3))
    _look(draft, 1.0)


def _look(draft: _Draft, amount: float) -> None:
    for joint, share in (("neck", 0.45), ("head", 0.55)):
        draft.add(joint, 0, amount * share * draft.wave(-0.3, 0.4, 0.1, 0.5))
        draft.add(joint, 1, amount * share * draft.wave(-0.9, 0.9, 0.1, 0.4))
        draft.add(joint, 2, amount * share * draft.wave(-0.25, 0.25, 0.1, 0.4))


def _gesture(draft: _Draft) -> None:
    """Both arms move as in speech: raised before the body, elbows bent, wrists turning; feet stand."""
    for side, sign in _SIDES:
        draft.add(f"{side}_shoulder", 0, draft.wave(-0.65, 0.15))  # forwards
        draft.add(f"{side}_shoulder", 2, sign * draft.wave(-0.04, 0.3))  # away from the body
        draft.add(f"{side}_elbow", 1, -sign * draft.wave(0.3, 2.0))
        draft.add(f"{side}_elbow", 0, draft.wave(-0.1, 0.75))  # inwards, before the body
        draft.add(f"{side}_wrist", 0, draft.wave(-0.6, 0.4))
        draft.add(f"{side}_wrist", 1, sign * draft.wave(-0.3, 0.3))
        draft.add(f"{side}_wrist", 2, sign * draft.wave(-0.5, 0.5))
        draft.add(f"{side}_hip", 0, draft.wave(-0.15, 0.02, 0.1, 0.3))
        draft.add(f"{side}_knee", 0, draft.wave(0.02, 0.25, 0.1, 0.3))


def _curl(draft: _Draft) -> None:
    """Fists open and close, each finger a little on its own."""
    for side, sign in _SIDES:
        _curl_fingers(draft, side, sign, draft.wave(-0.1, 0.9, 0.2, 0.8))


def _curl_fingers(draft: _Draft, side: str, sign: float, bend: np.ndarray) -> None:
    for finger in ("index", "middle", "ring", "pinky"):
        own = bend * draft.rng.uniform(0.75, 1.15)
        for k, share in ((1, 0.9), (2, 1.1), (3, 0.7)):
            draft.add(f"{side}_{finger}{k}", 2, -sign * share * own)
    for k, share in ((1, 0.15), (2, 0.4), (3, 0.5)):
        draft.add(f"{side}_thumb{k}", 1, sign * share * bend)


def _speech(draft: _Draft) -> None:
    """The jaw opens and closes as in speech, the face changes, eyes look about and blink."""
    draft.add("jaw", 0, draft.bursts(0.28, 1.0, 3.5, -0.2))
    gaze = draft.wave(-0.25, 0.25, 0.2, 0.6), draft.wave(-0.12, 0.12, 0.2, 0.6)
    for side, _ in _SIDES:
        draft.add(f"{side}_eye", 1, gaze[0])
        draft.add(f"{side}_eye", 0, gaze[1])
    # The first parameters carry most of the face; those of the open body are symmetric face units.
    for unit in range(min(20, draft.expression.shape[1])):
        height = draft.rng.uniform(0.3, 1.2)
        draft.expression[:, unit] += draft.bursts(height, 0.3, 1.6, 0.25)


def _eyes(draft: _Draft) -> None:
    """Blinks, and looks from one place to the next: jumps of both eyes, as eyes move."""
    seconds, rng = draft.seconds, draft.rng
    lids, gaze = np.zeros(len(seconds)), np.zeros((len(seconds), 2))
    at = rng.uniform(0.1, 0.5)
    while at < seconds[-1]:
        shut = at + _CLOSING + rng.uniform(0, _SHUT)
        course = np.interp(seconds, [at, at + _CLOSING, shut, shut + _OPENING], [0.0, 1.0, 1.0, 0.0])
        lids = np.maximum(lids, course)
        at = shut + _OPENING + rng.uniform(*_BETWEEN_BLINKS)
    at = 0.0
    while at < seconds[-1]:
        target = rng.uniform(-1, 1, 2) * _GAZE
        gaze[seconds >= at] = target
        at += rng.uniform(*_LOOKS_FOR)
    draft.expression += lids[:, None] * draft.shut_eyes
    for side, _ in _SIDES:
        draft.add(f"{side}_eye", 0, gaze[:, 0])
        draft.add(f"{side}_eye", 1, gaze[:, 1])


_LAYERS: dict[str, Callable[[_Draft], None]] = {
    "stand": lambda draft: None,
    "turn": _turn,
    "sway": _sway,
    "gesture": _gesture,
    "curl": _curl,
    "speech": _speech,
    "nod": _nod,
    "eyes": _eyes,
}
