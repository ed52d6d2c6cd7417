"""The residual colours of face and hands: which Gaussians they touch, what they are told, their file."""

import dataclasses

import numpy as np
import pytest
import torch

from pipeline.avatar import Architecture, Avatar, load_avatar, save_avatar
from pipeline.avatar.residual import PLACES, REST, encode, part_rows
from pipeline.body import Pose, mean_identity

SMALL = Architecture(
    plane_resolution=8,
    plane_channels=2,
    width=8,
    groups=2,
    subdivisions=1,
    residual_parts=("face", "left_hand", "right_hand"),
    residual_width=8,
)
REFINED = ("face", "left_hand", "right_hand")


@pytest.fixture(scope="module")
def kept(body):
    """Everything above the waist: face and hands are in it."""
    return torch.nonzero(body.v_template[:, 1] > 0)[:, 0]


def made(body, kept, awake=True, **changes) -> Avatar:
    """An avatar whose every head has a say if ``awake``; filmed from second 2 to second 6."""
    avatar = Avatar(body, mean_identity(body), kept, dataclasses.replace(SMALL, **changes), seed=3)
    if awake:
        generator = torch.Generator().manual_seed(5)
        for parameter in avatar.parameters():
            parameter.data += 0.05 * torch.randn(parameter.shape, generator=generator)
    avatar.representation.residuals.time_range.copy_(torch.tensor([2.0, 6.0]))
    return avatar.eval()


def a_pose():
    generator = torch.Generator().manual_seed(1)
    return Pose(
        0.2 * torch.randn(55, 3, generator=generator),
        torch.randn(5, generator=generator),
        torch.tensor([0.1, -0.3, -1.5]),
    )


def test_encoding_by_hand():
    values = torch.tensor([[0.0, 0.5]])
    # Of each value in turn: sin pi x, sin 2 pi x, cos pi x, cos 2 pi x.
    expected = torch.tensor([[0.0, 0.5, 0, 0, 1, 1, 1, 0, 0, -1]])
    torch.testing.assert_close(encode(values, 2), expected, rtol=0, atol=1e-6)
    assert encode(torch.zeros(7, 3), 6).shape == (7, 3 * 13)


def test_residuals_add_nothing_at_birth(body, kept):
    plain, born = made(body, kept, awake=False, residual_parts=()), made(body, kept, awake=False)
    for mine, theirs in zip(
        plain.gaussians(a_pose()).tensors(), born.gaussians(a_pose(), 3.0).tensors(), strict=True
    ):
        assert torch.equal(mine, theirs)
    assert not any("residuals.heads" in name for name, _ in plain.named_parameters())


def test_residuals_change_colours_of_their_parts_and_nothing_else(body, kept):
    avatar = made(body, kept)
    canonical = avatar.surfaces[-1].canonical
    with torch.no_grad():
        posed = avatar.pose(avatar.decode(), a_pose(), time=3.0)
        avatar.residuals_active = False
        without = avatar.pose(avatar.decode(), a_pose(), time=3.0)
    assert without.color_residual is None
    moved = (posed.gaussians.colors != without.gaussians.colors).any(1)
    assert torch.equal(moved, canonical.is_part(*REFINED))
    assert torch.equal(posed.color_logit, without.color_logit + posed.color_residual)
    for name in ("means", "quaternions", "scales", "opacities"):
        assert torch.equal(getattr(posed.gaussians, name), getattr(without.gaussians, name)), name


def test_gradients_of_colour_reach_the_residuals_and_of_place_do_not(body, kept):
    avatar = made(body, kept).train()
    gaussians = avatar.pose(avatar.decode(), a_pose(), time=3.0).gaussians
    gaussians.means.square().sum().backward(retain_graph=True)
    residual = [parameter for name, parameter in avatar.named_parameters() if name.startswith("residuals.")]
    assert all(parameter.grad is None for parameter in residual)
    gaussians.colors.square().sum().backward()
    assert all(float(parameter.grad.abs().max()) > 0 for parameter in residual)


@pytest.mark.parametrize("place", PLACES)
def test_place_is_the_skins_or_the_worlds(body, kept, place):
    avatar = made(body, kept, residual_place=place)
    pose = a_pose()
    here = avatar.gaussians(pose, 3.0).colors
    there = avatar.gaussians(dataclasses.replace(pose, transl=pose.transl + 0.3), 3.0).colors
    assert torch.equal(here, there) == (place == "canonical")


def test_gaussian_has_the_same_code_on_every_level(body, kept):
    avatar = made(body, kept)
    for coarse, fine in zip(avatar.surfaces[0].residual, avatar.surfaces[1].residual, strict=True):
        assert coarse.part == fine.part and len(fine.rows) > 3 * len(coarse.rows)
        assert torch.equal(coarse.rows, fine.rows[: len(coarse.rows)])
        assert torch.equal(coarse.encoded, fine.encoded[: len(coarse.rows)])
        assert fine.encoded[:, :3].abs().max() <= 1.1


def test_time_tells_moments_apart_and_is_clamped_outside_training(body, kept):
    avatar = made(body, kept)
    codes = [avatar.representation.residuals.time_code(2 + 4 * share) for share in np.linspace(0, 1, 33)]
    assert len({tuple(code.tolist()) for code in codes}) == 33
    assert torch.equal(avatar.representation.residuals.time_code(100.0), codes[-1])
    assert torch.equal(avatar.representation.residuals.time_code(-7.0), codes[0])
    last, after = avatar.gaussians(a_pose(), 6.0), avatar.gaussians(a_pose(), 60.0)
    assert torch.equal(last.colors, after.colors)
    assert not torch.equal(last.colors, avatar.gaussians(a_pose(), 4.0).colors)


