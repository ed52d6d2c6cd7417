"""Smoothing of poses over time, against scipy's Savitzky-Golay filter and motions that it must keep."""

import dataclasses
import math

import numpy as np
import pytest
import roma
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import savgol_filter

from pipeline.body import Poses
from stages.fit.smoothing import nearest_branch, smooth

FAST = settings(max_examples=30, deadline=None)


def poses_of(frames, rotation=None, expression=None, transl=None, valid=None):
    count = len(frames)
    return Poses(
        tuple(int(f) for f in frames),
        torch.zeros(count, 55, 3) if rotation is None else rotation,
        torch.zeros(count, 2) if expression is None else expression,
        torch.zeros(count, 3) if transl is None else transl,
        torch.ones(count, dtype=torch.bool) if valid is None else torch.as_tensor(valid),
    )


def noise(*shape, seed=0, scale=1.0):
    return torch.from_numpy(np.random.default_rng(seed).normal(size=shape) * scale)


def spin(frames, speed, axis=(0.0, 1.0, 0.0), start=0.0):
    """[T, 55, 3] float64: every joint turns about an axis, its vector growing without end."""
    angle = start + speed * torch.tensor(frames, dtype=torch.float64)
    direction = torch.tensor(axis, dtype=torch.float64)
    direction = direction / direction.norm()
    return (angle[:, None] * direction)[:, None].expand(-1, 55, -1)


def apart(a, b):
    """Angles between rotations, [T, 55], radians."""
    return roma.rotmat_geodesic_distance(roma.rotvec_to_rotmat(a.double()), roma.rotvec_to_rotmat(b.double()))


def largest_apart(a, b):
    """The largest angle; from chords, since the arc cosine of a cosine near 1 has no digits."""
    chord = (roma.rotvec_to_rotmat(a.double()) - roma.rotvec_to_rotmat(b.double())).flatten(-2).norm(dim=-1)
    return float(2 * torch.asin((chord / math.sqrt(8)).clamp(max=1)).max())


@pytest.mark.parametrize("stride", [1, 3])
@pytest.mark.parametrize(("window", "order"), [(9, 2), (5, 1), (7, 3), (3, 0)])
def test_even_frames_give_what_scipy_gives_ends_included(stride, window, order):
    transl, expression = noise(30, 3), noise(30, 5, seed=1)
    out = smooth(poses_of(range(4, 4 + 30 * stride, stride), None, expression, transl), window, order)
    for got, given_ in ((out.transl, transl), (out.expression, expression)):
        torch.testing.assert_close(
            got, torch.from_numpy(savgol_filter(given_.numpy(), window, order, axis=0)), rtol=0, atol=1e-10
        )


def test_rotations_give_what_scipy_gives_on_quaternions():
    rotation = noise(25, 55, 3, scale=0.3)
    quaternions = roma.rotvec_to_unitquat(rotation).numpy()
    filtered = torch.from_numpy(savgol_filter(quaternions, 9, 2, axis=0))
    expected = roma.unitquat_to_rotvec(roma.quat_normalize(filtered))
    assert largest_apart(smooth(poses_of(range(25), rotation), 9).rotation, expected) < 1e-8


def test_off_and_windows_that_cannot_be():
    poses = poses_of(range(5), transl=noise(5, 3))
    assert smooth(poses, 0) is poses
    for window, order in ((4, 2), (1, 2), (-3, 2), (9, -1)):
        with pytest.raises(ValueError, match="window"):
            smooth(poses, window, order)


@FAST
@given(
    steps=st.lists(st.integers(1, 9), min_size=1, max_size=30),
    window=st.sampled_from([3, 5, 9]),
    hidden=st.integers(0, 2**31),
    curved=st.booleans(),
)
def test_steady_and_accelerated_motion_are_kept_however_frames_are_dropped(steps, window, hidden, curved):
    """A line whatever was measured of it, a parabola where all frames were."""
    frames = np.cumsum([2, *steps])
    valid = curved | (np.random.default_rng(hidden).random(len(frames)) < 0.7)
    time = torch.from_numpy(frames / 30.0)[:, None]
    transl = torch.tensor([0.3, -0.1, -3.0]) + time * torch.tensor([1.0, 0.5, -0.2]) - curved * time**2 * 0.4
    out = smooth(poses_of(frames, transl=transl, valid=valid), window)
    assert (out.rotation.abs() < 1e-9).all()
    torch.testing.assert_close(out.transl, transl, rtol=0, atol=1e-8)


def test_constant_poses_stay():
    one = noise(1, 55, 3, scale=1.5)
    out = smooth(poses_of(range(20), one.expand(20, -1, -1), transl=torch.ones(20, 3)), 9)
    assert largest_apart(out.rotation, one.expand(20, -1, -1)) < 1e-7
    torch.testing.assert_close(out.rotation, one.expand(20, -1, -1), rtol=0, atol=1e-7)


@pytest.mark.parametrize("axis", [(0.0, 1.0, 0.0), (1.0, 1.0, -0.5)])
@pytest.mark.parametrize(("speed", "ends"), [(0.05, 1e-4), (0.1, 1e-3), (0.4, 0.05)])
def test_a_body_that_spins_several_times_keeps_its_speed(axis, speed, ends):
    frames = range(int(5 * math.pi / speed))  # two and a half turns
    rotation = spin(frames, speed, axis)
    out = smooth(poses_of(frames, rotation), 9).rotation
    assert largest_apart(out[4:-4], rotation[4:-4]) < 1e-6  # whole windows: exact
    assert largest_apart(out, rotation) < ends
    assert (out - rotation).abs().max() < max(ends, 1e-6)  # and not one turn folded back


