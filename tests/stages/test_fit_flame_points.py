"""FLAME fitted to 2D face points: a made-up head of FLAME's layout, whose truth is known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import roma
import torch

from pipeline.clip.camera import facing_camera
from pipeline.numba_kernels import threads
from stages.fit.camera_batch import stack
from stages.fit.face import fit_face
from stages.fit.face.deca import FlameParameters
from stages.fit.face.flame_fit import fit_flame, flame_points, landmark_loss, unknown_parameters
from stages.fit.face.flame_model import load_flame
from stages.fit.face.target import face_model
from stages.fit.observations import observe
from stages.fit.settings import FitSettings
from tests.made.detections import make_clip, whole_body
from tests.made.faces import flame_arrays, write_deca

COUNT, SIZE, FOCAL = 4, 256, 500.0
SHAPES, EXPRESSIONS = 2, 6


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """As within ``fit_face``."""
    with threads(1), torch.no_grad():
        yield


@pytest.fixture(scope="module")
def flame_file(model, tmp_path_factory):
    path = tmp_path_factory.mktemp("flame") / "flame.npz"
    np.savez(path, **flame_arrays(model[0]))
    return path


def points_of(model, flame_file, name: str):
    body, landmarks = model
    chosen = landmarks.face_mesh if name == "mesh" else landmarks.whole_body[23:91]
    return flame_points(face_model(body, chosen), body, load_flame(flame_file))


@pytest.fixture(scope="module")
def points(model, flame_file):
    """The 68 points, fewer than the mesh's 478."""
    return points_of(model, flame_file, "points68")


@pytest.fixture(scope="module")
def views():
    return stack([facing_camera(SIZE, SIZE, FOCAL)] * COUNT)


@pytest.fixture(scope="module")
def truth():
    phase = torch.linspace(0, 3, COUNT)
    expression = torch.zeros(COUNT, EXPRESSIONS)
    expression[:, 0], expression[:, 2] = 1.2 * torch.sin(phase), 0.8 * torch.cos(phase)
    jaw = torch.zeros(COUNT, 3)
    jaw[:, 0] = 0.25 * torch.sin(phase).abs()
    return FlameParameters(torch.zeros(SHAPES), expression, jaw, torch.ones(COUNT, dtype=torch.bool))


def fitted(*arguments, steps: int = 150, **settings):
    return fit_flame(*arguments, steps=steps, **settings)


def seen_by(points, truth, views, yaw: float = 0.3) -> torch.Tensor:
    """The landmarks [T, F, 2] of heads that look about, pixels; NaN for landmarks that FLAME lacks."""
    turn = torch.zeros(COUNT, 3)
    turn[:, 1] = torch.linspace(-yaw, yaw, COUNT)
    heads = roma.rotvec_to_rotmat(turn) @ torch.diag(torch.tensor([1.0, -1.0, -1.0]))  # before the camera
    posed = points.posed(truth.shape, truth.expression, truth.jaw)
    middle = points.template.mean(0)
    there = (posed - middle) @ heads.mT + torch.tensor([0.02, -0.01, 0.6])
    pixels = torch.full((COUNT, len(points.kept), 2), torch.nan)
    pixels[:, points.kept] = views.to_pixels(there)
    return pixels


def wrong(truth: FlameParameters) -> FlameParameters:
    """A start with other expressions and a shut mouth."""
    draw = torch.Generator().manual_seed(1)
    expression = truth.expression + 0.8 * torch.randn(truth.expression.shape, generator=draw)
    return dataclasses.replace(truth, expression=expression, jaw=torch.zeros_like(truth.jaw))


def everything(pixels: torch.Tensor) -> torch.Tensor:
    return torch.ones(pixels.shape[:2], dtype=torch.bool)


@pytest.mark.parametrize("name", ["mesh", "points68"])
def test_from_a_wrong_start_the_landmarks_are_found(model, flame_file, views, truth, name):
    points = points_of(model, flame_file, name)
    pixels, start = seen_by(points, truth, views), wrong(truth)
    fit = fitted(points, start, pixels, everything(pixels), views, weight=0.01)
    assert (fit.error < 0.35 * fit.start_error).all() and fit.error.max() < 0.5
    found = fit.parameters
    assert found.valid.all()
    assert (found.jaw[:, 0] - truth.jaw[:, 0]).abs().mean() < 0.5 * (start.jaw - truth.jaw)[:, 0].abs().mean()
    before = (start.expression - truth.expression).abs().mean()
    assert (found.expression - truth.expression).abs().mean() < 0.8 * before


def test_the_start_holds_what_the_points_do_not_say(points, views, truth):
    pixels = seen_by(points, truth, views)
    kept = fitted(points, truth, pixels, everything(pixels), views)
    assert kept.error.max() < 0.1
    assert (kept.parameters.expression - truth.expression).abs().max() < 0.05
    assert (kept.parameters.shape - truth.shape).abs().max() < 0.05
    start = wrong(truth)
    near, far = (
        fitted(points, start, pixels, everything(pixels), views, weight=weight, steps=60)
        for weight in (10.0, 0.01)
    )
    moved = [(fit.parameters.expression - start.expression).abs().mean() for fit in (near, far)]
    assert moved[0] < 0.2 * moved[1]


