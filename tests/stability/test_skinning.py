"""The body at its limits: shapes, poses, weights and triangles that nobody has."""

import math

import numpy as np
import pytest
import torch

from pipeline.avatar import Architecture, Avatar
from pipeline.avatar.canonical import build_canonical
from pipeline.avatar.skinning_tables import plain_normals, plain_place
from pipeline.body import (
    Identity,
    Pose,
    joint_transforms,
    linear_blend_skinning,
    load_body,
    mean_identity,
    pose_body,
    rest_joints,
    rest_vertices,
    uniform_laplacian,
    vertex_normals,
)
from pipeline.clip.camera import facing_camera
from pipeline.errors import UserError
from pipeline.splat import render
from tests.made.fake_body import official_arrays, write_official

ANATOMICAL = 0.6  # radians, standard deviation of a joint: beyond what a person can do


def identity_of(body, size, seed=0):
    generator = torch.Generator().manual_seed(seed)
    mean = mean_identity(body)
    return Identity(
        size * torch.randn(body.shape_directions.shape[2], generator=generator),
        torch.zeros_like(mean.joint_offset),
        torch.zeros_like(mean.face_offset),
    )


def random_pose(size, count=3, seed=1):
    return size * torch.randn(count, 55, 3, generator=torch.Generator().manual_seed(seed))


# Shapes and poses


@pytest.mark.parametrize("size", [1.0, 5.0, 50.0, 1e4], ids=str)
@pytest.mark.parametrize(
    "turn", [0.0, ANATOMICAL, math.pi, 100.0], ids=["rest", "acrobat", "half turns", "turns"]
)
def test_extreme_shapes_and_poses_agree_with_double_precision(body, size, turn):
    identity, rotation = identity_of(body, size), random_pose(turn)
    expression = 5 * size * torch.ones(3, body.expression_directions.shape[2])
    single = pose_body(body, identity, rotation, expression, torch.zeros(3, 3))[0]
    precise = body.to(torch.float64)
    exact_identity = Identity(
        *(getattr(identity, name).double() for name in ("betas", "joint_offset", "face_offset"))
    )
    exact = pose_body(
        precise, exact_identity, rotation.double(), expression.double(), torch.zeros(3, 3).double()
    )[0]
    assert single.isfinite().all()
    extent = float(exact.abs().max())
    # A chain of twelve joints: some ten roundings, and 2e-7 of the angle.
    assert (single.double() - exact).abs().max() < (2e-6 + 4e-6 * turn / 10) * extent


def test_slopes_of_an_extreme_pose_are_finite_and_those_of_double_precision(body):
    rotation = random_pose(math.pi, 1)
    slopes = []
    for dtype in (torch.float32, torch.float64):
        cast = body.to(dtype)
        pose = rotation.to(dtype, copy=True).requires_grad_()
        identity = mean_identity(cast)
        vertices, _ = pose_body(
            cast, identity, pose, torch.zeros(1, 1, dtype=dtype), torch.zeros(1, 3, dtype=dtype)
        )
        vertices.square().mean().backward()
        slopes.append(pose.grad.double())
    assert slopes[0].isfinite().all()
    assert (slopes[0] - slopes[1]).abs().max() < 1e-4 * slopes[1].abs().max()


# Weights


@pytest.mark.parametrize("factor", [0.0, 0.5, 1.5])
def test_weights_that_do_not_sum_to_one_are_refused_when_a_body_is_read(tmp_path, factor):
    weights = official_arrays()["weights"].copy()
    weights[3] *= factor
    with pytest.raises(UserError, match="weights has rows that do not sum to 1"):
        load_body(write_official(tmp_path / "body.npz", weights=weights))


def test_weights_that_nearly_sum_to_one_are_divided_by_their_sum(tmp_path):
    weights = official_arrays()["weights"] * 1.005
    body = load_body(write_official(tmp_path / "body.npz", weights=weights))
    torch.testing.assert_close(body.skinning_weights.sum(1), torch.ones(len(weights)))


