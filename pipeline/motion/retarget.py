"""Motion capture carried over to the body: a BVH skeleton's motion as SMPL-X rotations.

Skeletons differ in the axes that their joints use and in the pose that zero angles mean, so neither is
asked. At one frame, the one with the straightest limbs, each joint's world orientation is found from
directions: the trunk from hips, shoulders and neck, the hands from the roots of the fingers, limbs and
fingers by the shortest turn that lays the bone where the capture has it. From there on each joint turns
as its captured joint does.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import roma
import torch
from torch import Tensor

from pipeline.body import JOINT_NAMES
from pipeline.errors import UserError
from pipeline.motion.bvh import Bvh, world_motion

_SIDED = {
    "hip": ("upleg", "hip", "thigh"),
    "knee": ("leg", "knee", "shin"),
    "ankle": ("foot", "ankle"),
    "foot": ("toebase", "toe"),
    "collar": ("collar", "shoulder"),
    "shoulder": ("arm", "uparm", "shoulder"),  # some call the collar so, some this
    "elbow": ("forearm", "elbow", "lowarm"),
    "wrist": ("hand", "wrist"),
} | {
    f"{finger}{k}": (f"hand{finger}{k}",)
    for finger in ("index", "middle", "pinky", "ring", "thumb")
    for k in (1, 2, 3)
}
_MIDDLE = {
    "pelvis": ("hips", "hip", "pelvis"),
    "spine1": ("spine", "abdomen"),
    "spine2": ("spine1", "chest"),
    "spine3": ("spine2", "chest2"),
    "neck": ("neck",),
    "head": ("head",),
}
_NEEDED = (
    "pelvis",
    "neck",
    "left_hip",
    "right_hip",
    "left_shoulder",
    "right_shoulder",
    "left_elbow",
    "right_elbow",
)
_BONES = {  # joint -> where its bone ends
    f"{side}_{start}": f"{side}_{end}"
    for side in ("left", "right")
    for start, end in (
        ("hip", "knee"), ("knee", "ankle"), ("ankle", "foot"), ("shoulder", "elbow"), ("elbow", "wrist"),
        *((f"{f}{k}", f"{f}{k + 1}") for f in ("index", "middle", "pinky", "ring", "thumb") for k in (1, 2)),
    )
}  # fmt: skip
_KNUCKLES = ("index1", "middle1", "ring1", "pinky1")
_INDEX = {name: index for index, name in enumerate(JOINT_NAMES)}


def retarget(
    bvh: Bvh,
    joints: Tensor,  # [55, 3]
    parents: tuple[int, ...],
    count: int,
    fps: float,
) -> tuple[Tensor, Tensor]:
    """The capture's motion on another skeleton.

    Args:
        bvh: the capture, Y up.
        joints: the body's rest joints, metres.
        parents: the body's kinematic tree.
        count: T, how many frames; a capture that is shorter runs back and forth.
        fps: frames a second.

    Returns:
        rotation [T, 55, 3], rotation vectors, and root [T, 3], metres, the pelvis' place relative to
        the first frame. The body faces +Z in the first frame. float32.

    Raises:
        UserError: the skeleton lacks hips, shoulders, elbows or a neck that we know by name.
    """
    return retarget_rows(bvh, joints, parents, frame_indices(len(bvh.values), bvh.fps, count, fps))


def retarget_rows(
    bvh: Bvh,
    joints: Tensor,  # [55, 3]
    parents: tuple[int, ...],
    rows: np.ndarray,  # [T]
    reference: np.ndarray | None = None,  # [R]
) -> tuple[Tensor, Tensor]:
    """As ``retarget``, of chosen rows of the capture's table.

    Args:
        bvh, joints, parents: as for ``retarget``.
        rows: the frames that are wanted.
        reference: the frames among which the one with the straightest limbs is sought; ``rows`` if None.
    """
    columns = match_joints(bvh.names)
    reference = rows if reference is None else reference
    orientations, positions = world_motion(bvh, np.concatenate([reference, rows]))
    rest = joints.double()
    places = {name: positions[:, column] for name, column in columns.items()}
    start, wanted = straightest({name: p[: len(reference)] for name, p in places.items()}), len(reference)
    at_start = reference_orientations({name: p[start] for name, p in places.items()}, rest, parents)
    world: list[Tensor] = []
    for joint, name in enumerate(JOINT_NAMES):
        if name in columns:
            turned = orientations[:, columns[name]]
            world.append(turned[wanted:] @ turned[start].mT @ at_start[joint])
        else:
            world.append(world[parents[joint]])
    facing = yaw(world[0][0]).mT
    local = [facing @ world[0]] + [world[p].mT @ w for p, w in zip(parents[1:], world[1:], strict=True)]
    metres = _leg(rest) / _leg_of(places, start)
    root = (places["pelvis"][wanted:] - places["pelvis"][wanted]) @ facing.mT * metres
    return roma.rotmat_to_rotvec(torch.stack(local, dim=1)).float(), root.float()


def match_joints(names: tuple[str, ...], origin: str = "the BVH skeleton") -> dict[str, int]:
    """SMPL-X joint -> place in a capture's list of joints, by the names in common use.

    Args:
        names: the capture's joints.
        origin: the file, for the message.

    Raises:
        UserError: hips, shoulders, elbows or neck are not among them.
    """
    plain = {
        name.rpartition(":")[2].replace("_", "").lower(): place
        for place, name in reversed([*enumerate(names)])
    }
    found = {}
    for joint in JOINT_NAMES:
        side, _, part = joint.partition("_")
        words = _MIDDLE.get(joint, ()) if not part else tuple(side + word for word in _SIDED.get(part, ()))
        place = next((plain[word] for word in words if word in plain), None)
        if place is not None:
            found[joint] = place
    for side in ("left", "right"):
        if found.get(f"{side}_collar", -1) == found.get(f"{side}_shoulder"):
            del found[f"{side}_collar"]
    missing = [joint for joint in _NEEDED if joint not in found]
    if missing:
        raise UserError(
            f"{origin} has no joint known as {', '.join(missing)} (it has {', '.join(names[:12])}, ...): "
            "name its joints as Mixamo does"
        )
    return found


def frame_indices(available: int, own_fps: float, count: int, fps: float) -> np.ndarray:
    """The rows of the capture's table that show ``count`` frames at ``fps``: [count] int64."""
    rows = np.round(np.arange(count) * own_fps / fps).astype(np.int64)
    period = max(2 * (available - 1), 1)
    rows %= period
    return np.where(rows < available, rows, period - rows)


