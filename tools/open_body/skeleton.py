"""From MakeHuman's 163 bones in A pose to the 55 SMPL-X joints in T pose."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from open_body.makehuman import BaseMesh, Rig

FINGERS = {"index": 2, "middle": 3, "pinky": 5, "ring": 4, "thumb": 1}  # SMPL-X's order -> MakeHuman's number
SIDES = {"left": "L", "right": "R"}

JOINTS: tuple[str, ...] = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle",
    "right_ankle", "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head",
    "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist",
    "jaw", "left_eye", "right_eye",
    *(f"{side}_{finger}{k}" for side in SIDES for finger in FINGERS for k in (1, 2, 3)),
)  # fmt: skip
PARENTS: tuple[int, ...] = (
    -1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 15, 15, 15,
    *(parent for wrist, first in ((20, 25), (21, 40)) for k in range(first, first + 15, 3)
      for parent in (wrist, k, k + 1)),
)  # fmt: skip
JOINT = {name: index for index, name in enumerate(JOINTS)}

# Two bones more while the pose is changed: the fore-arm's far half takes half of the wrist's twist.
TWIST = {"left": 55, "right": 56}
_TWIST_PARENTS = (*PARENTS, JOINT["left_elbow"], JOINT["right_elbow"])

_CENTRAL = {  # joint -> the bones that it moves; it lies at the first one's head, or as _PLACED says
    "pelvis": "root pelvis.L pelvis.R spine05",
    "spine1": "spine04",
    "spine2": "spine03",
    "spine3": "spine02 spine01 breast.L breast.R",
    "neck": "neck01 neck02 neck03",
    "head": "head",
    "jaw": "jaw special04 oris02 oris01 oris06.L oris07.L oris06.R oris07.R",
}
_LATERAL = {
    "hip": "upperleg01 upperleg02",
    "knee": "lowerleg01 lowerleg02",
    "ankle": "foot",
    "collar": "clavicle shoulder01",
    "shoulder": "upperarm01 upperarm02",
    "elbow": "lowerarm01 lowerarm02",
    "wrist": "wrist metacarpal1 metacarpal2 metacarpal3 metacarpal4",
    "eye": "eye",
}
_PLACED = {"pelvis": "spine05", "left_foot": "toe2-1.L", "right_foot": "toe2-1.R"}


def bones_of_joints(rig: Rig) -> dict[str, list[str]]:
    """The bones that follow each joint; bones of the face that no joint names follow the head."""
    bones = {joint: names.split() for joint, names in _CENTRAL.items()}
    bones["jaw"] += [bone for bone in rig.bones if bone.startswith("tongue")]
    for side, letter in SIDES.items():
        for joint, names in _LATERAL.items():
            bones[f"{side}_{joint}"] = [f"{name}.{letter}" for name in names.split()]
        toes = (bone for bone in rig.bones if bone.startswith("toe") and bone.endswith(f".{letter}"))
        bones[f"{side}_foot"] = list(toes)
        for finger, number in FINGERS.items():
            for k in (1, 2, 3):
                bones[f"{side}_{finger}{k}"] = [f"finger{number}-{k}.{letter}"]
    taken = {bone for names in bones.values() for bone in names}
    bones["head"] += [bone for bone in rig.bones if bone not in taken]
    return bones


def twist_weights(rig: Rig, mesh: BaseMesh, kept: np.ndarray) -> np.ndarray:
    """Skinning weights over the 55 joints and the two twist bones: [V, 57], rows sum to 1."""
    column = {bone: JOINT[joint] for joint, bones in bones_of_joints(rig).items() for bone in bones}
    column |= {f"lowerarm02.{letter}": TWIST[side] for side, letter in SIDES.items()}
    weights = np.zeros((len(mesh.vertices), len(JOINTS) + len(TWIST)))
    for bone, pairs in rig.weights.items():
        for vertex, weight in pairs:
            weights[vertex, column[bone]] += weight
    for side in SIDES:  # eyeballs are rigid
        eyeball = mesh.vertices_of(f"helper-{side[0]}-eye")
        weights[eyeball] = 0
        weights[eyeball, JOINT[f"{side}_eye"]] = 1
    weights = weights[kept]
    return weights / weights.sum(1, keepdims=True)


def without_twist(weights: np.ndarray) -> np.ndarray:
    """The twist bones' weights given back to the elbows: [V, 57] -> [V, 55]."""
    merged = weights[:, : len(JOINTS)].copy()
    for side, bone in TWIST.items():
        merged[:, JOINT[f"{side}_elbow"]] += weights[:, bone]
    return merged


