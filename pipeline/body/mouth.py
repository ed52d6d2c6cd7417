"""Closing the mouth of SMPL-X's mesh, which is open between the lips.

Through the hole one would look into the back of the head. ExAvatar closes it with six triangles, and so
does the paper, whose twice subdivided mesh has 167,390 vertices. The open body has an inner mouth.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pipeline.body.mesh import face_normals

SMPLX_VERTICES = 10_475
SMPLX_LIPS = (2844, 2855, 8977, 1740, 1730, 1789, 8953, 2892)
"""Vertices of SMPL-X on the rim of the hole, in their order around it."""


def close_mouth(vertices: Tensor, faces: Tensor) -> Tensor:
    """The mesh's triangles and, where it is SMPL-X's, six more between the lips.

    Args:
        vertices: [V, 3] at rest, Y up, the face towards +Z.
        faces: [F, 3] int64.

    Returns:
        [F, 3] or [F + 6, 3]; the new ones come last and face forward.
    """
    if len(vertices) != SMPLX_VERTICES:
        return faces
    ring = torch.tensor(SMPLX_LIPS)
    fan = torch.stack([ring[:1].expand(len(ring) - 2), ring[1:-1], ring[2:]], 1)
    forward = face_normals(vertices, fan)[:, 2].sum() >= 0
    return torch.cat([faces, fan if forward else fan.flip(1)])