def test_weights_that_do_not_sum_to_one_scale_about_the_origin_and_stay_finite(body):
    """Skinning itself takes any weights: a sum of 0.5 draws a point half-way to the world's origin."""
    joints = rest_joints(body, mean_identity(body))
    transforms = joint_transforms(random_pose(0.5, 1), joints, body.parents)
    whole = linear_blend_skinning(transforms, body.skinning_weights, body.v_template)
    half = linear_blend_skinning(transforms, 0.5 * body.skinning_weights, body.v_template)
    torch.testing.assert_close(half, 0.5 * whole)
    assert not linear_blend_skinning(transforms, 0 * body.skinning_weights, body.v_template).any()


def test_subdivided_weights_still_sum_to_one(body):
    mesh = build_canonical(body, mean_identity(body), 1)
    torch.testing.assert_close(mesh.skinning_weights.sum(1), torch.ones(len(mesh)))


# Triangles

COLLAPSED = {
    "to a point": [[0.0, 0, 0]] * 3,
    "to a line": [[0.0, 0, 0], [1, 0, 0], [2, 0, 0]],
    "to 1e-20 m": [[0.0, 0, 0], [1e-20, 0, 0], [0, 1e-20, 0]],
    "to 1e-12 m": [[0.0, 0, 0], [1e-12, 0, 0], [0, 1e-12, 0]],
    "needle": [[0.0, 0, 0], [1, 0, 0], [0.5, 1e-9, 0]],
}


@pytest.mark.parametrize("case", COLLAPSED)
def test_collapsed_triangles_have_normals_of_length_one_or_zero(case):
    corners = torch.tensor(COLLAPSED[case])
    healthy = torch.tensor([[5.0, 0, 0], [6, 0, 0], [5, 1, 0]])
    vertices = torch.cat([corners, healthy]).requires_grad_()
    faces = torch.tensor([[0, 1, 2], [3, 4, 5]])
    normals = vertex_normals(vertices, faces)
    length = normals.detach().norm(dim=1)
    assert (((length - 1).abs() < 1e-5) | (length < 1e-3)).all()
    torch.testing.assert_close(normals[3:].detach(), torch.tensor([[0.0, 0, 1]]).expand(3, 3))
    (normals * torch.arange(18.0).view(6, 3)).sum().backward()
    assert vertices.grad.isfinite().all()


def test_the_laplacian_of_a_collapsed_or_lonely_vertex_is_finite():
    faces = torch.tensor([[0, 1, 2], [0, 0, 1]])
    matrix = uniform_laplacian(faces, 5).to_dense()
    assert matrix.isfinite().all() and not matrix[3:].any()
    torch.testing.assert_close(matrix.sum(1), torch.zeros(5))


def test_a_body_without_extent_is_posed_and_drawn(body):
    """All vertices in one point: no normal, no spacing, no triplane box."""
    flat = type(body)(**{**vars(body), "v_template": torch.zeros_like(body.v_template)})
    bare = Architecture(
        plane_resolution=4, plane_channels=2, subdivisions=0, width=16, groups=4, residual_width=16
    )
    avatar = Avatar(flat, mean_identity(flat), torch.arange(len(flat.v_template)), bare).eval()
    gaussians = avatar.gaussians(before_the_camera(torch.zeros(55, 3)))
    image = render(gaussians, facing_camera(32, 32, 40.0)).color
    assert image.isfinite().all()


# The avatar


def before_the_camera(rotation):
    """A pose [55, 3] two metres before a camera at the origin."""
    return Pose(rotation, torch.zeros(1), torch.tensor([0.0, 0, -2.0]))


SMALL = Architecture(
    plane_resolution=8, plane_channels=4, subdivisions=1, width=16, groups=4, residual_width=16
)