@dataclasses.dataclass(frozen=True)
class TPoser:
    """Takes persons from MakeHuman's A pose to a T pose, each by that person's own joints."""

    rig: Rig
    kept: np.ndarray  # [V]
    weights: np.ndarray  # [V, 57]

    def joints(self, vertices: np.ndarray) -> np.ndarray:
        """The 55 joints of a person in A pose: [M, 3] -> [55, 3]."""
        bones = bones_of_joints(self.skinning_tables)
        return np.stack(
            [self.skinning_tables.end(vertices, _PLACED.get(name, bones[name][0])) for name in JOINTS]
        )

    def __call__(self, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """T pose of a person's base mesh.

        Returns:
            the kept vertices [V, 3] and the joints [55, 3], metres.
        """
        joints = self.joints(vertices)
        rotations = np.tile(np.eye(3), (len(_TWIST_PARENTS), 1, 1))
        for side, sign in (("left", 1.0), ("right", -1.0)):
            _straighten_arm(rotations, joints, side, sign)
            self._straighten_fingers(rotations, joints, vertices, side, sign)
            _straighten_leg(rotations, joints, side, sign)
        twist = [self.skinning_tables.end(vertices, f"lowerarm02.{letter}") for letter in SIDES.values()]
        rest = np.concatenate([joints, twist])
        posed = rest.copy()
        for j, parent in enumerate(_TWIST_PARENTS):
            if parent >= 0:
                posed[j] = posed[parent] + rotations[parent] @ (rest[j] - rest[parent])
        shift = posed - np.einsum("jab,jb->ja", rotations, rest)
        moved = np.einsum("vj,jab,vb->va", self.weights, rotations, vertices[self.kept], optimize=True)
        return moved + self.weights @ shift, posed[: len(JOINTS)]

    def _straighten_fingers(
        self, rotations: np.ndarray, joints: np.ndarray, vertices: np.ndarray, side: str, sign: float
    ) -> None:
        """Fingers straight in the palm's plane, spread by 0.6 of what they were; the thumb as it is."""
        palm = rotations[JOINT[f"{side}_wrist"]]
        for finger, number in FINGERS.items():
            first = JOINT[f"{side}_{finger}1"]
            tip = self.skinning_tables.end(vertices, f"finger{number}-3.{SIDES[side]}", "tail")
            chain = [*joints[first : first + 3], tip]
            along = palm @ (chain[1] - chain[0])
            spread = 0.6 * np.arctan2(along[2], abs(along[0]))
            straight = np.array([sign * np.cos(spread), 0, np.sin(spread)])
            for k in range(3):
                bone = palm @ (chain[k + 1] - chain[k])
                rotations[first + k] = palm if finger == "thumb" else shortest_rotation(bone, straight) @ palm


def _straighten_arm(rotations: np.ndarray, joints: np.ndarray, side: str, sign: float) -> None:
    """Arm along X with the elbow's flexion axis upright, palm down, collar lifted by 0.18 rad."""
    collar, shoulder, elbow, wrist = (JOINT[f"{side}_{k}"] for k in ("collar", "shoulder", "elbow", "wrist"))
    outward, flexion = np.array([sign, 0, 0]), np.array([0, -sign, 0])
    upper, lower = joints[elbow] - joints[shoulder], joints[wrist] - joints[elbow]
    rotations[collar] = Rotation.from_rotvec([0, 0, 0.18 * sign]).as_matrix()
    rotations[shoulder] = aligning(upper, np.cross(upper, lower), outward, flexion)
    rotations[elbow] = aligning(lower, np.cross(upper, lower), outward, flexion)
    across = joints[JOINT[f"{side}_pinky1"]] - joints[JOINT[f"{side}_index1"]]
    along = joints[JOINT[f"{side}_middle1"]] - joints[wrist]
    rotations[wrist] = aligning(along, across, outward, np.array([0, 0, -1]))
    twist = Rotation.from_matrix(rotations[wrist] @ rotations[elbow].T)
    rotations[TWIST[side]] = (twist**0.5).as_matrix() @ rotations[elbow]


def _straighten_leg(rotations: np.ndarray, joints: np.ndarray, side: str, sign: float) -> None:
    """Leg nearly upright, foot nearly straight ahead and as inclined as it was."""
    hip, knee, ankle, foot = (JOINT[f"{side}_{k}"] for k in ("hip", "knee", "ankle", "foot"))
    rotations[hip] = rotations[knee] = shortest_rotation(
        joints[ankle] - joints[hip], np.array([0.05 * sign, -1, 0])
    )
    level = (joints[foot] - joints[ankle]) * [1, 0, 1]
    rotations[ankle] = rotations[foot] = shortest_rotation(level, np.array([0.12 * sign, 0, 1]))


def aligning(from_first: np.ndarray, from_second: np.ndarray, to_first: np.ndarray, to_second: np.ndarray):
    """The rotation [3, 3] that carries one direction exactly and a second as nearly as possible."""
    return _frame(to_first, to_second) @ _frame(from_first, from_second).T


def _frame(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """A right-handed orthonormal basis, as columns, whose first axis and first plane are given."""
    first = first / np.linalg.norm(first)
    second = second - first * (first @ second)
    second = second / np.linalg.norm(second)
    return np.stack([first, second, np.cross(first, second)], axis=1)


def shortest_rotation(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The rotation [3, 3] by the smallest angle from one direction to another, not opposite, one."""
    source, target = source / np.linalg.norm(source), target / np.linalg.norm(target)
    axis = np.cross(source, target)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + cross + cross @ cross / (1 + source @ target)
