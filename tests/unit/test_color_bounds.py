"""Bounds of colours: what is outside comes to the nearest within, what is within stays to the bit."""

from __future__ import annotations

import pytest
import torch

from pipeline.avatar.color_bounds import ANYWHERE, BRIGHTEST, DARKEST, ColorBounds


def bounds(field, around: float, hair: bool, count: int = 1) -> ColorBounds:
    return ColorBounds(
        torch.tensor([field]).expand(count, 3), torch.full((count,), around), torch.full((count,), hair)
    )


@pytest.mark.parametrize("hair", [False, True])
def test_what_is_within_stays_to_the_bit(hair):
    near = torch.tensor([0.5, 0.4, 0.3]) + 0.05 * (torch.rand(100, 3) - 0.5)
    assert torch.equal(bounds([0.5, 0.4, 0.3], 0.1, hair, 100).held(near), near)


@pytest.mark.parametrize("hair", [False, True])
def test_without_bounds_any_color_stays(hair):
    colors = torch.rand(100, 3)
    assert torch.equal(bounds([0.5, 0.4, 0.3], ANYWHERE, hair, 100).held(colors), colors)


def test_skin_is_held_in_a_box():
    held = bounds([0.5, 0.4, 0.3], 0.1, hair=False).held(torch.tensor([[0.9, 0.42, 0.0]]))
    torch.testing.assert_close(held, torch.tensor([[0.6, 0.42, 0.2]]))


def test_hair_keeps_a_bright_rim_and_loses_a_tint_and_what_is_darker():
    grey, pink, black = (torch.tensor([one]) for one in ([0.8, 0.8, 0.8], [0.9, 0.3, 0.3], [0.0, 0.0, 0.0]))
    held = bounds([0.3, 0.3, 0.3], 0.1, hair=True).held
    assert torch.equal(held(grey), grey)
    found = held(pink)
    assert (found - found.mean()).norm() == pytest.approx(0.1, abs=1e-6)
    assert found.mean() == pytest.approx(0.5, abs=1e-6)  # as bright as it was
    torch.testing.assert_close(held(black), torch.full((1, 3), 0.2))


@pytest.mark.parametrize("hair", [False, True])
def test_held_twice_is_held_once_and_a_sigmoid_can_have_it(hair):
    one, colors = bounds([0.1, 0.9, 0.5], 0.05, hair, 1000), torch.rand(1000, 3)
    held = one.held(colors)
    moved = (held != colors).any(1)
    assert held[moved].min() >= DARKEST and held[moved].max() <= BRIGHTEST
    cut = ((held == DARKEST) | (held == BRIGHTEST)).any(1)
    assert not bool(cut.all())
    torch.testing.assert_close(one.held(held)[~cut], held[~cut], atol=1e-6, rtol=0)
