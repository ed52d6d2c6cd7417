"""Long clips: the pieces that a clip is fitted in add up to the clip."""

import dataclasses

import pytest
import torch

from pipeline.body import joint_index
from stages.fit.adam import gradients
from stages.fit.objective import RegistrationObjective
from stages.fit.observations import observe
from stages.fit.parameters import landmark_model, movable_joints, parameters_of
from stages.fit.registration import register, views_of
from stages.fit.settings import FitSettings
from stages.fit.windows import windows
from tests.made.detections import QUICK, make_clip


def prepared(model, count, gap=1):
    """The objective of a clip in float64, and parameters that are not its minimum."""
    body, landmarks = model
    clip = make_clip(body, landmarks, count=count, gap=gap)
    views = views_of(clip.keypoints, clip.cameras)
    observed = observe(clip.keypoints, landmarks, 0.4, views.size.numpy())
    small = landmark_model(body, observed.points, 3, torch.zeros(len(body.v_template), 0))
    generator = torch.Generator().manual_seed(0)
    rotation = clip.poses.rotation + 0.05 * torch.randn(count, 55, 3, generator=generator)
    sizes = (3, small.expression.shape[2], 0)
    initial = parameters_of(rotation, clip.poses.transl, sizes)
    movable = movable_joints(small, observed.mask.any(0), observed.vague)
    objective = RegistrationObjective(body, observed, small, views, initial, movable, FitSettings())
    moved = parameters_of(rotation + 0.02, clip.poses.transl + 0.01, sizes)
    return objective, moved


@pytest.mark.parametrize(("count", "size"), [(1, 1), (2, 1), (7, 3), (8, 4), (9, 100)])
def test_every_frame_and_difference_is_counted_once(count, size):
    frames, first, second = [], [], []
    for window in windows(count, size):
        posed = list(range(count))[window.posed]
        frames += posed[window.own]
        first += posed[1:][window.differences]
        second += posed[1:-1][window.differences]
    assert frames == list(range(count))
    assert first == list(range(1, count))
    assert second == list(range(1, count - 1))


@pytest.mark.parametrize("robust", [False, True])
def test_losses_of_windows_add_up(model, robust):
    objective, moved = prepared(model, count=7, gap=2)
    whole = objective(moved, robust)
    parts = [objective(moved.rows(w.low, w.high), robust, w) for w in windows(7, 3)]
    for name, value in whole.items():
        torch.testing.assert_close(sum(part[name] for part in parts), value, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("width", [0.0, 2.0])
def test_gradients_of_windows_add_up(model, width):
    objective, moved = prepared(model, count=7, gap=2)
    found = []
    for size in (7, 3):
        steps = moved.zeros()
        gradients(objective, moved, steps, width, size, True, 0)
        found.append({name: leaf.grad for name, leaf in steps.named().items()})
    assert found[0]["body_pose"].abs().max() > 1
    for name, whole in found[0].items():
        scale = float(whole.abs().max()) if whole.numel() else 0.0
        torch.testing.assert_close(found[1][name], whole, rtol=0, atol=1e-4 * scale + 1e-7, msg=name)


def test_a_fit_in_windows_is_the_fit(model):
    clip = make_clip(*model, count=6)
    few = dataclasses.replace(QUICK, iterations=40)
    whole = register(*model, clip.keypoints, clip.cameras, few)
    parts = register(*model, clip.keypoints, clip.cameras, dataclasses.replace(few, minibatch=2))
    assert (whole.poses.transl - parts.poses.transl).abs().max() < 2e-3
    rows = [joint_index(name) for name in ("pelvis", "left_elbow", "head")]
    assert (whole.poses.rotation - parts.poses.rotation)[:, rows].abs().max() < 1e-2


def test_a_masked_frame_keeps_its_initial_pose_where_nothing_else_speaks(model):
    """Far from other frames and without smoothness only L_init is left, whose minimum it starts in.

    It may drift by what the ranges of joints still ask for. Beside seen frames it lies between them
    (test_fit.py).
    """
    clip = make_clip(*model, count=3, gap=100)
    clip.keypoints.pose_image[1, :, 3] = 0.1
    clip.keypoints.pose_world[1, :, 3] = 0.1
    settings = FitSettings(iterations=30, smoothness=0.0, smoothing_seconds=0.0)
    start = register(*model, clip.keypoints, clip.cameras, dataclasses.replace(settings, iterations=0))
    fitted = register(*model, clip.keypoints, clip.cameras, settings)
    moved = (fitted.poses.rotation - start.poses.rotation).norm(dim=-1).amax(1)
    assert moved[1] < 0.01 < moved[[0, 2]].min()


def test_no_iterations_publish_the_initialisation(model):
    clip = make_clip(*model, count=2)
    start = register(*model, clip.keypoints, clip.cameras, FitSettings(iterations=0))
    assert (start.identity.betas == 0).all() and (start.identity.joint_offset == 0).all()
    assert torch.isfinite(start.poses.rotation).all()
    seen = start.error[~start.error.isnan()]
    assert seen.mean() < 60
    assert {step for step, _, _ in start.curve.rows} == {0}
