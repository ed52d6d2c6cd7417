"""Closing SMPL-X's mouth, on a made-up mesh with that model's exact numbers."""

import pytest
import torch

from pipeline.body import edges, subdivide
from pipeline.body.mesh import SMPLX_LIPS, SMPLX_VERTICES, close_mouth, face_normals

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


@pytest.fixture(scope="module")
def mesh() -> tuple[torch.Tensor, torch.Tensor]:
    """Vertices and faces; the lips lie on the rim, every fourth of it, in their order around it."""
    faces, start = made_faces(), 2 * EYE
    renamed = torch.arange(SMPLX_VERTICES)
    for place, lip in enumerate(SMPLX_LIPS):
        rim = start + 4 * place
        old = int(torch.nonzero(renamed == lip)[0, 0])
        renamed[old], renamed[rim] = renamed[rim].clone(), lip
    vertices = torch.randn(SMPLX_VERTICES, 3, generator=torch.Generator().manual_seed(0))
    angle = 2 * torch.pi * torch.arange(len(SMPLX_LIPS)) / len(SMPLX_LIPS)
    vertices[list(SMPLX_LIPS)] = torch.stack([angle.cos(), angle.sin(), torch.ones_like(angle)], 1)
    return vertices, renamed[faces]


def test_numbers_of_smplx(mesh):
    vertices, faces = mesh
    assert len(faces) == 20_908 and len(edges(faces)) == 31_378
    closed = close_mouth(vertices, faces)
    assert len(closed) == 20_914 and torch.equal(closed[: len(faces)], faces)
    _, (twice,) = subdivide(closed, vertices, levels=2)
    assert len(twice) == 167_390


@pytest.mark.parametrize("turned", [1, -1])
def test_new_triangles_face_forward_whichever_way_the_ring_runs(mesh, turned):
    vertices, faces = mesh[0] * torch.tensor([turned, 1, 1]), mesh[1]
    new = close_mouth(vertices, faces)[len(faces) :]
    assert (face_normals(vertices, new)[:, 2] > 0).all()


def test_any_other_mesh_stays_as_it_is():
    faces = torch.tensor([[0, 1, 2]])
    assert close_mouth(torch.zeros(3, 3), faces) is faces