def test_points_that_are_not_numbers_and_outliers(points, views, truth):
    pixels = seen_by(points, truth, views)
    known = torch.nonzero(points.kept)[:, 0]
    pixels[0, known[::5]] = torch.nan
    pixels[1, known[::7]] = torch.inf
    pixels[2, known[::9]] += 25.0  # L1: they pull, and do not win
    fit = fitted(points, wrong(truth), pixels, everything(pixels), views, weight=0.01)
    for value in (fit.parameters.expression, fit.parameters.jaw, fit.parameters.shape, fit.error):
        assert torch.isfinite(value).all()
    assert (fit.error[[0, 1, 3]] < 0.35 * fit.start_error[[0, 1, 3]]).all()


def test_without_decas_start(points, views, truth):
    pixels = seen_by(points, truth, views)
    fit = fitted(
        points, unknown_parameters(COUNT, SHAPES, EXPRESSIONS), pixels, everything(pixels), views, 0.01
    )
    assert fit.parameters.valid.all() and (fit.error < 0.35 * fit.start_error).all()
    some = dataclasses.replace(wrong(truth), valid=torch.tensor([True, False, True, False]))
    some.expression[1] = torch.nan  # what is not valid is not looked at
    fit = fitted(points, some, pixels, everything(pixels), views, 0.01)
    assert fit.parameters.valid.all() and torch.isfinite(fit.parameters.expression).all()


def test_a_face_turned_away_keeps_what_deca_says(points, views, truth):
    pixels, start = seen_by(points, truth, views), wrong(truth)
    start = dataclasses.replace(start, valid=torch.tensor([True, True, True, False]))
    mask = everything(pixels)
    mask[0] = False  # masked in all its points: DECA's numbers stay
    mask[3] = False  # and where there are none, the frame stays unknown
    pixels[3] = torch.nan
    fit = fitted(points, start, pixels, mask, views, 0.01)
    assert torch.equal(fit.parameters.expression[0], start.expression[0])
    assert fit.parameters.valid.tolist() == [True, True, True, False]
    assert torch.isnan(fit.error).tolist() == [True, False, False, True]
    nothing = fitted(points, start, pixels, torch.zeros_like(mask), views)
    assert nothing.parameters is start and torch.isnan(nothing.error).all()


def test_a_face_in_profile_is_fitted_by_the_half_that_is_seen(points, views, truth):
    pixels = seen_by(points, truth, views, yaw=1.2)
    mask = everything(pixels)
    side = points.template[:, 0] - points.template[:, 0].mean()
    known = torch.nonzero(points.kept)[:, 0]
    mask[0, known[side < -0.02]] = False
    mask[-1, known[side > 0.02]] = False
    fit = fitted(points, wrong(truth), pixels, mask, views, 0.01)
    assert (fit.error < 0.4 * fit.start_error).all()


def test_points_that_say_nothing_of_a_head_do_no_harm(points, views, truth):
    pixels = seen_by(points, truth, views)
    pixels[0] = 100.0  # all in one place
    pixels[1] = pixels[1].flip(0) * 0 + torch.arange(len(points.kept))[:, None] * 1.0  # on one line
    fit = fitted(points, wrong(truth), pixels, everything(pixels), views, steps=20)
    for value in (fit.parameters.expression, fit.parameters.jaw, fit.parameters.shape, fit.error):
        assert torch.isfinite(value).all()


def test_the_same_gives_the_same(points, views, truth):
    pixels = seen_by(points, truth, views)
    first, again = (fitted(points, wrong(truth), pixels, everything(pixels), views, steps=20) for _ in "ab")
    assert torch.equal(first.parameters.expression, again.parameters.expression)


def test_the_loss_is_l1_in_parts_of_the_face():
    projected = torch.tensor([[[1.0, 2.0], [3.0, 4.0], [9.0, 9.0]]])
    pixels = torch.zeros(1, 3, 2)
    mask = torch.tensor([[1.0, 1.0, 0.0]])
    found = landmark_loss(projected, pixels, mask, torch.tensor([2.0]))
    assert found.tolist() == [(3 + 7) / 2 / 2]
    assert landmark_loss(projected, pixels, 0 * mask, torch.tensor([2.0])).tolist() == [0.0]


@pytest.mark.parametrize("source, deca", [("mesh", True), ("points68", False)])
def test_the_face_first_is_flame_after_its_fit(model, flame_file, tmp_path, source, deca):
    clip = make_clip(*model, count=2, face=True)
    clip = clip if source == "mesh" else whole_body(clip, *model)
    keypoints = clip.keypoints
    start = str(write_deca(tmp_path / "flame_init", dict.fromkeys(clip.poses.frames, True))) if deca else ""
    settings = FitSettings(face="flame", face_init=start, flame_model=str(flame_file), flame_fit=True)
    views = stack([clip.cameras[frame] for frame in clip.poses.frames])
    observed = observe(keypoints, model[1], 0.4, np.full((2, 2), 256.0))
    said: list[str] = []
    target = fit_face(*model, keypoints, observed, views, settings, said.append)
    assert target.valid.all() and target.source == "flame"
    assert any("2 of 2 frames" in line and "FLAME" in line for line in said)
    with pytest.raises(ValueError, match="flame_fit"):
        FitSettings(face="flame", flame_model=str(flame_file))
