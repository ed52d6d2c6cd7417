"""Subdivision, normals, Laplacian and drawing, on the open body and on random meshes."""

import numpy as np
import pytest
import torch
import trimesh

from pipeline.body import draw_mesh, edges, rasterize, subdivide, uniform_laplacian, vertex_normals
from pipeline.clip.camera import facing_camera, project


@pytest.mark.parametrize("levels", [0, 1, 2])
def test_subdivision_counts(body, levels):
    faces, (vertices, weights) = subdivide(body.faces, body.v_template, body.skinning_weights, levels=levels)
    expected_vertices, expected_faces = len(body.v_template), body.faces
    for _ in range(levels):
        expected_vertices += len(edges(expected_faces))
        expected_faces = subdivide(expected_faces)[0]
    assert len(vertices) == len(weights) == expected_vertices
    assert faces.shape == (len(body.faces) * 4**levels, 3) and int(faces.max()) == expected_vertices - 1
    torch.testing.assert_close(vertices[: len(body.v_template)], body.v_template)


def test_subdivision_is_linear_and_keeps_the_surface(body):
    faces, (vertices, doubled) = subdivide(body.faces, body.v_template, 2 * body.v_template + 1)
    torch.testing.assert_close(doubled, 2 * vertices + 1)
    areas = [trimesh.Trimesh(v, f, process=False).area_faces for v, f in
             ((body.v_template, body.faces), (vertices, faces))]  # fmt: skip
    quarters = np.repeat(areas[0][:, None] / 4, 4, axis=1)
    np.testing.assert_allclose(areas[1].reshape(-1, 4), quarters, atol=1e-9)
    before, after = (
        torch.linalg.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]])
        for v, f in ((body.v_template, body.faces), (vertices, faces))
    )
    assert ((after.reshape(-1, 4, 3) * before[:, None]).sum(-1) >= 0).all(), "no child is turned over"


def test_subdivision_passes_gradients_and_refuses_labels():
    faces = torch.tensor([[0, 1, 2], [2, 1, 3]])
    vertices = torch.rand(4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert torch.autograd.gradcheck(lambda v: subdivide(faces, v, levels=2)[1][0], vertices.requires_grad_())
    with pytest.raises(TypeError, match="floating-point"):
        subdivide(faces, torch.tensor([0, 1, 1, 0]))


def test_edges_are_those_of_trimesh(body):
    expected = trimesh.Trimesh(body.v_template, body.faces, process=False).edges_unique
    assert {tuple(e) for e in edges(body.faces).tolist()} == {tuple(sorted(e)) for e in expected.tolist()}


def test_vertex_normals_are_area_weighted(body):
    mesh = trimesh.Trimesh(body.v_template, body.faces, process=False)
    summed = np.zeros(mesh.vertices.shape)
    for corner in range(3):
        np.add.at(summed, mesh.faces[:, corner], mesh.area_faces[:, None] * mesh.face_normals)
    expected = summed / np.linalg.norm(summed, axis=1, keepdims=True)
    got = vertex_normals(body.v_template.double().expand(2, -1, -1), body.faces)
    np.testing.assert_allclose(got[1], expected, atol=1e-5)


def test_normals_of_collapsed_triangles_are_zero_with_finite_gradients():
    vertices = torch.zeros(3, 3, requires_grad=True)
    normals = vertex_normals(vertices, torch.tensor([[0, 1, 2]]))
    normals.sum().backward()
    assert (normals == 0).all() and torch.isfinite(vertices.grad).all()


def test_laplacian_is_mean_of_neighbours_minus_self():
    faces = torch.tensor([[0, 1, 2], [2, 1, 3]])
    values = torch.tensor([[1.0], [10.0], [100.0], [1000.0], [5.0]])  # the last one is in no face
    laplacian = uniform_laplacian(faces, 5)
    expected = [[55 - 1], [(1 + 100 + 1000) / 3 - 10], [(1 + 10 + 1000) / 3 - 100], [55 - 1000], [0]]
    torch.testing.assert_close(laplacian @ values, torch.tensor(expected, dtype=torch.float32))


def random_triangles(seed=0, count=12):
    rng = np.random.default_rng(seed)
    centres = rng.uniform([-0.5, -0.4, -3], [0.5, 0.4, -1.5], (count, 1, 3))
    corners = centres + rng.normal(size=(count, 3, 3)) * 0.25
    return torch.from_numpy(corners.reshape(-1, 3)).float(), torch.arange(3 * count).reshape(-1, 3)


@pytest.mark.parametrize("seed", [0, 1])
def test_raster_equals_rays_against_planes(seed):
    vertices, faces = random_triangles(seed)
    camera = facing_camera(64, 48, 60.0)
    raster = rasterize(camera, vertices, faces)
    x, y = np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5)
    rays = np.stack([(x - 32) / 60, -(y - 24) / 60, -np.ones_like(x)], -1)  # depth 1 along -Z
    corners = vertices.numpy().astype(np.float64)[faces]
    depth = np.full((48, 64), np.inf)
    for a, b, c in corners:
        shares = np.linalg.solve(np.stack([a, b, c], 1)[None, None], rays[..., None])[..., 0]
        with np.errstate(divide="ignore"):
            hit = np.where((shares >= 0).all(-1), 1 / shares.sum(-1), np.inf)
        depth = np.where((hit > 0) & (hit < depth), hit, depth)
    both = np.isfinite(depth) & raster.covered
    assert both.sum() > 300
    assert (np.isfinite(depth) != raster.covered).sum() <= 3, "only pixels on an edge may differ"
    np.testing.assert_allclose(raster.depth[both], depth[both], rtol=1e-4)
    seen = raster.interpolate(faces.numpy(), vertices.numpy())
    np.testing.assert_allclose(seen[both], (rays * depth[..., None])[both], atol=1e-3)


