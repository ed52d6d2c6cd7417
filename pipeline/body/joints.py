"""The 55 joints of the SMPL-X schema, in the order that every pose in this project has them.

Source: the SMPL-X model (Pavlakos et al. 2019); its files carry the tree as ``kintree_table`` and,
in newer releases only, no names at all, so the names are written down here.
"""

from __future__ import annotations

_BODY = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle",
    "right_ankle", "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head",
    "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist",
)  # fmt: skip
_HEAD = ("jaw", "left_eye", "right_eye")

FINGERS = ("index", "middle", "pinky", "ring", "thumb")
"""The fingers in the order in which the schema lists their joints, three each."""

JOINT_NAMES: tuple[str, ...] = (
    *_BODY,
    *_HEAD,
    *(f"{side}_{finger}{k}" for side in ("left", "right") for finger in FINGERS for k in (1, 2, 3)),
)
"""The names of the 55 joints: 22 of the body, jaw and eyes, 15 of each hand."""

_INDEX = {name: index for index, name in enumerate(JOINT_NAMES)}


def joint_index(name: str) -> int:
    """The place of a joint in every [..., 55, ...] array.

    Raises:
        KeyError: there is no joint of that name.

    >>> joint_index("left_wrist")
    20
    """
    return _INDEX[name]


GLOBAL_ORIENT = slice(0, 1)
BODY_POSE = slice(1, 22)
JAW = 22
LEFT_EYE = 23
RIGHT_EYE = 24
LEFT_HAND = slice(25, 40)
RIGHT_HAND = slice(40, 55)
