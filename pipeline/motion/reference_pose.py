"""The body's orientation at one pose of a captured skeleton, from which on each joint turns as captured.

Where the skeleton stands upright with straight limbs when all angles are zero, that is the pose: the trunk
is upright there by construction, whatever the places of its joints, and so are feet and head. Else it is the
frame of the capture with the straightest limbs, and the trunk is found from hips, shoulders and neck.

Limbs and fingers are laid along the captured bones by the shortest turn, hands along the fingers' roots.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import roma
import torch
from torch import Tensor

from pipeline.body import JOINT_NAMES
from pipeline.config.choices import UpAxis
from pipeline.motion.up_axis import AXES, nearest_axis

_BONES = {  # joint -> where its bone ends
    f"{side}_{start}": f"{side}_{end}"
    for side in ("left", "right")
    for start, end in (
        ("hip", "knee"), ("knee", "ankle"), ("ankle", "foot"), ("shoulder", "elbow"), ("elbow", "wrist"),
        *((f"{f}{k}", f"{f}{k + 1}") for f in ("index", "middle", "pinky", "ring", "thumb") for k in (1, 2)),
    )
}  # fmt: skip
_KNUCKLES = ("index1", "middle1", "ring1", "pinky1")
_SPINE = ("spine1", "spine2", "spine3")
_INDEX = {name: index for index, name in enumerate(JOINT_NAMES)}
_UPRIGHT = math.cos(math.radians(30))  # trunk and axis
_SPREAD = math.cos(math.radians(40))  # legs and axis: skeletons may stand with legs apart
_CURVED = math.cos(math.radians(60))  # one bone of the spine and axis
_LEVEL = math.sin(math.radians(20))  # the line of the hips
_STRAIGHT = math.cos(math.radians(45))  # upper and lower arm
_POINTED = math.cos(math.radians(55))  # a foot that points farther down is no foot on the ground

Places = Mapping[str, Tensor]
"""Joint -> its place [3], or [T, 3]; joints that the capture lacks are missing."""


@dataclasses.dataclass(frozen=True)
class Stance:
    """How a skeleton stands where all angles are zero.

    Attributes:
        up: the axis of the file along which its trunk points.
        frame: [3, 3] float64, from the body's axes (X to its left, Y up, Z forward) to the file's.
    """

    up: UpAxis
    frame: Tensor


def stance(places: Places) -> Stance | None:
    """How a skeleton stands; None where it is not upright, or its limbs are bent.

    Args:
        places: [3] each, where all angles are zero.
    """
    middle = (places["left_hip"] + places["right_hip"]) / 2
    trunk, across = top_of_trunk(places) - middle, places["left_hip"] - places["right_hip"]
    if not (_length(trunk) > 0 and _length(across) > 0):
        return None
    up, _ = nearest_axis(trunk)
    axis = AXES[up].to(trunk)
    if not (_cosine(trunk, axis) > _UPRIGHT and abs(_cosine(across, axis)) < _LEVEL):
        return None
    if not (_spine_is_straight(places, axis, _length(trunk)) and _limbs_are_straight(places, axis)):
        return None
    left = across - (across @ axis) * axis
    left = left / left.norm()
    return Stance(up, torch.stack([left, axis, torch.linalg.cross(left, axis)], dim=1))


def top_of_trunk(places: Places) -> Tensor:
    """The neck's place, or what is between the shoulders."""
    if "neck" in places:
        return places["neck"]
    return (places["left_shoulder"] + places["right_shoulder"]) / 2


def straightest(places: Places) -> int:
    """The frame in which elbows and knees are bent least; ``places`` are [T, 3] each."""
    score = torch.zeros(len(places["pelvis"]), dtype=torch.float64)
    for side in ("left", "right"):
        for a, b, c in (("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle")):
            chain = [places.get(f"{side}_{name}") for name in (a, b, c)]
            if all(place is not None for place in chain):
                upper, lower = chain[1] - chain[0], chain[2] - chain[1]  # type: ignore[operator]
                score += torch.nn.functional.cosine_similarity(upper, lower, dim=-1)
    return int(score.argmax())