def test_project_agrees_with_the_raster(body):
    camera = facing_camera(200, 300, 400.0)
    vertices = body.v_template + torch.tensor([0.0, 0.3, -3.0])
    raster = rasterize(camera, vertices, body.faces)
    points = raster.interpolate(body.faces.numpy(), vertices.numpy())
    y, x = np.nonzero(raster.covered)
    pixels = project(camera, torch.from_numpy(points[y, x])).numpy()
    np.testing.assert_allclose(pixels, np.stack([x, y], 1) + 0.5, atol=0.02)


def test_what_is_behind_or_outside_is_not_drawn(body):
    camera = facing_camera(40, 30, 40.0)
    image = np.full((30, 40, 3), 77, np.uint8)
    for shift in ([0, 0, 3.0], [50.0, 0, -3.0], [0, 0, 0.0]):
        vertices = body.v_template + torch.tensor(shift)
        drawn = draw_mesh(image, camera, vertices, body.faces)
        assert drawn.shape == image.shape and (image == 77).all()
        if shift[2] != 0:
            np.testing.assert_array_equal(drawn, image)
    broken = body.v_template * float("nan")
    np.testing.assert_array_equal(draw_mesh(image, camera, broken, body.faces), image)


@pytest.mark.parametrize("smooth", [True, False])
def test_drawing_covers_the_body_and_nothing_else(body, smooth):
    camera = facing_camera(120, 160, 220.0)
    vertices = body.v_template + torch.tensor([0.0, 0.3, -3.0])
    image = np.random.default_rng(0).integers(0, 256, (160, 120, 3)).astype(np.uint8)
    covered = rasterize(camera, vertices, body.faces).covered
    drawn = draw_mesh(image, camera, vertices, body.faces, color=(255, 0, 0), smooth=smooth)
    np.testing.assert_array_equal(drawn[~covered], image[~covered])
    assert 0.02 < covered.mean() < 0.3
    assert (drawn[covered][:, 1:] == 0).all() and drawn[covered][:, 0].min() > 40
    half = draw_mesh(image, camera, vertices, body.faces, color=(255, 0, 0), opacity=0.5, smooth=smooth)
    expected = 0.5 * image[covered].astype(float) + 0.5 * drawn[covered]
    np.testing.assert_allclose(half[covered], expected, atol=1.01)


def test_colors_may_differ_by_vertex_and_size_must_fit(body):
    camera = facing_camera(60, 80, 110.0)
    vertices = body.v_template + torch.tensor([0.0, 0.3, -3.0])
    colors = np.where(body.v_template[:, :1] > 0, [[0, 255, 0]], [[255, 0, 0]])
    drawn = draw_mesh(np.zeros((80, 60, 3), np.uint8), camera, vertices, body.faces, color=colors)
    assert drawn[:, :28, 1].max() == 0 and drawn[:, 32:, 0].max() == 0, "the subject's left is at the right"
    with pytest.raises(ValueError, match="image is"):
        draw_mesh(np.zeros((60, 80, 3), np.uint8), camera, vertices, body.faces)
