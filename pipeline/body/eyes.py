"""The eyes of a body: which of its landmarks are lids and irises, and which expressions move lids.

Left comes first, as in the kinematic tree. Numbers of points are those of the face mesh's 478.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from pipeline.body.body_model import BodyModel
from pipeline.body.identity import Identity, mean_identity, rest_joints, rest_vertices
from pipeline.body.joints import LEFT_EYE, RIGHT_EYE, joint_index
from pipeline.body.landmarks import PointSet, locate

UPPER_LIDS = ((384, 385, 386, 387, 388), (161, 160, 159, 158, 157))
LOWER_LIDS = ((381, 380, 374, 373, 390), (163, 144, 145, 153, 154))
"""Points of an eye's lids that face each other, in the order in which a picture of the face shows them."""
CORNERS = ((362, 263), (33, 133))
"""The corners of each eye, in the same order."""
IRISES = ((473, 474, 475, 476, 477), (468, 469, 470, 471, 472))
"""The middle of each iris and four points of its edge."""
SOCKETS = (
    (249, 390, 373, 374, 380, 381, 382, 263, 362, 255, 339, 254, 253, 252, 256, 341, 463),
    (7, 163, 144, 145, 153, 154, 155, 33, 133, 25, 110, 24, 23, 22, 26, 112, 243),
)
"""Points around each eye that neither a blink nor the gaze moves: corners and the skin below."""

HEAD = joint_index("head")
_LID, _CLEARANCE = 0.004, 0.0004  # metres: from an eyeball within which skin is a lid; between the two
_LEAST_OPENING = 5e-4  # metres that a unit of psi must open or shut an eye by, to be called a lid's
_LEAST_SHARE = 0.2  # of what the unit moves on the face, that must be lids
_LID_POINTS = (
    246, 161, 160, 159, 158, 157, 173, 7, 163, 144, 145, 153, 154, 155,
    466, 388, 387, 386, 385, 384, 398, 249, 390, 373, 374, 380, 381, 382,
)  # fmt: skip


def lid_openings(points: Tensor, up: Tensor) -> Tensor:
    """How far each eye is open: the mean distance of its lids along ``up``, negative where they overlap.

    Args:
        points: [..., 478, D], of the face mesh.
        up: [..., D] unit vector, from the chin to the brow.

    Returns:
        [..., 2], left and right, in the points' unit.
    """
    gaps = points[..., UPPER_LIDS, :].mean(-2) - points[..., LOWER_LIDS, :].mean(-2)
    return (gaps * up[..., None, :]).sum(-1)


def eyeball(body: BodyModel, eye: int) -> Tensor:
    """The vertices of the left (0) or the right (1) eyeball: [V] bool."""
    return body.skinning_weights[:, (LEFT_EYE, RIGHT_EYE)[eye]] > 0.5


def eyeball_shift(body: BodyModel, face_offset: Tensor) -> Tensor:
    """Where offsets of a face take the eyeballs, each in one piece: [V, 3] -> [2, 3], metres.

    Sideways and upwards an eyeball goes with the mean of the skin around it, and forwards only as far as the
    part of that skin which goes least: lids close before it.
    """
    shifts = []
    for eye in range(2):
        ball = eyeball(body, eye)
        skin = torch.nonzero(~ball & (body.skinning_weights[:, HEAD] > 0.5))[:, 0]
        away = torch.cdist(body.v_template[skin], body.v_template[ball]).amin(1)
        lids = face_offset[skin[away < _LID]]
        if len(lids) == 0:
            shifts.append(face_offset.new_zeros(3))
            continue
        mean = lids.mean(0)
        shifts.append(torch.cat([mean[:2], lids[:, 2:].amin(0) - _CLEARANCE * (lids.abs().amax() > 0)]))
    return torch.stack(shifts)


def with_eyeballs(body: BodyModel, identity: Identity) -> Identity:
    """The same person with eyeballs and their joints where the face offsets take them."""
    shift = eyeball_shift(body, identity.face_offset)
    face_offset, joint_offset = identity.face_offset.clone(), identity.joint_offset.clone()
    for eye, joint in enumerate((LEFT_EYE, RIGHT_EYE)):
        face_offset[eyeball(body, eye)] = shift[eye]
        joint_offset[joint] = shift[eye]
    return dataclasses.replace(identity, joint_offset=joint_offset, face_offset=face_offset)


def lid_directions(body: BodyModel, face_mesh: PointSet) -> Tensor:
    """How far a unit of each expression opens either eye: [2, E], metres; 0 for what does not shut eyes.

    An expression counts if a fifth of all that it moves on the face are lids, and if it changes an opening
    by half a millimetre, and by half of what the strongest does. In the open body that is the blink.
    """
    share = face_mesh.barycentrics
    moved = torch.einsum("fk,fkce->fce", share, body.expression_directions[face_mesh.vertices])
    opens = lid_openings(moved.movedim(-1, 0), moved.new_tensor([0.0, 1.0, 0.0])).mT
    whole = moved.square().sum((0, 1))
    lids = moved[list(_LID_POINTS)].square().sum((0, 1))
    size = opens.abs().amax(0) * (lids >= _LEAST_SHARE * whole)
    least = max(_LEAST_OPENING, 0.5 * float(size.max())) if size.numel() else _LEAST_OPENING
    return opens * (size >= least)


def shut_expressions(body: BodyModel, face_mesh: PointSet, identity: Identity | None = None) -> Tensor:
    """The expressions that just shut the left and the right eye of somebody at rest: psi [2, E].

    Each leaves the other eye as it is. Zero where the body has no expressions for that.

    Args:
        body: the body; face_mesh: its 478 points.
        identity: whose eyes; the mean body's by default.
    """
    identity = mean_identity(body) if identity is None else identity
    opens = lid_directions(body, face_mesh).double()
    at_rest = locate(face_mesh, rest_joints(body, identity), rest_vertices(body, identity))
    opening = lid_openings(at_rest, at_rest.new_tensor([0.0, 1.0, 0.0])).double()
    both = opens @ opens.mT
    if float(torch.linalg.det(both)) < _LEAST_OPENING**4:
        return torch.zeros_like(opens).float()
    return -(torch.diag(opening) @ torch.linalg.solve(both, opens)).float()
