"""Compositing by hand."""

import numpy as np
import pytest
import torch

from pipeline.clip.composite import composite, composite_frame, cut_out, over
from pipeline.metrics.regions import person


def test_over_by_hand():
    color, alpha = torch.full((1, 1, 3), 0.3), torch.tensor([[0.5]])
    result = over(color, alpha, torch.tensor([1.0, 0.0, 0.4]))
    torch.testing.assert_close(result.flatten(), torch.tensor([0.8, 0.3, 0.5]))


def test_composite_is_the_frame_times_alpha_on_black():
    frame = np.full((2, 2, 3), 255, np.uint8)
    mask = np.array([[0, 255], [51, 102]], np.uint8)
    expected = torch.tensor([[0.0, 1.0], [0.2, 0.4]])
    assert torch.allclose(composite_frame(frame, mask), expected[..., None].expand(2, 2, 3))


def test_composite_on_white_by_hand():
    frame = np.array([[[255, 0, 51]] * 3], np.uint8)
    mask = np.array([[0, 255, 51]], np.uint8)
    expected = [[1.0, 1.0, 1.0], [1.0, 0.0, 0.2], [0.2 + 0.8, 0.8, 0.04 + 0.8]]
    assert torch.allclose(composite_frame(frame, mask, "white")[0], torch.tensor(expected))
    assert torch.equal(composite_frame(frame, mask), composite_frame(frame, mask, "black"))
    with pytest.raises(KeyError):
        composite_frame(frame, mask, "grey")


def test_premultiplied_colour_over_a_background():
    color, alpha = torch.full((1, 2, 3), 0.3), torch.tensor([[0.5, 1.0]])
    assert torch.equal(over(color, alpha), color)
    assert torch.allclose(over(color, alpha, "white")[0, :, 0], torch.tensor([0.8, 0.3]))


@pytest.mark.parametrize("background", ["black", "white"])
def test_the_truths_mask_forgives_what_is_outside_and_leaves_the_rest(background):
    mask = np.zeros((4, 5), np.uint8)
    mask[1:3, 1:4], mask[1, 1] = 255, 51
    color = torch.rand(4, 5, 3, generator=torch.Generator().manual_seed(0))
    alpha = torch.ones(4, 5)
    alpha[1, 2], alpha[1, 1], alpha[3, 3] = 0.5, 0.1, 0.0
    both = [over(color * alpha[..., None], alpha, name) for name in ("black", "white")]
    value = {"black": 0.0, "white": 1.0}[background]
    cut, own = cut_out(*both, mask, background), both[background == "white"]
    assert torch.allclose(cut[0], torch.full((5, 3), value), atol=1e-6)
    for place in ((2, 2), (1, 2), (1, 1)):  # within the mask, half-transparent ones too
        assert torch.allclose(cut[place], own[place], atol=1e-6)
    alpha[1, 1] = 1.0  # of which the mask holds a fifth
    both = [over(color * alpha[..., None], alpha, name) for name in ("black", "white")]
    edge = cut_out(*both, mask, background)[1, 1]
    assert torch.allclose(edge, 0.2 * color[1, 1] + 0.8 * value, atol=1e-6)


def test_the_truth_is_not_changed_by_its_own_mask():
    mask = np.array([[0, 60, 200, 255]], np.uint8)
    frame = np.full((1, 4, 3), 180, np.uint8)
    black, white = (composite_frame(frame, mask, name) for name in ("black", "white"))
    assert torch.allclose(cut_out(black, white, mask, "white"), white, atol=1e-6)
    assert int(person(mask).sum()) == 2


def test_straight_and_premultiplied_colour_give_one_picture():
    color, alpha = torch.rand(4, 5, 3, generator=torch.Generator().manual_seed(0)), torch.full((4, 5), 0.25)
    expected = 0.25 * color + 0.75 * torch.tensor([0.1, 0.2, 0.3])
    torch.testing.assert_close(composite(color, alpha, torch.tensor([0.1, 0.2, 0.3])), expected)
    torch.testing.assert_close(over(0.25 * color, alpha, torch.tensor([0.1, 0.2, 0.3])), expected)
    grey = composite(255 * color.numpy(), alpha.numpy(), 208.0)
    np.testing.assert_allclose(grey, 0.25 * 255 * color.numpy() + 0.75 * 208, rtol=1e-6)
