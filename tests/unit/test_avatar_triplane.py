"""Sampling the triplane as a sparse product, against torch's grid_sample."""

import pytest
import torch
import torch.nn.functional as functional

from pipeline.avatar.sparse import SparsePair
from pipeline.avatar.triplane import PLANES, Triplane, bounding_boxes, normalise, sampling_matrix

RESOLUTION, CHANNELS = 9, 4


def drawn_points(count: int = 200) -> torch.Tensor:
    points = torch.rand(count, 3, generator=torch.Generator().manual_seed(1)) * 2 - 1
    points[:4] = torch.tensor([[1.0, 1, 1], [-1, -1, -1], [0, 0, 0], [1, -1, 0.5]])  # on texels and borders
    return points


def by_grid_sample(planes: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """The same as ``Triplane.forward`` for one region: [3, R, R, C], [N, 3] -> [N, 3 C]."""
    grid = torch.stack([points[:, list(axes)] for axes in PLANES])[:, None]
    sampled = functional.grid_sample(
        planes.permute(0, 3, 1, 2), grid, align_corners=True, padding_mode="border"
    )
    return sampled[:, :, 0].permute(2, 0, 1).reshape(len(points), -1)


def test_sparse_product_equals_grid_sample_with_gradient():
    points, generator = drawn_points(), torch.Generator().manual_seed(2)
    triplane = Triplane(1, RESOLUTION, CHANNELS, generator)
    samples = sampling_matrix(points, torch.zeros(len(points), dtype=torch.long), 1, RESOLUTION)
    weights = torch.randn(len(points), 3 * CHANNELS, generator=generator)
    features = triplane(samples)
    (features * weights).sum().backward()
    planes = triplane.planes.detach()[0].clone().requires_grad_()
    expected = by_grid_sample(planes, points)
    (expected * weights).sum().backward()
    torch.testing.assert_close(features, expected, rtol=1e-5, atol=1e-7)
    torch.testing.assert_close(triplane.planes.grad[0], planes.grad, rtol=1e-5, atol=1e-6)


def test_each_region_reads_its_own_planes_in_its_own_box():
    points = drawn_points(60) * 0.3 + 1.0
    regions = (points[:, 0] > 1.0).long()
    boxes = bounding_boxes(points, regions)
    coordinates = normalise(points, regions, boxes)
    assert coordinates.abs().max() < 1
    assert coordinates[regions == 1].abs().max() > 0.9
    triplane = Triplane(2, RESOLUTION, CHANNELS, torch.Generator().manual_seed(3))
    features = triplane(sampling_matrix(coordinates, regions, 2, RESOLUTION))
    for region in (0, 1):
        mine = regions == region
        expected = by_grid_sample(triplane.planes[region], coordinates[mine])
        torch.testing.assert_close(features[mine], expected, rtol=1e-5, atol=1e-7)


def test_sparse_entries_at_one_place_add_up():
    rows, columns = torch.tensor([0, 0, 1]), torch.tensor([1, 1, 0])
    pair = SparsePair.build(rows, columns, torch.tensor([1.0, 2.0, 5.0]), (2, 3))
    dense = torch.tensor([[1.0], [10.0], [100.0]], requires_grad=True)
    product = pair @ dense
    assert product.flatten().tolist() == [30.0, 5.0]
    (product * torch.tensor([[1.0], [2.0]])).sum().backward()
    assert dense.grad.flatten().tolist() == [10.0, 3.0, 0.0]


@pytest.mark.parametrize("far", [-3.0, 3.0])
def test_coordinates_outside_the_box_read_the_border(far):
    points = torch.tensor([[far, 0.1, 0.2]])
    triplane = Triplane(1, RESOLUTION, CHANNELS, torch.Generator().manual_seed(4))
    features = triplane(sampling_matrix(points, torch.zeros(1, dtype=torch.long), 1, RESOLUTION))
    torch.testing.assert_close(features, by_grid_sample(triplane.planes[0], points), rtol=1e-5, atol=1e-7)
