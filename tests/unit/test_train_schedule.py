"""What depends on the iteration alone, and the settings that set it."""

import dataclasses

import pytest
import torch

from stages.train import schedule
from stages.train.settings import TrainSettings

SETTINGS = TrainSettings(iterations=100, warm_up=10, final_rate=0.1)


def test_rate_rises_then_falls_to_its_last_factor():
    rates = [schedule.rate_factor(SETTINGS, iteration) for iteration in range(100)]
    assert rates[0] == pytest.approx(0.1)
    assert max(rates) == max(rates[9:12])
    assert all(a > b for a, b in zip(rates[10:], rates[11:], strict=False))
    assert rates[-1] == pytest.approx(0.1, abs=0.01)
    assert rates[50] == pytest.approx(0.55)


def test_rate_falls_in_steps():
    settings = dataclasses.replace(SETTINGS, schedule="steps", warm_up=0)
    rates = [schedule.rate_factor(settings, iteration) for iteration in range(100)]
    assert rates == [1.0] * 75 + [0.1] * 20 + [0.01] * 5


def test_residual_colours_come_in_evenly():
    settings = dataclasses.replace(SETTINGS, residual_from=0.2, residual_ramp=0.1)
    shares = [schedule.residual_share(settings, iteration) for iteration in (0, 20, 25, 30, 99)]
    assert shares == pytest.approx([0, 0, 0.5, 1, 1])
    assert schedule.residual_share(SETTINGS, 0) == 1
    with pytest.raises(ValueError, match="residual_ramp"):
        TrainSettings(residual_from=0.9, residual_ramp=0.2)


@pytest.mark.parametrize(("fraction", "first"), [(0.0, 0), (0.4, 40), (1.0, None)])
def test_fraction_of_the_run(fraction, first):
    begun = [schedule.begun(SETTINGS, fraction, iteration) for iteration in range(100)]
    assert begun == [first is not None and iteration >= first for iteration in range(100)]


def test_every_frame_is_drawn_once_an_epoch_in_changing_order():
    frames = (3, 5, 8, 13)
    drawn = [schedule.drawn_frame(1, frames, position) for position in range(40)]
    epochs = [tuple(drawn[start : start + 4]) for start in range(0, 40, 4)]
    assert all(sorted(epoch) == list(frames) for epoch in epochs)
    assert len(set(epochs)) > 1


def test_draws_need_no_history():
    frames = tuple(range(50))
    forward = [schedule.drawn_frame(7, frames, position) for position in range(120)]
    backward = [schedule.drawn_frame(7, frames, position) for position in reversed(range(120))]
    assert forward == backward[::-1]
    assert torch.equal(schedule.drawn_background(7, 5), schedule.drawn_background(7, 5))
    assert not torch.equal(schedule.drawn_background(7, 5), schedule.drawn_background(7, 6))
    assert torch.equal(schedule.drawn_noise(7, 5, 9), schedule.drawn_noise(7, 5, 9))
    assert not torch.equal(schedule.drawn_noise(7, 5, 9), schedule.drawn_noise(7, 6, 9))
    assert forward != [schedule.drawn_frame(8, frames, position) for position in range(120)]


def test_steps_cost_what_takes_part_in_them():
    bases = TrainSettings(representation="bases", iterations=10, lpips=0.1, lpips_from=0.5)
    costs = schedule.step_costs(bases, [1000, 4000])
    assert len(costs) == 10 and len({*costs[:5]}) == len({*costs[5:]}) == 1 and costs[5] > costs[4]
    triplane = dataclasses.replace(
        bases, representation="triplane", lpips=0.0, subdivide_from=0.5, pose_heads_from=0.2
    )
    first, _, middle, *_, last = schedule.step_costs(triplane, [1000, 4000])
    assert first < middle < last
