"""Closing SMPL-X's mouth, on a made-up mesh with that model's exact numbers."""

import pytest
import torch

from pipeline.body import edges, subdivide
from pipeline.body.mesh import SMPLX_LIPS, SMPLX_VERTICES, close_mouth, face_normals
from tests.made.smplx_sized import lips_on_the_rim, made_faces


@pytest.fixture(scope="module")
def mesh() -> tuple[torch.Tensor, torch.Tensor]:
    """Vertices and faces; the lips lie on the rim, every fourth of it, in their order around it."""
    vertices = torch.randn(SMPLX_VERTICES, 3, generator=torch.Generator().manual_seed(0))
    angle = 2 * torch.pi * torch.arange(len(SMPLX_LIPS)) / len(SMPLX_LIPS)
    vertices[list(SMPLX_LIPS)] = torch.stack([angle.cos(), angle.sin(), torch.ones_like(angle)], 1)
    return vertices, lips_on_the_rim()[made_faces()]


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