def test_motion_without_a_clock_has_a_look_of_its_own(body, kept):
    avatar = made(body, kept)
    assert torch.equal(avatar.representation.residuals.time_code(None), torch.zeros(13))
    timeless = avatar.gaussians(a_pose()).colors
    assert torch.equal(timeless, avatar.gaussians(a_pose(), None).colors)
    # It does not hang on when the clip was filmed, and no filmed moment is told the same.
    avatar.representation.residuals.time_range.add_(10)
    assert torch.equal(timeless, avatar.gaussians(a_pose()).colors)
    codes = [avatar.representation.residuals.time_code(12 + 4 * share) for share in np.linspace(0, 1, 100)]
    assert min(float(code.norm()) for code in codes) > 1


def test_a_clip_of_one_moment_has_a_time(body, kept):
    avatar = made(body, kept)
    avatar.representation.residuals.time_range.fill_(3.0)
    assert torch.isfinite(avatar.representation.residuals.time_code(3.0)).all()


def test_parts_that_are_not_kept_get_no_head(body):
    head = torch.nonzero(body.v_template[:, 1] > 0.2)[:, 0]
    avatar = made(body, head[body.v_template[head, 0].abs() < 0.3])
    assert list(avatar.representation.residuals.heads) == ["face"]


def test_rest_is_what_the_others_leave(body, kept):
    canonical = made(body, kept).surfaces[-1].canonical
    rows = part_rows(canonical, (*REFINED, REST))
    assert torch.equal(torch.cat(list(rows.values())).sort().values, torch.arange(len(canonical)))
    assert len(part_rows(canonical, (REST,))[REST]) == len(canonical)
    with pytest.raises(ValueError, match="no part tail"):
        part_rows(canonical, ("tail",))


def test_saved_residuals_are_read_back(tmp_path, body, kept):
    avatar = made(body, kept, residual_place="posed", time_frequencies=3)
    path = tmp_path / "avatar.safetensors"
    save_avatar(path, avatar)
    again = load_avatar(path, body)
    assert again.architecture == avatar.architecture and again.residuals_active
    for time in (None, 3.0, 99.0):
        assert torch.equal(avatar.gaussians(a_pose(), time).colors, again.gaussians(a_pose(), time).colors)


def test_positions_move_only_where_residuals_are_told_to_move_them(body, kept):
    avatar = made(body, kept, residual_moves=True)
    refined = avatar.surfaces[-1].canonical.is_part(*REFINED)
    with torch.no_grad():
        posed = avatar.pose(avatar.decode(), a_pose(), time=3.0).gaussians
        avatar.residuals_active = False
        without = avatar.pose(avatar.decode(), a_pose(), time=3.0).gaussians
    moved = (posed.means != without.means).any(1)
    assert torch.equal(moved, refined)
    assert (posed.means - without.means).norm(dim=1).max() < 0.1  # metres
    for name in ("quaternions", "scales", "opacities"):
        assert torch.equal(getattr(posed, name), getattr(without, name)), name


def test_moves_are_at_rest_and_turn_with_the_body(body, kept):
    avatar = made(body, kept, residual_moves=True)
    turns = [torch.zeros(55, 3) for _ in range(2)]
    turns[1][0, 1] = torch.pi / 2  # the whole body, which the heads are not told
    moves = []
    for rotation in turns:
        pose = dataclasses.replace(a_pose(), rotation=rotation)
        with torch.no_grad():
            avatar.residuals_active = True
            there = avatar.gaussians(pose, 3.0).means
            avatar.residuals_active = False
            moves.append(there - avatar.gaussians(pose, 3.0).means)
    quarter = torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])  # about Y
    torch.testing.assert_close(moves[1], moves[0] @ quarter.T, rtol=0, atol=1e-6)


def test_gradients_of_place_reach_exactly_the_parameters_of_moves(body, kept):
    avatar = made(body, kept, residual_moves=True).train()
    posed = avatar.pose(avatar.decode(), a_pose(), time=3.0)
    moved = posed.gaussians.means.square().sum()
    residual = {name: one for name, one in avatar.named_parameters() if "residuals." in name}
    found = dict(zip(residual, torch.autograd.grad(moved, residual.values(), retain_graph=True), strict=True))
    for name, gradient in found.items():
        if ".last." in name:  # rows 0 to 2 are colours, 3 to 5 moves
            assert not bool(gradient[:3].any()) and bool((gradient[3:] != 0).any()), name
        else:
            assert bool((gradient != 0).any()), name
    colors = torch.autograd.grad(posed.gaussians.colors.sum(), residual.values())
    last = [one for name, one in zip(residual, colors, strict=True) if ".last." in name]
    assert all(bool((one[:3] != 0).any()) and not bool(one[3:].any()) for one in last)


def test_an_avatar_without_moves_has_the_weights_and_the_file_that_it_had(tmp_path, body, kept):
    plain, moving = made(body, kept, awake=False), made(body, kept, awake=False, residual_moves=True)
    pairs = dict(moving.named_parameters())
    for name, parameter in plain.named_parameters():
        if ".last." not in name:
            assert torch.equal(parameter, pairs[name]), name
    for mine, theirs in zip(
        plain.gaussians(a_pose(), 3.0).tensors(), moving.gaussians(a_pose(), 3.0).tensors(), strict=True
    ):
        assert torch.equal(mine, theirs)
    for avatar, named in ((plain, False), (moving, True)):
        path = tmp_path / "avatar.safetensors"
        save_avatar(path, avatar)
        assert (b"residual_moves" in path.read_bytes()) == named
        assert load_avatar(path, body).architecture == avatar.architecture