def test_a_turn_within_pi_of_the_seam_stays_on_its_branch():
    frames = range(40)
    for sign in (1.0, -1.0):
        rotation = spin(frames, sign * 0.01, (1.0, 0.02, 0.0), start=sign * (math.pi - 0.2))
        out = smooth(poses_of(frames, rotation), 9).rotation
        assert (out - rotation).abs().max() < 1e-4


def test_vectors_that_jump_at_pi_are_one_motion():
    """The estimator's root is near pi about X, and its vector may come with either sign."""
    rotation = spin(range(40), 0.01, (1.0, 0.0, 0.0), start=math.pi - 0.2)
    folded = roma.unitquat_to_rotvec(roma.rotvec_to_unitquat(rotation))
    assert (folded[1:] - folded[:-1]).abs().max() > 6
    assert largest_apart(smooth(poses_of(range(40), folded), 9).rotation, rotation) < 1e-4


@FAST
@given(seed=st.integers(0, 2**31), turns=st.integers(-3, 3))
def test_nearest_branch_keeps_the_rotation_and_comes_within_half_a_turn(seed, turns):
    rotation = noise(6, 3, seed=seed)
    reference = rotation * (1 + 2 * math.pi * turns / rotation.norm(dim=-1, keepdim=True))
    found = nearest_branch(rotation, reference)
    torch.testing.assert_close(found, reference, rtol=0, atol=1e-9)
    assert largest_apart(found, rotation) < 1e-7
    still = nearest_branch(torch.zeros(1, 3), torch.tensor([[0.0, 2 * math.pi, 0.0]]))
    torch.testing.assert_close(still, torch.tensor([[0.0, 2 * math.pi, 0.0]]))


def test_noise_falls():
    frames = range(200)
    truth = torch.stack([torch.sin(torch.arange(200) / 20.0)] * 3, 1).double()
    noisy = truth + noise(200, 3, scale=0.02)
    out = smooth(poses_of(frames, transl=noisy), 9)
    assert (out.transl - truth).std() < 0.6 * (noisy - truth).std()  # white noise: sqrt(0.255) = 0.505
    rotation = spin(frames, 0.03) + noise(200, 55, 3, seed=2, scale=0.02)
    turned = smooth(poses_of(frames, rotation), 9).rotation
    assert apart(turned, spin(frames, 0.03)).mean() < 0.6 * apart(rotation, spin(frames, 0.03)).mean()


def test_frames_that_were_not_measured_have_no_say():
    frames = np.arange(30)
    valid = ~np.isin(frames, [3, 10, 11, 20])
    transl = torch.from_numpy(frames / 30.0)[:, None].expand(-1, 3).clone()
    rotation = spin(frames, 0.02).clone()
    wild, wild_rotation = transl.clone(), rotation.clone()
    wild[~valid] += 5.0
    wild_rotation[~valid] += noise(4, 55, 3, scale=2.0)
    out = smooth(poses_of(frames, wild_rotation, transl=wild, valid=valid), 9)
    torch.testing.assert_close(out.transl, transl, rtol=0, atol=1e-9)
    assert largest_apart(out.rotation, rotation) < 1e-4
    assert out.valid.tolist() == valid.tolist()


def test_long_gaps_move_along_with_what_was_measured_at_their_ends():
    """Nothing is extrapolated: a parabola through three frames is far off ten frames later."""
    frames = np.arange(40)
    valid = (frames >= 5) & ((frames < 12) | (frames >= 30))
    raw = noise(40, 3, scale=0.01)
    out = smooth(poses_of(frames, transl=raw, valid=valid), 9).transl
    change = out - raw
    torch.testing.assert_close(change[:5], change[5].expand(5, 3), rtol=0, atol=1e-12)
    weight = torch.linspace(0, 1, 20, dtype=torch.float64)[:, None]
    torch.testing.assert_close(
        change[11:31], change[11] * (1 - weight) + change[30] * weight, rtol=0, atol=1e-9
    )
    alone = savgol_filter(raw[30:].numpy(), 9, 2, axis=0)  # the run after the gap, by itself
    torch.testing.assert_close(out[30:], torch.from_numpy(alone), rtol=0, atol=1e-10)


@pytest.mark.parametrize("count", [1, 2, 3, 5, 8])
def test_runs_shorter_than_the_window(count):
    raw = noise(count, 3)
    out = smooth(poses_of(range(count), transl=raw), 9).transl
    degree = min(2, count - 1)
    time = np.arange(count)
    fitted = np.stack([np.polyval(np.polyfit(time, raw[:, k].numpy(), degree), time) for k in range(3)], 1)
    torch.testing.assert_close(out, torch.from_numpy(fitted), rtol=0, atol=1e-9)


def test_a_clip_of_which_nothing_was_measured_is_left_alone():
    poses = poses_of(range(6), transl=noise(6, 3), valid=[False] * 6)
    assert smooth(poses, 9) is poses


def test_ten_thousand_frames_with_gaps_are_finite_and_float32():
    rng = np.random.default_rng(3)
    frames = np.flatnonzero(rng.random(12_000) < 0.85)[:10_000]
    poses = poses_of(
        frames, noise(len(frames), 55, 3, scale=0.5).float(), valid=rng.random(len(frames)) < 0.9
    )
    poses = dataclasses.replace(poses, transl=noise(len(frames), 3).float())
    out = smooth(poses, 9)
    for name in ("rotation", "expression", "transl"):
        assert getattr(out, name).dtype == torch.float32 and torch.isfinite(getattr(out, name)).all()
