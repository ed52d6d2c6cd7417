"""What an avatar may learn of the body it stands on (identity, opacity), and where correctives act."""

import dataclasses

import pytest
import torch

from pipeline.avatar import Architecture, Avatar, load_avatar, save_avatar
from pipeline.avatar.bake import bake
from pipeline.avatar.canonical import HANDS, HEAD, build_canonical, open_positions
from pipeline.body import Pose, mean_identity
from tests.made.body import open_body

SIZES = {"plane_resolution": 8, "plane_channels": 2, "width": 16, "groups": 4, "subdivisions": 0}


@pytest.fixture(scope="module")
def body():
    return open_body()


@pytest.fixture(scope="module")
def pose():
    generator = torch.Generator().manual_seed(3)
    rotation = 0.2 * torch.randn(55, 3, generator=generator)
    return Pose(rotation, torch.zeros(5), torch.tensor([0.1, 0.2, -2.0]))


def avatar_of(body, identity=None, **sizes):
    ids = torch.arange(len(body.v_template))
    identity = mean_identity(body) if identity is None else identity
    return Avatar(body, identity, ids, Architecture(**{**SIZES, **sizes})).eval()


def same(one, other, tolerance=1e-5):
    for ours, theirs in zip(one.tensors(), other.tensors(), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=tolerance)


@pytest.fixture(scope="module")
def changed(body):
    """An avatar whose identity has moved, and the identity that it should have come to."""
    avatar = avatar_of(body, learn_identity=True)
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for parameter in (avatar.identity_change.betas, avatar.identity_change.joint_offset):
            parameter.copy_(0.01 * torch.randn(parameter.shape, generator=generator))
        avatar.identity_change.betas.mul_(50)
    change, mean = avatar.identity_change, mean_identity(body)
    return avatar, dataclasses.replace(
        mean, betas=change.betas.detach(), joint_offset=change.joint_offset.detach()
    )


def test_changed_identity_poses_as_an_avatar_of_that_identity(body, pose, changed):
    avatar, identity = changed
    ours, theirs = avatar.gaussians(pose), avatar_of(body, identity).gaussians(pose)
    torch.testing.assert_close(ours.means, theirs.means, rtol=0, atol=1e-5)
    assert (ours.means - avatar_of(body).gaussians(pose).means).norm(dim=1).max() > 0.01


def test_gradients_reach_identity_and_opacity(body, pose):
    avatar = avatar_of(body, learn_identity=True, learn_opacity=True).train()
    gaussians = avatar.pose(avatar.decode(), pose).gaussians
    (gaussians.means.square().sum() + gaussians.opacities.sum()).backward()
    change = avatar.identity_change
    for parameter in (change.betas, change.joint_offset, avatar.opacity_logit):
        assert bool((parameter.grad != 0).any())
    assert gaussians.opacities.detach().tolist() == pytest.approx([0.999] * len(avatar), abs=1e-6)


@pytest.mark.parametrize("representation", ["triplane", "bases"])
def test_it_is_stored_baked_and_gated_with_the_rest(body, pose, tmp_path, representation):
    sizes = {"learn_identity": True, "learn_opacity": True, "representation": representation}
    avatar = avatar_of(body, correctives="face_and_hands", plane_pose="open", **sizes)
    generator = torch.Generator().manual_seed(7)
    with torch.no_grad():
        for parameter in avatar.parameters():
            parameter.add_(0.02 * torch.randn(parameter.shape, generator=generator))
    avatar.gate(torch.arange(len(avatar.vertex_ids)) % 5 > 0)
    expected = avatar.gaussians(pose)
    assert float(expected.opacities.detach().std()) > 0
    save_avatar(tmp_path / "avatar.safetensors", avatar)
    loaded = load_avatar(tmp_path / "avatar.safetensors", body)
    half = 0 if representation == "triplane" else 2e-3  # bases are stored in float16
    same(loaded.gaussians(pose), expected, 1e-6 + half)
    same(bake(loaded).gaussians(pose), loaded.gaussians(pose), 1e-4)


def test_correctives_act_on_face_and_hands_alone(body, pose):
    generator = torch.Generator().manual_seed(1)
    directions = 1e-3 * torch.randn(len(body.v_template), 3, 486, generator=generator)
    corrected = dataclasses.replace(body, pose_directions=directions)
    none, everywhere = avatar_of(body).gaussians(pose), avatar_of(corrected).gaussians(pose)
    avatar = avatar_of(corrected, correctives="face_and_hands")
    found, part = avatar.gaussians(pose), avatar.surface().canonical.is_part(*HEAD, *HANDS)
    torch.testing.assert_close(found.means[part], everywhere.means[part])
    torch.testing.assert_close(found.means[~part], none.means[~part])
    same(bake(avatar).gaussians(pose), found, 2e-3)
    avatar.gate(torch.arange(len(part)) % 3 > 0)
    torch.testing.assert_close(avatar.gaussians(pose).means, found.means[torch.arange(len(part)) % 3 > 0])


def test_open_positions_part_legs_and_lips_and_forget_the_person(body):
    ids, mean = torch.arange(len(body.v_template)), mean_identity(body)
    tall = dataclasses.replace(mean, betas=torch.ones_like(mean.betas))
    places = open_positions(body, mean, 1, ids)
    assert torch.equal(places, open_positions(body, tall, 1, ids))
    mesh = build_canonical(body, mean, 1)
    legs, arms = mesh.is_part("left_leg"), mesh.is_part("left_arm")
    assert places[legs, 0].max() > mesh.vertices[legs, 0].max() + 0.3
    torch.testing.assert_close(places[arms], mesh.vertices[arms], rtol=0, atol=0.02)
    assert (places - mesh.vertices)[mesh.is_part("face"), 1].min() < -0.01  # the jaw
