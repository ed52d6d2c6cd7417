"""What completion would spoil of the filmed pictures keeps its size, the rest is made whole."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from pipeline.avatar.representation import Decoded
from pipeline.avatar.spared import THIN, errors, made_thin, spoilt, with_sizes_spared
from pipeline.clip.camera import facing_camera
from pipeline.clip.views import View
from pipeline.splat import Gaussians, render

SIZE, SIDE = 48, 12
CAMERA = facing_camera(SIZE, SIZE, 60.0)
LINE = torch.linspace(-0.2, 0.2, SIDE)


def sheets() -> Gaussians:
    """A square of Gaussians before the camera, red, and the same, green, behind its middle and its border."""
    x, y = (one.flatten() for one in torch.meshgrid(LINE, LINE, indexing="xy"))
    points = torch.stack([x, y, torch.full_like(x, -1.0)], 1)
    behind = points * torch.tensor([1.3, 1.3, 1.2])  # a little farther out in the picture, too
    red, green = torch.tensor([0.8, 0.1, 0.1]), torch.tensor([0.1, 0.8, 0.1])
    count = 2 * len(points)
    return Gaussians(
        means=torch.cat([points, behind]),
        quaternions=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        scales=torch.full((count, 3), 0.75 * 0.4 / (SIDE - 1)),
        colors=torch.cat([red.expand(len(points), 3), green.expand(len(points), 3)]),
        opacities=torch.full((count,), 0.999),
    )


def decoded(log_scale: torch.Tensor) -> Decoded:
    """Sizes alone: all that is asked of it here."""
    names = [one.name for one in dataclasses.fields(Decoded)]
    return Decoded(**{name: log_scale if name == "log_scale" else None for name in names})


@pytest.fixture
def shown():
    whole = sheets()

    def posed(one: Decoded) -> Gaussians:
        return dataclasses.replace(whole, scales=whole.scales * one.log_scale.exp())

    seen = render(posed(decoded(trained_sizes())), CAMERA)
    view = View(seen.color / seen.alpha.clamp_min(1e-6)[..., None], seen.alpha, CAMERA)
    return lambda one: [(posed(one), view)] * 2


def trained_sizes() -> torch.Tensor:
    """The red ones whole, the green ones shrunk until they vanish."""
    count = SIDE * SIDE
    return torch.cat([torch.zeros(count, 3), torch.full((count, 3), -3.0)])


def at_the_border() -> torch.Tensor:
    x, y = (one.flatten() for one in torch.meshgrid(LINE, LINE, indexing="xy"))
    return torch.maximum(x.abs(), y.abs()) > 0.19


def test_what_looks_out_from_behind_keeps_its_size_and_what_is_hidden_grows(shown):
    trained, completed = decoded(trained_sizes()), decoded(torch.zeros(2 * SIDE * SIDE, 3))
    found = with_sizes_spared(trained, completed, shown).log_scale
    behind, border = found[SIDE * SIDE :, 0], at_the_border()
    assert behind[border].max() < -2.5
    inner = (LINE.abs() < 0.12)[:, None] & (LINE.abs() < 0.12)
    assert behind[inner.flatten()].min() > -0.01
    assert (found[: SIDE * SIDE] == 0).all()


def test_the_pictures_are_hardly_changed(shown):
    trained, completed = decoded(trained_sizes()), decoded(torch.zeros(2 * SIDE * SIDE, 3))
    before, after, spared = (
        errors(*shown(one)[0]).mean()
        for one in (trained, completed, with_sizes_spared(trained, completed, shown))
    )
    assert after > before + 2e-3 and spared < before + 0.1 * (after - before)


def test_what_spoils_nothing_stays_to_the_bit(shown):
    trained = decoded(trained_sizes())
    assert torch.equal(with_sizes_spared(trained, trained, shown).log_scale, trained.log_scale)


def test_what_is_in_no_picture_spoils_nothing(shown):
    gaussians, view = shown(decoded(torch.zeros(2 * SIDE * SIDE, 3)))[0]
    away = dataclasses.replace(gaussians, means=gaussians.means + torch.tensor([0.0, 0, 5]))
    found = spoilt([torch.zeros(SIZE, SIZE)], [away], [view])
    assert torch.equal(found, torch.zeros(len(away)))


def test_what_frames_saw_squarely_is_made_thin_and_a_rim_that_they_saw_is_not(shown):
    """Two more Gaussians that frames see from their edge: thickness is what fills their pixels."""
    whole = decoded(torch.zeros(2 * SIDE * SIDE, 3))
    gaussians, view = shown(whole)[0]
    turned = torch.tensor([0.5**0.5, 0, 0.5**0.5, 0])  # the normal along x, across the view
    edge_on = torch.cat([gaussians.quaternions[:-2], turned.expand(2, 4)])
    places = torch.cat([gaussians.means[:-2], torch.tensor([[-0.35, 0.0, -1], [0.35, 0.0, -1]])])
    gaussians = dataclasses.replace(gaussians, quaternions=edge_on, means=places)

    def posed(one: Decoded) -> list[tuple[Gaussians, View]]:
        sized = dataclasses.replace(gaussians, scales=gaussians.scales * one.log_scale.exp())
        seen = render(gaussians, CAMERA)
        return [(sized, View(seen.color / seen.alpha.clamp_min(1e-6)[..., None], seen.alpha, view.camera))]

    found = made_thin(whole, posed).log_scale
    middle = ((LINE.abs() < 0.1)[:, None] & (LINE.abs() < 0.1)).flatten()
    assert (found[: SIDE * SIDE, 2][middle] < THIN + 0.01).all() and (found[-2:, 2] > -0.05).all()
    assert (found[:, :2] == 0).all()