@pytest.mark.parametrize("kept", [[0], [0, 5000], [10, 11, 12]], ids=["one", "two far apart", "three"])
def test_an_avatar_of_a_few_points_decodes_poses_and_learns(body, kept):
    """GroupNorm over one row, a triplane's box without extent, vertices without neighbours."""
    avatar = Avatar(body, mean_identity(body), torch.tensor(kept), SMALL, half_precision=False).train()
    posed = avatar.pose(avatar.decode(), before_the_camera(random_pose(0.3, 1)[0]))
    assert all(tensor.isfinite().all() for tensor in posed.gaussians.tensors())
    sum(tensor.square().sum() for tensor in posed.gaussians.tensors()).backward()
    assert all(one.grad is None or one.grad.isfinite().all() for one in avatar.parameters())


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_group_norm_of_equal_channels_is_finite(body, dtype):
    """One point whose channels are all equal: a variance of zero."""
    from pipeline.avatar.head import Head

    torch.manual_seed(0)
    head = Head(4, 3, width=16, groups=4)
    with torch.no_grad():
        for layer in (head.first, *head.hidden):
            layer.weight.zero_()
            layer.bias.fill_(0.7)
        head.last.weight.normal_()
    point = torch.zeros(1, 4, requires_grad=True)
    with torch.autocast("cpu", torch.bfloat16, enabled=dtype == torch.bfloat16):
        value = head(point)
    value.float().square().sum().backward()
    assert value.isfinite().all() and point.grad.isfinite().all()
    assert all(one.grad.isfinite().all() for one in head.parameters())


@pytest.mark.parametrize("value", [1e30, -1e30, 1e4, -1e4])
def test_scales_and_colours_of_extreme_heads_stay_in_their_ranges(body, value):
    avatar = Avatar(body, mean_identity(body), torch.arange(200), SMALL, half_precision=False).train()
    with torch.no_grad():
        avatar.representation.geometry.last.bias[3:] = value
        avatar.representation.color.last.bias[:] = value
    posed = avatar.pose(avatar.decode(0), before_the_camera(torch.zeros(55, 3)))
    gaussians = posed.gaussians
    assert gaussians.scales.isfinite().all() and 0 < gaussians.scales.min() <= gaussians.scales.max() <= 0.03
    assert ((gaussians.colors >= 0) & (gaussians.colors <= 1)).all()
    (gaussians.scales.sum() + gaussians.colors.sum()).backward()
    assert all(one.grad is None or one.grad.isfinite().all() for one in avatar.parameters())


@pytest.mark.parametrize("turn", [math.pi, 3 * math.pi, 100.0])
def test_the_kernels_of_posing_agree_with_torch_in_extreme_poses(body, turn):
    avatar = Avatar(body, mean_identity(body), torch.arange(0, 13000, 7), SMALL)
    surface = avatar.surfaces[0]
    transforms = joint_transforms(random_pose(turn, 1), surface.canonical.joints, surface.canonical.parents)[
        0
    ]
    points, transl = surface.canonical.vertices, torch.tensor([0.0, 0.0, -2.0])
    means, quaternions = surface.skinning_tables.place(transforms, points, transl)
    expected_means, expected = plain_place(surface.skinning_tables, transforms, points, transl)
    torch.testing.assert_close(means, expected_means, rtol=1e-4, atol=1e-5)
    # A quaternion and its opposite are one rotation; where opposite turns are blended neither is known well.
    same = (quaternions * expected).sum(1).abs()
    assert quaternions.isfinite().all() and (same > 0.999).float().mean() > 0.99
    torch.testing.assert_close(quaternions.norm(dim=1), torch.ones(len(points)), rtol=0, atol=1e-4)
    normals = surface.skinning_tables.normals(transforms, points)
    assert normals.isfinite().all()
    length = normals.norm(dim=1)
    assert (((length - 1).abs() < 1e-3) | (length < 1e-3)).all()
    assert plain_normals(surface.skinning_tables, transforms, points).isfinite().all()


@pytest.mark.parametrize("field", ["v_template", "weights", "shapedirs"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_body_file_that_is_not_finite_is_refused(tmp_path, field, value):
    array = official_arrays()[field].copy()
    array.flat[5] = value
    with pytest.raises(UserError, match=f"{field} holds numbers that are not finite"):
        load_body(write_official(tmp_path / "body.npz", **{field: array}))


def test_the_rest_shape_of_any_coefficients_is_linear_and_finite(body):
    for size in (0.0, 1e-30, 1e20):
        assert rest_vertices(body, identity_of(body, size)).isfinite().all()
