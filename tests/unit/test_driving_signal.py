"""The signal that drives linear bases: principal directions of the clip, clamped to what it showed."""

import dataclasses

import pytest
import torch

from pipeline.avatar.driving_signal import BEND_AT, SLACK, fit_driving_signal, signal_features
from pipeline.finite import NotFiniteError


def features(frames: int = 12, seed: int = 0) -> torch.Tensor:
    """Two directions of 9 features, one three times as strong as the other."""
    generator = torch.Generator().manual_seed(seed)
    ways = torch.linalg.qr(torch.randn(9, 2, generator=generator)).Q.T
    strengths = torch.randn(frames, 2, generator=generator) * torch.tensor([0.3, 0.1])
    return 5 + strengths @ ways


def test_directions_are_uncorrelated_with_unit_variance():
    known = features()
    signal = fit_driving_signal(known, 8)
    assert len(signal) == 2  # no more than the clip has
    values = torch.stack([signal(row) for row in known])
    torch.testing.assert_close(values.mean(0), torch.zeros(2), atol=1e-4, rtol=0)
    torch.testing.assert_close(values.T @ values / len(known), torch.eye(2), atol=1e-3, rtol=0)


def test_strongest_direction_comes_first_and_asks_for_one_give_one():
    assert torch.equal(fit_driving_signal(features(), 1).components, fit_driving_signal(features(), 2)
                       .components[:1])  # fmt: skip


def test_signs_do_not_depend_on_the_order_of_frames():
    known = features()
    one, other = fit_driving_signal(known, 2), fit_driving_signal(known.flip(0), 2)
    torch.testing.assert_close(one.components, other.components, rtol=1e-3, atol=1e-4)
    greatest = one.components.gather(1, one.components.abs().argmax(1, keepdim=True))
    assert bool((greatest > 0).all())


def test_signal_stays_near_what_the_frames_showed():
    known = features()
    signal = fit_driving_signal(known, 2)
    values = torch.stack([signal(row) for row in known])
    span = values.amax(0) - values.amin(0)
    for far in (1e6, -1e6):
        driven = signal(known[0] + far)
        assert bool((driven <= values.amax(0) + 1.01 * SLACK * span).all())
        assert bool((driven >= values.amin(0) - 1.01 * SLACK * span).all())


def test_bends_are_zero_up_to_where_they_begin_and_then_linear():
    known = features(200)
    plain, bent = fit_driving_signal(known, 2), fit_driving_signal(known, 2).bent(8)
    assert len(bent) == 6 and bent.bends == 4 and plain.bends == 0
    for row in known:
        straight = plain(row)
        beyond = torch.stack([(straight - BEND_AT).clamp_min(0), (straight + BEND_AT).clamp_max(0)], 1)
        torch.testing.assert_close(bent(row), torch.cat([straight, beyond.flatten()]))
    assert torch.equal(bent(bent.mean), torch.zeros(6))


def test_the_strongest_directions_bend_first():
    signal = fit_driving_signal(features(200), 2)
    assert torch.equal(signal.bent(2).components, signal.components[[0, 1, 0, 0]])
    assert torch.equal(signal.bent(0).limits, signal.limits)


def test_a_clip_that_hardly_leaves_its_mean_has_no_bends():
    near = 5 + torch.tensor([1.0, -1, 1, -1, 1, -1])[:, None] * torch.ones(9) * 0.1
    short = dataclasses.replace(fit_driving_signal(near, 1), limits=torch.tensor([[-0.9], [0.9]]))
    assert short.bent(8).bends == 0
    assert fit_driving_signal(torch.ones(20, 9), 8).bent(8).bends == 0


@pytest.mark.parametrize(("frames", "count"), [(1, 0), (2, 1), (3, 2)])
def test_few_frames_have_few_directions(frames, count):
    generator = torch.Generator().manual_seed(3)
    assert len(fit_driving_signal(torch.randn(frames, 9, generator=generator), 8)) == count


def test_clip_that_stands_still_drives_nothing():
    still = torch.ones(20, 9) + 1e-5 * features(20)
    signal = fit_driving_signal(still, 8)
    assert len(signal) == 0 and signal(still[0]).shape == (0,)


def test_features_that_are_not_finite_are_refused_by_name():
    known = features()
    known[3, 2] = torch.nan
    with pytest.raises(NotFiniteError, match="pose or expression"):
        fit_driving_signal(known, 2)


def test_short_expressions_are_padded():
    told = signal_features(torch.ones(4, 6), torch.ones(4, 2), 5)
    assert told.shape == (4, 11) and float(told[:, 8:].abs().max()) == 0
    assert signal_features(torch.ones(6), torch.ones(7), 5).shape == (11,)
