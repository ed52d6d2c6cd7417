"""What training changes of the person's identity: betas and joint offsets (paper, Section 3.6)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from pipeline.avatar.canonical import faces_among
from pipeline.body import BodyModel, Identity, rest_vertices, subdivide
from pipeline.body.edge_splits import split_repeatedly
from pipeline.body.joints import JOINT_NAMES
from pipeline.body.mesh import close_mouth

FIRST_FINGER = 25  # of the joints, of which those of the hands are the last thirty
HAND_FACTOR = math.sqrt(10)
LEFT = [row for row, name in enumerate(JOINT_NAMES) if name.startswith("left_")]
RIGHT = [JOINT_NAMES.index("right_" + JOINT_NAMES[row].removeprefix("left_")) for row in LEFT]


class IdentityChange(nn.Module):
    """A change of betas and of joint offsets, zero to begin with.

    The canonical mesh stays the fitted identity's: its triangles, axes and sizes do not change, and the
    triplane is read where it was. The change moves vertices and joints.

    Attributes:
        betas: [B], added to beta.
        joint_offset: [55, 3], metres, added to Delta J.
        shape_directions: [N, 3, B], metres a unit, of the finest level's vertices.
        joint_directions: [55, 3, B], of the joints.
        fitted_offset: [55, 3], metres, the fitted Delta J.
    """

    shape_directions: Tensor
    joint_directions: Tensor
    fitted_offset: Tensor

    def __init__(
        self,
        body: BodyModel,
        identity: Identity,
        levels: int,
        vertex_ids: Tensor,  # [K]
        splits: Sequence[Tensor] = (),
    ):
        """No change yet; the arguments are those of ``build_canonical``."""
        super().__init__()
        count = len(identity.betas)
        faces = close_mouth(rest_vertices(body, identity), body.faces)
        faces = faces_among(faces, vertex_ids, len(body.v_template))
        directions = body.shape_directions[..., :count]
        faces, (carried,) = subdivide(faces, directions[vertex_ids], levels=levels)
        _, (carried,) = split_repeatedly(faces, splits, carried)
        joints = torch.einsum("jv,vck->jck", body.joint_regressor, directions)
        # They follow from body and identity: no file holds them.
        self.register_buffer("shape_directions", carried.contiguous(), persistent=False)
        self.register_buffer("joint_directions", joints, persistent=False)
        self.register_buffer("fitted_offset", identity.joint_offset.detach().clone(), persistent=False)
        self.betas = nn.Parameter(torch.zeros(count))
        self.joint_offset = nn.Parameter(torch.zeros(len(body.parents), 3))

    def joints(self) -> Tensor:
        """By how much the rest joints move, [55, 3], metres."""
        return self.joint_directions @ self.betas + self.joint_offset

    def offset_change(self) -> Tensor:
        """The change of the joint offsets, [55, 3] metres; squared, that of a hand counts tenfold."""
        factor = self.joint_offset.new_ones(len(self.joint_offset), 1)
        factor[FIRST_FINGER:] = HAND_FACTOR
        return self.joint_offset * factor

    def asymmetry(self) -> Tensor:
        """The difference of the left joints' offsets from the mirrored right ones', [P, 3], metres."""
        offset = self.fitted_offset + self.joint_offset
        mirror = offset.new_tensor([-1.0, 1.0, 1.0])
        return offset[LEFT] - offset[RIGHT] * mirror

    def vertices(self, rows: Tensor | None, count: int) -> Tensor:
        """By how much vertices move, [N, 3], metres.

        Args:
            rows: [N] int64, which of the finest level's; None for the first ``count``.
            count: N.
        """
        directions = self.shape_directions[:count] if rows is None else self.shape_directions[rows]
        return directions @ self.betas
