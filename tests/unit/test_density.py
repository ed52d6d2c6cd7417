"""Splitting edges, and which of them the pixels call for."""

import pytest
import torch

from pipeline.avatar.density import Projections, choose_splits, count_by_part
from pipeline.body import edges, load_body, subdivide
from pipeline.body.edge_splits import split_edges, split_repeatedly
from pipeline.body.mesh import face_normals
from tests.conftest import REPOSITORY

SQUARE = torch.tensor([[0, 1, 2], [0, 2, 3]])
CORNERS = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])


@pytest.fixture(scope="module")
def body():
    return load_body(REPOSITORY / "data" / "body" / "open_body.npz")


def as_sets(faces: torch.Tensor) -> set[tuple[int, ...]]:
    return set(map(tuple, faces.sort(1).values.tolist()))


def test_every_edge_split_is_midpoint_subdivision(body):
    faces, vertices = body.faces.long(), body.v_template
    split, (points,) = split_edges(faces, edges(faces), vertices)
    expected, (midpoints,) = subdivide(faces, vertices)
    assert torch.equal(points, midpoints) and as_sets(split) == as_sets(expected)


@pytest.mark.parametrize("seed", range(4))
def test_some_edges_split_leave_no_gap_and_turn_no_triangle(body, seed):
    faces, vertices = body.faces.long(), body.v_template
    generator = torch.Generator().manual_seed(seed)
    pairs = edges(faces)
    chosen = pairs[torch.rand(len(pairs), generator=generator) < 0.1 + 0.25 * seed]
    split, (points,) = split_edges(faces, chosen, vertices)
    before, after = face_normals(vertices, faces), face_normals(points, split)
    torch.testing.assert_close(after.norm(dim=1).sum(), before.norm(dim=1).sum(), rtol=1e-5, atol=0)
    # Every piece looks where its triangle looked, and has an edge in common with as many as before.
    torch.testing.assert_close(after.sum(0), before.sum(0), rtol=0, atol=1e-5)
    counts = torch.bincount(torch.unique(sides(split), dim=0, return_counts=True)[1])
    assert counts[1] <= 2 * torch.bincount(torch.unique(sides(faces), dim=0, return_counts=True)[1])[1]
    assert len(counts) == 3


def sides(faces: torch.Tensor) -> torch.Tensor:
    return torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(1).values


@pytest.mark.parametrize(
    "chosen", [[[0, 9]], [[1, 3]], [[0, 2], [0, 2]], [[-1, 0]]], ids=["far", "no edge", "twice", "negative"]
)
def test_what_is_no_edge_of_the_mesh_is_refused(chosen):
    with pytest.raises(ValueError, match="edge"):
        split_edges(SQUARE, torch.tensor(chosen), CORNERS)


def seen(pixels: torch.Tensor, facing: float = 1.0) -> Projections:
    return Projections(pixels[:, None, :2], torch.full((len(pixels), 1), facing))


def test_no_shown_edge_stays_longer_than_asked():
    splits = choose_splits(SQUARE, seen(10 * CORNERS), 3.0)
    faces, (points,) = split_repeatedly(SQUARE, splits, 10 * CORNERS)
    ends = edges(faces)
    assert (points[ends[:, 0]] - points[ends[:, 1]]).norm(dim=1).max() <= 3.0
    assert len(points) < 100  # not more than the pixels call for: a grid of 1.5 has 64


def test_what_no_frame_shows_and_what_is_short_stay_as_they_are():
    assert choose_splits(SQUARE, seen(10 * CORNERS, facing=0.0), 3.0) == ()
    assert choose_splits(SQUARE, seen(CORNERS), 3.0) == ()


def test_the_frame_that_shows_an_edge_longest_counts():
    near, far = seen(10 * CORNERS), seen(CORNERS)
    both = Projections(torch.cat([far.pixels, near.pixels], 1), torch.cat([far.facing, near.facing], 1))
    for mine, alone in zip(choose_splits(SQUARE, both, 3.0), choose_splits(SQUARE, near, 3.0), strict=True):
        assert torch.equal(mine, alone)


def test_new_gaussians_are_counted_with_their_part():
    parts = torch.tensor([0, 0, 1, 1])
    counts = list(count_by_part(parts, [torch.tensor([[0, 1], [2, 3]]), torch.tensor([[0, 4]])]).values())
    assert counts[:2] == [4, 3] and sum(counts) == 7