def reference_orientations(
    places: Places, rest: Tensor, parents: tuple[int, ...], standing: Stance | None = None
) -> list[Tensor]:
    """World orientation of each joint at one pose: 55 x [3, 3], the identity being the T pose.

    Args:
        places: [3] each.
        rest: [55, 3], the body's rest joints.
        standing: how the skeleton stands, where this is its pose of zero angles.
    """
    own = {name: place for name, place in _named(rest).items() if name in places or name != "neck"}
    trunks = {pair: _trunk(places, pair) @ _trunk(own, pair).mT for pair in ("hip", "shoulder")}
    world: list[Tensor] = []
    for joint, name in enumerate(JOINT_NAMES):
        above = world[parents[joint]] if joint else trunks["hip"]
        bone = _bone(name, places, rest)
        if standing is not None and name in ("pelvis", "left_ankle", "right_ankle"):
            world.append(standing.frame if bone is None else _foot(standing, *bone))
        elif standing is None and name in ("spine2", "spine3"):
            world.append(trunks["shoulder"])
        elif name.endswith("wrist"):
            world.append(_palm(name, places, rest, above))
        elif bone is not None:
            here, there = bone
            world.append(_shortest_turn(above @ here, there) @ above)
        else:
            world.append(above)
    return world


def _bone(name: str, places: Places, rest: Tensor) -> tuple[Tensor, Tensor] | None:
    """A joint's bone at rest and as captured, [3] each; None where an end is missing or it has none."""
    end = _BONES.get(name)
    if end is None or end not in places or name not in places:
        return None
    return rest[_INDEX[end]] - rest[_INDEX[name]], places[end] - places[name]


def _named(rest: Tensor) -> dict[str, Tensor]:
    return {name: rest[joint] for name, joint in _INDEX.items()}


def _spine_is_straight(places: Places, axis: Tensor, trunk: float) -> bool:
    line = [places[name] for name in ("pelvis", *_SPINE) if name in places] + [top_of_trunk(places)]
    bones = [b - a for a, b in zip(line[:-1], line[1:], strict=True)]
    return all(_cosine(bone, axis) > _CURVED for bone in bones if _length(bone) > 0.05 * trunk)


def _limbs_are_straight(places: Places, axis: Tensor) -> bool:
    for side in ("left", "right"):
        for start, end in (("hip", "knee"), ("knee", "ankle")):
            if f"{side}_{end}" in places and f"{side}_{start}" in places:
                bone = places[f"{side}_{end}"] - places[f"{side}_{start}"]
                if not _cosine(bone, -axis) > _SPREAD:
                    return False
        if f"{side}_wrist" in places:
            shoulder, elbow, wrist = (places[f"{side}_{part}"] for part in ("shoulder", "elbow", "wrist"))
            if not _cosine(elbow - shoulder, wrist - elbow) > _STRAIGHT:
                return False
    return True


def _foot(standing: Stance, rest: Tensor, there: Tensor) -> Tensor:
    """A standing foot's orientation: level, with the captured heading; pointed feet as any other bone."""
    up, here = standing.frame[:, 1], standing.frame @ rest
    if not _length(there - (there @ up) * up) > _POINTED * _length(there):
        return _shortest_turn(here, there) @ standing.frame
    level = [one - (one @ up) * up for one in (here, there)]
    return _shortest_turn(*level) @ standing.frame


def _trunk(places: Places, pair: str) -> Tensor:
    """Axes as columns, [3, 3]: to the subject's left along a pair of joints, up the trunk, and forward."""
    across = places[f"left_{pair}"] - places[f"right_{pair}"]
    up = top_of_trunk(places) - (places["left_hip"] + places["right_hip"]) / 2
    across = across / across.norm()
    up = up - (up @ across) * across
    up = up / up.norm()
    return torch.stack([across, up, torch.linalg.cross(across, up)], dim=1)


def _palm(name: str, places: Places, rest: Tensor, above: Tensor) -> Tensor:
    """A hand's orientation from the knuckles that are known; the forearm's where fewer than two are."""
    side = name.partition("_")[0]
    known = [f"{side}_{knuckle}" for knuckle in _KNUCKLES if f"{side}_{knuckle}" in places]
    if len(known) < 2 or name not in places:
        return above
    here = torch.stack([rest[_INDEX[knuckle]] - rest[_INDEX[name]] for knuckle in known])
    there = torch.stack([places[knuckle] - places[name] for knuckle in known])
    unit = torch.nn.functional.normalize
    return roma.rigid_vectors_registration(unit(here, dim=-1), unit(there, dim=-1))


def _shortest_turn(here: Tensor, there: Tensor) -> Tensor:
    """The rotation [3, 3] by the smallest angle that lays one vector along another."""
    axis = torch.linalg.cross(here, there)
    angle = torch.atan2(axis.norm(), here @ there)
    return roma.rotvec_to_rotmat(axis / axis.norm().clamp_min(1e-12) * angle)


def _length(vector: Tensor) -> float:
    return float(vector.norm())


def _cosine(a: Tensor, b: Tensor) -> float:
    return float(torch.nn.functional.cosine_similarity(a, b, dim=-1))
