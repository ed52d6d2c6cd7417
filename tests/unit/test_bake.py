"""A baked avatar shows what the avatar shows."""

import dataclasses

import numba
import pytest
import torch

from pipeline import device
from pipeline.avatar import Architecture, Avatar
from pipeline.avatar.bake import bake
from pipeline.avatar.fused_head import HeadParameters, decode
from pipeline.avatar.head import Head
from pipeline.avatar.skinning_kernels import normals_of_vertices
from pipeline.avatar.skinning_tables import faces_of_vertices, joints_of_points
from pipeline.body import Pose, mean_identity, vertex_normals
from pipeline.clip.camera import facing_camera
from pipeline.numba_kernels import threads
from pipeline.splat import render
from stages.evaluate.methods import baked_animation

SMALL = Architecture(plane_resolution=8, plane_channels=2, width=16, groups=2, subdivisions=1)
WITH_RESIDUALS = dataclasses.replace(SMALL, residual_parts=("face", "left_hand", "rest"), residual_width=8)


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """Small cases: threads would mostly wait for each other."""
    numba.get_num_threads()  # its pool, when it starts, sets torch's number of threads
    with threads(1):
        yield


def an_avatar(body, architecture=SMALL, half_precision=False, directions=None) -> Avatar:
    """Head, arms and some torso, every head with a say."""
    if directions is not None:
        body = dataclasses.replace(body, pose_directions=directions)
    kept = torch.nonzero(body.v_template[:, 1] > 0.15)[:, 0]
    avatar = Avatar(body, mean_identity(body), kept, architecture, half_precision=half_precision)
    generator = torch.Generator().manual_seed(5)
    for parameter in avatar.parameters():
        parameter.data += 0.05 * torch.randn(parameter.shape, generator=generator)
    avatar.base_color.normal_(generator=generator)
    avatar.representation.residuals.time_range.copy_(torch.tensor([0.0, 4.0]))
    return avatar.eval()


def a_pose():
    generator = torch.Generator().manual_seed(1)
    rotation = 0.3 * torch.randn(55, 3, generator=generator)
    rotation[0] = torch.tensor([0.0, 3.0, 0.3])  # turned round: every branch of the quaternions
    return Pose(rotation, torch.randn(7, generator=generator), torch.tensor([0.1, -0.3, -1.5]))


def assert_same(avatar, baked, tolerance, **options):
    with torch.no_grad():
        expected = avatar.gaussians(a_pose(), **options).tensors()
    for mine, theirs in zip(baked.gaussians(a_pose(), **options).tensors(), expected, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("heads", [True, False])
def test_baked_gaussians_are_the_avatars(body, heads):
    avatar = an_avatar(body)
    avatar.pose_heads_active = heads
    assert_same(avatar, bake(avatar), 1e-4)


@pytest.mark.parametrize("place", ["canonical", "posed"])
def test_baked_residual_colours_follow_the_time(body, place):
    avatar = an_avatar(body, dataclasses.replace(WITH_RESIDUALS, residual_place=place, place_frequencies=2))
    baked = bake(avatar)
    assert set(baked.representation.parts) >= {"face", "rest"}
    for time in (None, 1.3, 9.0):
        assert_same(avatar, baked, 1e-4, time=time)
    colors = [baked.gaussians(a_pose(), time=time).colors for time in (None, 1.3)]
    assert (colors[0] - colors[1]).abs().max() > 1e-4


@pytest.mark.parametrize("place", ["canonical", "posed"])
def test_baked_residuals_move_what_the_avatars_move(body, place):
    sizes = dataclasses.replace(
        WITH_RESIDUALS, residual_moves=True, residual_place=place, place_frequencies=2
    )
    avatar = an_avatar(body, sizes)
    baked = bake(avatar)
    for time in (None, 1.3):
        assert_same(avatar, baked, 1e-4, time=time)
    avatar.residuals_active = False
    unmoved = avatar.gaussians(a_pose()).means
    assert (baked.gaussians(a_pose()).means - unmoved).norm(dim=1).max() > 1e-4


def test_baked_pose_correctives_are_as_good_as_exact(body):
    generator = torch.Generator().manual_seed(2)
    directions = 1e-3 * torch.randn(len(body.v_template), 3, 486, generator=generator)
    avatar = an_avatar(body, dataclasses.replace(SMALL, subdivisions=0), directions=directions)
    baked = bake(avatar)
    with torch.no_grad():
        apart = baked.gaussians(a_pose()).means - avatar.gaussians(a_pose()).means
    assert apart.norm(dim=1).max() < 2e-4  # a fifth of a millimetre, of offsets of centimetres


def test_baked_in_half_precision_renders_as_well_as_the_avatar_in_half_precision(body, monkeypatch):
    monkeypatch.setattr(device, "multiplies_bfloat16", lambda device: True)
    exact, half = an_avatar(body), an_avatar(body, half_precision=True)
    camera = facing_camera(64, 64, 60.0)
    with torch.no_grad():
        pictures = [render(one.gaussians(a_pose()), camera).color for one in (exact, half, bake(half))]
    lost, ours = (float((picture - pictures[0]).abs().mean()) for picture in pictures[1:])
    assert ours < 1.2 * lost + 1e-5
    assert lost > 0


@pytest.mark.parametrize(("inputs", "width", "groups"), [(12, 16, 4), (9, 24, 3), (5, 8, 1), (7, 8, 8)])
def test_a_fused_head_is_the_head_with_gradients(inputs, width, groups):
    torch.manual_seed(0)
    head, points = Head(inputs, 5, condition=7, width=width, groups=groups), torch.randn(4100, inputs)
    for parameter in head.parameters():
        parameter.data = 0.3 * torch.randn(parameter.shape)
    condition, push = torch.randn(7), torch.randn(4100, 5)
    linear, norms = [head.first, *head.hidden, head.last], head.norms
    results = []
    for fused in (False, True):
        given = points.clone().requires_grad_()
        layers = HeadParameters.of(linear, norms)
        shared = layers.biases[0] + head.condition(condition)
        layers = dataclasses.replace(layers, biases=(shared, *layers.biases[1:]))
        output = decode(given, layers, torch.float32) if fused else head(given, condition)
        results.append([output, *torch.autograd.grad((output * push).sum(), [given, *head.parameters()])])
        if fused:
            with torch.no_grad():
                assert torch.equal(decode(given, layers, torch.float32), output)
    for plain, ours in zip(*results, strict=True):
        assert (plain - ours).norm() < 1e-4 * plain.norm() + 1e-4


def test_normals_and_joints_are_those_of_the_body(body):
    normals, starts_around = torch.empty_like(body.v_template), faces_of_vertices(body.faces, 13524)
    arrays = (one.numpy() for one in (body.v_template, body.faces.int(), *starts_around))
    normals_of_vertices(*arrays, normals.numpy())
    torch.testing.assert_close(normals, vertex_normals(body.v_template, body.faces), rtol=1e-4, atol=1e-4)
    joints, weights = joints_of_points(body.skinning_weights)
    dense = torch.zeros_like(body.skinning_weights).scatter_add_(1, joints.long(), weights)
    assert torch.equal(dense, body.skinning_weights)


def test_evaluate_animates_the_baked_avatar_as_it_would_the_avatar(body):
    avatar = an_avatar(body, WITH_RESIDUALS)
    with torch.no_grad():
        expected = avatar.gaussians(a_pose(), 1.3).tensors()
    for mine, theirs in zip(baked_animation(avatar)(a_pose(), 1.3).tensors(), expected, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-4)