def straightest(places: Mapping[str, Tensor]) -> int:
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
    places: Mapping[str, Tensor], rest: Tensor, parents: tuple[int, ...]
) -> list[Tensor]:
    """World orientation of each joint at one frame: 55 x [3, 3], the identity being the T pose."""
    hips = _trunk(places, "hip") @ _trunk(_named(rest), "hip").mT
    shoulders = _trunk(places, "shoulder") @ _trunk(_named(rest), "shoulder").mT
    world: list[Tensor] = []
    for joint, name in enumerate(JOINT_NAMES):
        above = world[parents[joint]] if joint else hips
        end = _BONES.get(name)
        if name in ("spine2", "spine3"):
            world.append(shoulders)
        elif name.endswith("wrist"):
            world.append(_palm(name, places, rest, above))
        elif end is not None and end in places and name in places:
            there = places[end] - places[name]
            world.append(_shortest_turn(above @ (rest[_INDEX[end]] - rest[joint]), there) @ above)
        else:
            world.append(above)
    return world


def _named(rest: Tensor) -> dict[str, Tensor]:
    return {name: rest[joint] for name, joint in _INDEX.items()}


def _trunk(places: Mapping[str, Tensor], pair: str) -> Tensor:
    """Axes as columns, [3, 3]: to the subject's left along a pair of joints, up the trunk, and forward."""
    across = places[f"left_{pair}"] - places[f"right_{pair}"]
    up = places["neck"] - (places["left_hip"] + places["right_hip"]) / 2
    across = across / across.norm()
    up = up - (up @ across) * across
    up = up / up.norm()
    return torch.stack([across, up, torch.linalg.cross(across, up)], dim=1)


def _palm(name: str, places: Mapping[str, Tensor], rest: Tensor, above: Tensor) -> Tensor:
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


def yaw(orientation: Tensor) -> Tensor:
    """The part of an orientation [3, 3] that is a turn about the vertical."""
    forward = orientation[:, 2]
    angle = torch.atan2(forward[0], forward[2])
    return roma.rotvec_to_rotmat(torch.stack([angle * 0, angle, angle * 0]))


def _leg(rest: Tensor) -> Tensor:
    return (rest[_INDEX["left_hip"]] - rest[_INDEX["left_knee"]]).norm()


def _leg_of(places: Mapping[str, Tensor], frame: int) -> Tensor:
    """The capture's thigh, in its own unit; without knees, the same from the trunk's length."""
    if "left_knee" in places:
        return (places["left_hip"][frame] - places["left_knee"][frame]).norm()
    return 0.7 * (places["neck"][frame] - places["pelvis"][frame]).norm()
