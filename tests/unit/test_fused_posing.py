"""Posing in one pass gives what posing step by step gives, gradients included."""

import dataclasses

import pytest
import torch

from pipeline.avatar.posed import LARGEST_SCALE
from pipeline.body import Pose
from pipeline.numba_kernels import threads
from tests.unit.test_avatar_representations import a_pose, an_avatar, half_gated


@pytest.fixture
def split(body):
    """An avatar some of whose scales are clamped, at either end and at the largest scale."""
    avatar = an_avatar(body, "split bases").train()
    log_scale = avatar.representation.log_scale
    log_scale.data[::3] = torch.tensor([-2.5, 1.5, 0.1])
    log_scale.data[::50] = 1.1
    return avatar


def answers(avatar, at_once: bool, pose_moves: bool = True, level: int = -1):
    """Posed tensors, and the gradients of pose and parameters, in one pass or step by step."""
    avatar.at_once = at_once
    pose, generator = a_pose(), torch.Generator().manual_seed(3)
    tensors = (pose.rotation, pose.expression, pose.transl)
    told = [one.clone().requires_grad_(pose_moves) for one in tensors]
    posed = avatar.pose(avatar.decode(level), Pose(*told))
    gaussians = posed.gaussians
    learnt = [gaussians.means, gaussians.scales, gaussians.colors, posed.color_logit, posed.log_scale]
    learnt += [] if posed.pose_offset is None else [posed.pose_offset]
    weights = [torch.randn(one.shape, generator=generator) for one in learnt]
    loss = sum((one * weight).sum() for one, weight in zip(learnt, weights, strict=True))
    wanted = [*(told if pose_moves else ()), *avatar.parameters()]
    return (*learnt, *gaussians.tensors()), torch.autograd.grad(loss, wanted, allow_unused=True)


def assert_alike(one, other):
    for mine, theirs in zip(one[0], other[0], strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-5, atol=1e-6)
    for mine, theirs in zip(one[1], other[1], strict=True):
        assert (mine is None) == (theirs is None)
        if mine is not None:
            assert (mine - theirs).norm() <= 1e-5 * theirs.norm()


@pytest.mark.parametrize("pose_moves", [True, False])
@pytest.mark.parametrize("gated", [True, False])
def test_one_pass_gives_what_the_steps_give(split, gated, pose_moves):
    split.gate(half_gated(split) if gated else torch.ones(len(split.vertex_ids), dtype=torch.bool))
    fused, plain = (answers(split, one, pose_moves) for one in (True, False))
    assert_alike(fused, plain)
    assert all(bool((gradient != 0).any()) for gradient in fused[1])
    scales = fused[0][1]
    assert bool((scales == LARGEST_SCALE).any())


def test_one_pass_on_a_coarser_level_without_bases_and_with_some_outputs_unused(split, monkeypatch):
    assert_alike(*(answers(split, at_once, level=0) for at_once in (True, False)))
    monkeypatch.setattr(split, "pose_heads_active", False)
    fused, plain = (answers(split, one) for one in (True, False))
    assert_alike(fused, plain)
    assert fused[1][-1] is None  # the bases


def test_the_gradient_of_one_output_alone_is_that_of_the_steps(split):
    for name in ("means", "scales", "colors"):
        found = []
        for at_once in (True, False):
            split.at_once = at_once
            posed = split.pose(split.decode(), a_pose())
            loss = getattr(posed.gaussians, name).square().sum()
            found.append(torch.autograd.grad(loss, list(split.parameters()), allow_unused=True))
        for mine, theirs in zip(*found, strict=True):
            mine, theirs = (torch.zeros(1) if one is None else one for one in (mine, theirs))
            assert (mine - theirs).norm() <= 1e-5 * theirs.norm()


def test_bytes_do_not_depend_on_the_number_of_threads(split):
    found = []
    for count in (1, 2):
        with threads(count):
            outputs, gradients = answers(split, at_once=True)
            found.append([*outputs, *gradients])
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))


def test_a_body_with_pose_correctives_is_posed_step_by_step(body):
    directions = 1e-3 * torch.randn(*body.v_template.shape, 486, generator=torch.Generator().manual_seed(0))
    avatar = an_avatar(dataclasses.replace(body, pose_directions=directions), "bases").eval()
    bare = an_avatar(body, "bases").eval()
    with torch.no_grad():
        apart = (avatar.gaussians(a_pose()).means - bare.gaussians(a_pose()).means).norm(dim=1)
    assert float(apart.max()) > 1e-3
