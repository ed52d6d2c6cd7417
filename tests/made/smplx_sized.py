"""A made-up body with SMPL-X's exact numbers: 10,475 vertices, 20,908 triangles, its lips and layout."""

from __future__ import annotations

import dataclasses
import functools

import torch

from pipeline.body import BodyModel, mean_identity, rest_joints
from pipeline.body.mesh import SMPLX_LIPS, SMPLX_VERTICES
from tests.made.body import open_body

RIM, EYE = 32, 546  # vertices on the rim of the hole, and of each eyeball


def tube(first: int, rings: int, around: int) -> list[list[int]]:
    """The triangles between ``rings`` rings of ``around`` vertices each."""
    faces = []
    for ring in range(rings - 1):
        for k in range(around):
            a, b = first + ring * around + k, first + ring * around + (k + 1) % around
            faces += [[a, b, a + around], [b, b + around, a + around]]
    return faces


def cap(apex: int, ring: int, around: int) -> list[list[int]]:
    return [[apex, ring + (k + 1) % around, ring + k] for k in range(around)]


def made_faces() -> torch.Tensor:
    """A sack with a hole of 32 edges and two closed eyeballs: 10,475 vertices, 20,908 triangles."""
    faces: list[list[int]] = []
    for eye in range(2):
        low = eye * EYE
        faces += tube(low, 34, 16) + cap(low + 544, low, 16) + cap(low + 545, low + 33 * 16, 16)
    start, rings = 2 * EYE, 293
    faces += tube(start, rings, RIM) + cap(start + rings * RIM, start + (rings - 1) * RIM, RIM)
    for extra in range(start + rings * RIM + 1, SMPLX_VERTICES):  # into a triangle each
        a, b, c = faces.pop()
        faces[:0] = [[a, b, extra], [b, c, extra], [c, a, extra]]
    return torch.tensor(faces)


def lips_on_the_rim() -> torch.Tensor:
    """The number of each vertex of ``made_faces`` once every fourth of its rim is a lip."""
    start = 2 * EYE
    renamed = torch.arange(SMPLX_VERTICES)
    for place, lip in enumerate(SMPLX_LIPS):
        rim = start + 4 * place
        old = int(torch.nonzero(renamed == lip)[0, 0])
        renamed[old], renamed[rim] = renamed[rim].clone(), lip
    return renamed


@functools.cache
def smplx_sized_body(shapes: int = 100, expressions: int = 100) -> BodyModel:
    """A body of SMPL-X's sizes, in the open body's skin; its triangles make no sense as a surface.

    Each ring of the sack takes vertices of the open body at its height, in their order around the axis, with
    all that they carry; bases are filled up with random ones, and so are the pose correctives.
    """
    body, generator = open_body(), torch.Generator().manual_seed(0)
    chosen = _places(body)[torch.argsort(lips_on_the_rim())]
    template = body.v_template[chosen]
    joints = rest_joints(body, mean_identity(body))
    lifted = torch.cat([template, torch.ones(len(template), 1)], 1).double()
    wanted = torch.cat([joints, torch.ones(len(joints), 1)], 1).double()

    def filled(directions: torch.Tensor, count: int) -> torch.Tensor:
        more = 1e-4 * torch.randn(len(chosen), 3, count, generator=generator)
        more[..., : directions.shape[2]] = directions[chosen][..., :count]
        return more

    return dataclasses.replace(
        body,
        v_template=template,
        faces=lips_on_the_rim()[made_faces()],
        skinning_weights=body.skinning_weights[chosen],
        shape_directions=filled(body.shape_directions, shapes),
        expression_directions=filled(body.expression_directions, expressions),
        pose_directions=1e-4 * torch.randn(len(chosen), 3, 486, generator=generator),
        joint_regressor=(wanted @ torch.linalg.pinv(lifted)).float(),
        uv=torch.zeros(0, 2),
        uv_faces=torch.zeros(0, 3, dtype=torch.long),
        digest="made up",
    )


def _places(body: BodyModel) -> torch.Tensor:
    """A vertex of the open body for each of ``made_faces``: eyes first, then rings from the top down."""
    eyes = torch.nonzero(body.skinning_weights[:, 23:25].sum(1) > 0.5)[:, 0]
    skin = torch.nonzero(body.skinning_weights[:, 23:25].sum(1) <= 0.5)[:, 0]
    skin = skin[body.v_template[skin, 1].argsort(descending=True)]
    rings = (SMPLX_VERTICES - 2 * EYE + RIM - 1) // RIM
    picked = []
    for part in skin.tensor_split(rings):
        x, z = body.v_template[part, 0], body.v_template[part, 2]
        around = part[torch.atan2(z, x).argsort()]
        picked.append(around[torch.linspace(0, len(around) - 1, RIM).round().long()])
    both = eyes[torch.arange(2 * EYE) % len(eyes)]
    return torch.cat([both, *picked])[:SMPLX_VERTICES]
