"""Motion capture carried over to the body: a BVH skeleton's motion as SMPL-X rotations.

Skeletons differ in the axes that their joints use and in the pose that zero angles mean. At one pose each
joint's world orientation is found from directions (``reference_pose``); from there on each joint turns as its
captured joint does. The world is turned so that Y is up (``up_axis``).
"""

from __future__ import annotations

import dataclasses

import numpy as np
import roma
import torch
from torch import Tensor

from pipeline.body import JOINT_NAMES
from pipeline.config.choices import Up, UpAxis
from pipeline.errors import UserError
from pipeline.motion.bvh import Bvh, world_motion, zero_places
from pipeline.motion.joint_names import match_joints
from pipeline.motion.reference_pose import (
    Places,
    Stance,
    reference_orientations,
    stance,
    straightest,
    top_of_trunk,
)
from pipeline.motion.up_axis import find_up, turn_to_y

_INDEX = {name: index for index, name in enumerate(JOINT_NAMES)}


@dataclasses.dataclass(frozen=True)
class CarriedMotion:
    """A capture's motion on the body, T frames, float32. Y is up; the body faces +Z in the first frame.

    Attributes:
        rotation: [T, 55, 3], rotation vectors, radians, relative to the parent joint.
        root: [T, 3], metres, the pelvis' place relative to the first frame.
        told: the body's joints that the capture tells of.
        unused: the capture's joints that have no counterpart.
        up: the axis that was up in the capture.
        note: which axis that was and what said so, for people.
    """

    rotation: Tensor  # [T, 55, 3]
    root: Tensor  # [T, 3]
    told: tuple[str, ...]
    unused: tuple[str, ...]
    up: UpAxis
    note: str


def retarget(
    bvh: Bvh,
    joints: Tensor,  # [55, 3]
    parents: tuple[int, ...],
    count: int,
    fps: float,
    origin: str = "the BVH skeleton",
) -> CarriedMotion:
    """The capture's motion on another skeleton.

    Args:
        bvh: the capture.
        joints: the body's rest joints, metres.
        parents: the body's kinematic tree.
        count: T, how many frames; a capture that is shorter runs back and forth.
        fps: frames a second.
        origin: the file, for messages.

    Raises:
        UserError: the skeleton lacks a joint that is needed and known by name, or its bones have no length.
    """
    return retarget_rows(
        bvh, joints, parents, frame_indices(len(bvh.values), bvh.fps, count, fps), origin=origin
    )


def retarget_rows(
    bvh: Bvh,
    joints: Tensor,  # [55, 3]
    parents: tuple[int, ...],
    rows: np.ndarray,  # [T]
    reference: np.ndarray | None = None,  # [R]
    up: Up = "auto",
    origin: str = "the BVH skeleton",
) -> CarriedMotion:
    """As ``retarget``, of chosen rows of the capture's table.

    Args:
        bvh, joints, parents, origin: as for ``retarget``.
        rows: the frames that are wanted.
        reference: the frames that show how the body stands, and, where zero angles do not, among which the
            one with the straightest limbs is sought; ``rows`` if None.
        up: the axis that is up in the capture; auto: found.
    """
    columns = match_joints(bvh.names, bvh.parents, origin)
    reference = rows if reference is None else reference
    orientations, positions = world_motion(bvh, np.concatenate([reference, rows]))
    wanted, rest = len(reference), joints.double()
    places = {name: positions[:, column] for name, column in columns.items()}
    shown = {name: place[:wanted] for name, place in places.items()}
    at_zero = zero_places(bvh)
    still = {name: at_zero[column] for name, column in columns.items()}
    standing = stance(still)
    axis, witness = _up(up, shown, positions[:wanted], standing)
    if standing is not None:
        start, scale = (
            torch.eye(3, dtype=torch.float64).expand(len(bvh.names), 3, 3),
            _leg(rest) / _leg_of(still),
        )
        at_start = reference_orientations(still, rest, parents, standing)
    else:
        frame = straightest(shown)
        at_frame = {name: place[frame] for name, place in places.items()}
        start, scale = orientations[frame], _leg(rest) / _leg_of(at_frame)
        at_start = reference_orientations(at_frame, rest, parents)
    turn = turn_to_y(axis)
    world: list[Tensor] = []
    for joint, name in enumerate(JOINT_NAMES):
        if name in columns:
            turned = orientations[wanted:, columns[name]]
            world.append(turn @ turned @ start[columns[name]].mT @ at_start[joint])
        else:
            world.append(world[parents[joint]])
    facing = yaw(world[0][0]).mT
    local = [facing @ world[0]] + [world[p].mT @ w for p, w in zip(parents[1:], world[1:], strict=True)]
    way = (places["pelvis"][wanted:] - places["pelvis"][wanted]) @ turn.mT
    used = set(columns.values())
    return CarriedMotion(
        rotation=_finite(roma.rotmat_to_rotvec(torch.stack(local, dim=1)), origin).float(),
        root=_finite(way @ facing.mT * scale, origin).float(),
        told=tuple(columns),
        unused=tuple(name for place, name in enumerate(bvh.names) if place not in used),
        up=axis,
        note=f"{axis.upper()} is up ({witness})" + ("" if axis == "y" else " and was turned to Y up"),
    )


def frame_indices(available: int, own_fps: float, count: int, fps: float) -> np.ndarray:
    """The rows of the capture's table that show ``count`` frames at ``fps``: [count] int64."""
    rows = np.round(np.arange(count) * own_fps / fps).astype(np.int64)
    period = max(2 * (available - 1), 1)
    rows %= period
    return np.where(rows < available, rows, period - rows)


def yaw(orientation: Tensor) -> Tensor:
    """The part of an orientation [3, 3] that is a turn about the vertical."""
    forward = orientation[:, 2]
    angle = torch.atan2(forward[0], forward[2])
    return roma.rotvec_to_rotmat(torch.stack([angle * 0, angle, angle * 0]))


def _up(up: Up, places: Places, everything: Tensor, standing: Stance | None) -> tuple[UpAxis, str]:
    """The axis that is up, and what says so."""
    if up != "auto":
        return up, "as it was said"
    unit = torch.nn.functional.normalize
    hips, feet = (
        (places[f"left_{part}"] + places[f"right_{part}"]) / 2
        for part in ("hip", next((part for part in ("ankle", "knee") if _both(places, part)), "hip"))
    )
    upward = unit(top_of_trunk(places) - hips, dim=-1) + unit(hips - feet, dim=-1)
    leg = float((hips - feet).norm(dim=-1).max())
    return find_up(upward, everything, leg, standing.up if standing else None)


def _both(places: Places, part: str) -> bool:
    return f"left_{part}" in places and f"right_{part}" in places


def _leg(rest: Tensor) -> Tensor:
    return (rest[_INDEX["left_hip"]] - rest[_INDEX["left_knee"]]).norm()


def _leg_of(places: Places) -> Tensor:
    """The capture's thigh, in its own unit; without knees, the same from the trunk's length."""
    if "left_knee" in places:
        return (places["left_hip"] - places["left_knee"]).norm()
    return 0.7 * (top_of_trunk(places) - places["pelvis"]).norm()


def _finite(values: Tensor, origin: str) -> Tensor:
    if not torch.isfinite(values).all():
        raise UserError(f"{origin}: bones of its trunk or legs have no length: name another file")
    return values
