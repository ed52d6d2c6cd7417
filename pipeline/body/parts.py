"""The parts of the body, and the part that each vertex belongs to."""

from __future__ import annotations

from typing import get_args

import torch
from torch import Tensor

from pipeline.body.body_model import BodyModel
from pipeline.body.joints import JOINT_NAMES, joint_index
from pipeline.config.choices import BodyPart

PARTS: tuple[str, ...] = get_args(BodyPart)
"""Part names; a label is the index of its name. The head's label does not include the face."""


def part_labels(body: BodyModel) -> Tensor:
    """The part of each vertex: [V] int8, an index into ``PARTS``.

    A vertex belongs to the part whose joints have the largest summed skinning weight over it, so
    labels need no vertex list and hold for any body of the schema. The face is the region of the
    head that ``is_face`` names.
    """
    labels = joint_parts().to(body.faces.device)
    one_hot = torch.nn.functional.one_hot(labels.long(), len(PARTS)).to(body.skinning_weights.dtype)
    vertex = (body.skinning_weights @ one_hot).argmax(1).to(torch.int8)
    head, face = PARTS.index("head"), PARTS.index("face")
    vertex[is_face(body) & (vertex == head)] = face
    return vertex


def is_part(body: BodyModel, *names: str) -> Tensor:
    """True for vertices of the named parts: [V] bool.

    Raises:
        ValueError: there is no part of that name.
    """
    labels = part_labels(body)
    return torch.isin(labels, torch.tensor([PARTS.index(n) for n in names], device=labels.device))


def is_face(body: BodyModel) -> Tensor:
    """True for vertices of the face, eyes and inner mouth down to the throat included: [V] bool.

    The face is what follows the head, the jaw or an eye, lies in front of the jaw's hinge, and rises
    above the eyes by at most 0.6 of what the chin lies below them: on the open body from the chin to
    the hairline, and out to the front of the ears. Only joints and skinning weights are asked, so
    that it holds for any mesh of the schema.
    """
    joints = body.joint_regressor @ body.v_template
    jaw, left_eye, right_eye = (joint_index(name) for name in ("jaw", "left_eye", "right_eye"))
    following = body.skinning_weights[:, [joint_index("head"), jaw, left_eye, right_eye]].sum(1) > 0.5
    eyes = joints[[left_eye, right_eye], 1].mean()
    chin = body.v_template[body.skinning_weights[:, jaw] > 0.5, 1].min()
    in_front = body.v_template[:, 2] > joints[jaw, 2] + 0.01
    low_enough = body.v_template[:, 1] < eyes + 0.6 * (eyes - chin)
    return following & in_front & low_enough


def joint_parts() -> Tensor:
    """The part that each joint moves: [55] int8, an index into ``PARTS``."""
    return torch.tensor([PARTS.index(_part_of_joint(name)) for name in JOINT_NAMES], dtype=torch.int8)


def _part_of_joint(name: str) -> str:
    side, _, what = name.partition("_")
    if what.startswith(("wrist", "index", "middle", "pinky", "ring", "thumb")):
        return f"{side}_hand"
    if what in ("shoulder", "elbow"):
        return f"{side}_arm"
    if what in ("hip", "knee", "ankle", "foot"):
        return f"{side}_leg"
    if name in ("neck", "head", "jaw") or what == "eye":
        return "head"
    return "torso"
