"""The second-order solver: its derivatives, its linear algebra, and what it makes of known clips."""

import dataclasses
import math

import pytest
import roma
import torch

from pipeline.body import joint_index
from pipeline.guard import NotFiniteError
from stages.fit.face_offset import on_skin, spread_matrix
from stages.fit.initialise import initial_parameters
from stages.fit.objective import Objective
from stages.fit.observations import observe
from stages.fit.parameters import PER_FRAME, landmark_model, movable_joints, parameters_of
from stages.fit.registration import frozen_groups, views_of
from stages.fit.settings import FitSettings
from stages.fit.solver import STEPS, solve
from stages.fit.solver.banded import factorise
from stages.fit.solver.coarse import softened, thinned
from stages.fit.solver.levenberg import Levenberg, Unknowns
from stages.fit.solver.normal import coupling_of, groups_of, normal_equations
from stages.fit.solver.slopes import Layout, Slopes, group_of, joint_slopes, pose
from stages.fit.solver.state import Step, between, gradient_step, moved
from tests.stages.fit_clip import load, make_clip

BETAS = 4


@pytest.fixture(scope="module")
def model():
    return load()


def problem_of(model, clip, settings=None):
    """Objective, initial parameters and frozen groups, as the registration makes them."""
    settings = settings or FitSettings(face="off", betas=BETAS)
    body, landmarks = model
    views = views_of(clip.keypoints, clip.cameras)
    seen = observe(clip.keypoints, landmarks, settings.score_threshold, views.size.numpy())
    on_face = seen.of("face") & on_skin(body, seen.points)
    spread = spread_matrix(body, seen.points[on_face])
    found = landmark_model(body, seen.points, settings.betas, spread)
    initial = initial_parameters(clip.keypoints, seen, found, views)
    movable = movable_joints(found, seen.mask.any(0), seen.vague)
    objective = Objective(body, seen, found, views, initial, movable, settings)
    frozen = frozen_groups(settings, face_is_seen=bool((seen.mask.any(0) & on_face).any()))
    return objective, initial, frozen


@pytest.fixture(scope="module")
def clip(model):
    return make_clip(*model)


@pytest.fixture(scope="module")
def masked(clip):
    """The right arm is never seen, and in one frame nothing is."""
    pose_image = clip.keypoints.pose_image.copy()
    pose_image[:, [14, 16, 18, 20, 22], 3] = 0.1
    pose_image[3, :, 3] = 0.1
    world = clip.keypoints.pose_world.copy()
    world[..., 3] = pose_image[..., 3]
    keypoints = dataclasses.replace(clip.keypoints, pose_image=pose_image, pose_world=world)
    return dataclasses.replace(clip, keypoints=keypoints)


@pytest.fixture(scope="module")
def fitted(model, masked):
    objective, initial, frozen = problem_of(model, masked)
    return objective, initial, solve(objective, initial, frozen)


def double(thing):
    """A dataclass with its floats in float64."""
    values = {f.name: getattr(thing, f.name) for f in dataclasses.fields(thing)}
    changed = {
        name: value.double()
        for name, value in values.items()
        if isinstance(value, torch.Tensor) and value.is_floating_point()
    }
    return dataclasses.replace(thing, **changed)


def random_parameters(model, frames, angle, seed=0):
    """Everything moved; every joint turned by ``angle`` about an axis of its own."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.randn(*shape, generator=generator)

    rotation = torch.nn.functional.normalize(draw(frames, 55, 3), dim=-1) * angle
    sizes = model.shape.shape[2], model.expression.shape[2], model.face.shape[1]
    parameters = parameters_of(rotation, draw(frames, 3), sizes)
    return dataclasses.replace(
        parameters, expression=draw(frames, sizes[1]), betas=draw(sizes[0]), joint_offset=0.01 * draw(55, 3),
        face_control=0.01 * draw(sizes[2], 3),
    )  # fmt: skip


@pytest.mark.parametrize("angle", [0.0, 0.7, math.pi - 1e-6, math.pi])
@pytest.mark.parametrize("face", [False, True])
def test_slopes_are_the_derivatives_of_the_landmarks(model, face, angle):
    body, landmarks = model
    points = landmarks.face_mesh[::60] if face else landmarks.pose[::3]
    found = double(landmark_model(body, points, BETAS, torch.zeros(len(body.v_template), 0)))
    parameters = double(random_parameters(found, 1, angle))
    layout = Layout(torch.arange(55), found.expression.shape[2] if face else 0, BETAS, offsets=True)
    slopes = Slopes(found, pose(found, parameters), group_of(found, torch.arange(len(points)), face), layout)
    pick = torch.zeros(2, len(points), dtype=torch.float64)
    pick[0, 1], pick[0, 2], pick[1, 3], pick[1, :2] = 1.0, -1.0, 1.0, -0.5
    generator = torch.Generator().manual_seed(1)
    for chosen in (None, pick):
        size = len(points) if chosen is None else len(pick)
        along = torch.randn(1, size, 2, 3, generator=generator, dtype=torch.float64)

        def seen(frame, shared, chosen=chosen, along=along):
            step = zero_step(parameters)
            step = dataclasses.replace(
                step, rotation=frame[: layout.turns].view(1, 55, 3), transl=frame[None, -3:],
                expression=step.expression + torch.nn.functional.pad(
                    frame[layout.turns : -3], (0, parameters.expression.shape[1] - layout.expressions)
                ),
                betas=shared[:BETAS], joint_offset=shared[BETAS:].view(55, 3),
            )  # fmt: skip
            after = moved(parameters, step, torch.ones(1, dtype=torch.float64))
            places = found.posed(after, after.matrices)[0]
            places = places if chosen is None else chosen @ places
            return (along @ places[..., None]).flatten()

        start = (torch.zeros(layout.frame).double(), torch.zeros(layout.shared).double())
        frame, shared = torch.autograd.functional.jacobian(seen, start)
        expected_frame, expected_shared = torch.zeros_like(frame), torch.zeros_like(shared)
        rows = slopes.rows(along, chosen)[0]
        expected_frame[:, slopes.frame] = rows[:, : len(slopes.frame)]
        expected_shared[:, slopes.shared] = rows[:, len(slopes.frame) :]
        torch.testing.assert_close(expected_frame, frame, atol=1e-6, rtol=1e-5)
        torch.testing.assert_close(expected_shared, shared, atol=1e-6, rtol=1e-5)


def zero_step(parameters):
    new = torch.zeros_like
    return Step(
        parameters.transl.new_zeros(len(parameters.transl), 55, 3), new(parameters.expression),
        new(parameters.transl), new(parameters.betas), new(parameters.joint_offset),
        new(parameters.face_control),
    )  # fmt: skip


def test_joint_slopes_are_the_derivatives_of_the_joints(model):
    body, landmarks = model
    found = double(landmark_model(body, landmarks.pose[:2], BETAS, torch.zeros(len(body.v_template), 0)))
    parameters = double(random_parameters(found, 1, 0.7))
    layout = Layout(torch.tensor([0, 3, 18]), 0, BETAS, offsets=False)

    def joints(turn):
        step = zero_step(parameters)
        rotation = step.rotation.index_copy(1, layout.joints, turn.view(1, -1, 3))
        after = moved(parameters, dataclasses.replace(step, rotation=rotation), torch.ones(1).double())
        return found.posed(after, after.matrices)[1].flatten()

    expected = torch.autograd.functional.jacobian(joints, torch.zeros(9, dtype=torch.float64))
    expected = expected[expected.view(55, 3, -1).abs().amax((1, 2)).gt(1e-9).repeat_interleave(3)]
    torch.testing.assert_close(
        joint_slopes(found, pose(found, parameters), layout)[0], expected, atol=1e-6, rtol=1e-5
    )


def test_gradient_of_a_step_is_that_of_its_rotations(model):
    found = double(
        landmark_model(model[0], model[1].pose[:2], BETAS, torch.zeros(len(model[0].v_template), 0))
    )
    parameters = double(random_parameters(found, 2, math.pi - 0.1)).orthonormal()
    weight = torch.randn(2, 55, 3, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    leaves = parameters.leaves()
    (leaves.matrices * weight).sum().backward()
    zeros = {name: torch.zeros_like(leaf) for name, leaf in leaves.named().items()}
    grads = {name: leaf.grad for name, leaf in leaves.named().items() if leaf.grad is not None}
    found_step = gradient_step(parameters, dataclasses.replace(parameters, **{**zeros, **grads}))
    turn = torch.zeros(2, 55, 3, dtype=torch.float64, requires_grad=True)
    ((parameters.matrices @ roma.rotvec_to_rotmat(turn)) * weight).sum().backward()
    torch.testing.assert_close(found_step.rotation, turn.grad, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("frames", [1, 2, 5])
def test_bands_are_solved_as_the_dense_matrix_is(frames):
    size, generator = 4, torch.Generator().manual_seed(0)
    root = torch.randn(frames, frames, size, 2 * size, generator=generator)
    near = (torch.arange(frames)[:, None] - torch.arange(frames)).abs() <= 1
    rows = (root * near[..., None, None]).permute(0, 2, 1, 3).reshape(frames * size, -1)
    dense = rows @ rows.mT + torch.eye(frames * size)
    blocks = dense.view(frames, size, frames, size)
    bands = torch.zeros(3, frames, size, size)
    for k in range(3):
        for t in range(frames - k):
            bands[k, t] = blocks[t, :, t + k]
    damping = torch.linspace(0.01, 0.1, frames)
    right = torch.randn(frames, size, 2, generator=generator)
    factor = factorise(bands, damping)
    damped = dense + torch.diag(dense.diagonal() * damping.repeat_interleave(size))
    expected = torch.linalg.solve(damped, right.flatten(0, 1)).view_as(right)
    torch.testing.assert_close(factor.solve(right), expected, atol=1e-4, rtol=1e-4)


def test_singular_systems_are_damped_and_indefinite_ones_refused():
    bands = torch.zeros(3, 2, 3, 3)
    bands[0, :, 0, 0] = 4.0
    solved = factorise(bands, torch.full((2,), 0.5)).solve(
        torch.tensor([[[6.0], [0.0], [0.0]]]).expand(2, 3, 1)
    )
    torch.testing.assert_close(solved[..., 0], torch.tensor([[1.0, 0.0, 0.0]]).expand(2, 3))
    bands[0, :, :2, :2] = torch.tensor([[1.0, 2.0], [2.0, 1.0]])
    assert factorise(bands, torch.zeros(2)) is None


@pytest.mark.parametrize("steady", [False, True])
def test_bands_are_the_curvature_of_smoothness(model, steady):
    """From rest the smoothness of a small motion is half its square in the second derivatives.

    A steady motion has velocities alone, which accelerations would drown.
    """
    clip = make_clip(*model, count=5)
    frames = (3, 4, 7, 8, 12)
    clip = dataclasses.replace(
        clip,
        keypoints=dataclasses.replace(clip.keypoints, frames=torch.tensor(frames).numpy()),
        cameras=dict.fromkeys(frames, clip.cameras[3]),
    )
    settings = FitSettings(face="off", betas=BETAS, lambda_init=0.0)
    objective, initial, _ = problem_of(model, clip, settings)
    objective.weight = 0 * objective.weight
    for bones, _, _ in objective.bones:
        bones.weight.zero_()
    resting = {name: getattr(initial, name)[:1].expand_as(getattr(initial, name)) for name in PER_FRAME}
    # Hands are far from the chest here: only smoothness is left.
    start = dataclasses.replace(initial, **resting)
    layout = Layout(torch.nonzero(objective.movable.flatten())[:, 0], 3, BETAS, offsets=False)
    normal = normal_equations(
        objective, groups_of(objective), coupling_of(objective.times), start, layout, True, slice(0, 5)
    )
    generator = torch.Generator().manual_seed(0)
    change = 1e-3 * torch.randn(5, layout.frame, generator=generator)
    if steady:
        change = change[:1] * objective.times[:, None]
    square = sum(
        (1 if k == 0 else 2) * (change[: 5 - k, None] @ normal.bands[k, : 5 - k] @ change[k:, :, None]).sum()
        for k in range(3)
    )
    step = zero_step(start)
    step.rotation[:, layout.joints] = change[:, : layout.turns].unflatten(1, (-1, 3))
    step.expression[:, :3] = change[:, layout.turns : -3]
    step = dataclasses.replace(step, transl=change[:, -3:])
    smooth = objective(moved(start, step, torch.ones(5)), robust=True)["smooth"]
    assert float(smooth) > 0
    torch.testing.assert_close(5 * smooth, square / 2, atol=0, rtol=0.02)


def test_one_step_on_a_wide_parabola_goes_most_of_the_way(model, clip):
    objective, initial, _ = problem_of(model, clip)
    place = Unknowns(torch.zeros(0, dtype=torch.long), False, False, False, False)
    start = dataclasses.replace(initial, transl=initial.transl + torch.tensor([0.2, 0.1, -0.3]))
    wide = softened(objective, 100.0)
    run = Levenberg(objective, 256)
    before = float(sum(wide(start, False).values()))
    after, loss, better = run.step(start, wide, False, place)
    assert better
    best = after
    for _ in range(8):
        best, least, _ = run.step(best, wide, False, place)
    assert loss - least < 0.2 * (before - least)
    torch.testing.assert_close(after.matrices, start.matrices, atol=1e-6, rtol=0)


def test_thinned_objective_is_that_of_its_frames(model, clip):
    objective, initial, _ = problem_of(model, clip)
    rows = torch.tensor([0, 2, 5])
    few = dataclasses.replace(initial, **{name: getattr(initial, name)[rows] for name in PER_FRAME})
    keypoints = dataclasses.replace(
        clip.keypoints,
        **{f.name: getattr(clip.keypoints, f.name)[rows.numpy()] for f in dataclasses.fields(clip.keypoints)},
    )
    alone, _, _ = problem_of(model, dataclasses.replace(clip, keypoints=keypoints))
    thin = thinned(objective, rows)
    alone.start, alone.initial = thin.start, thin.initial
    for name, value in thin(few, True).items():
        torch.testing.assert_close(value, alone(few, True)[name], msg=name)


def test_frames_between_are_filled_in_along_geodesics(model, clip):
    _, initial, _ = problem_of(model, clip)
    turn = torch.zeros(2, 55, 3)
    turn[0, :, 0], turn[1, :, 0] = 3.0, -3.0  # 0.28 radians apart, through pi
    few = dataclasses.replace(initial, **{name: getattr(initial, name)[:2] for name in PER_FRAME})
    few = dataclasses.replace(
        few.with_matrices(roma.rotvec_to_rotmat(turn)), transl=torch.tensor([[0.0] * 3, [1.0] * 3])
    )
    filled = between(few, torch.tensor([0, 2]), torch.tensor([0.0, 1.0, 4.0]))
    torch.testing.assert_close(filled.transl[:, 0], torch.tensor([0.0, 0.25, 1.0]))
    torch.testing.assert_close(filled.matrices[[0, 2]], few.matrices, atol=1e-5, rtol=0)
    angle = roma.rotmat_geodesic_distance(filled.matrices[0], filled.matrices[1])
    torch.testing.assert_close(angle, torch.full((55,), (2 * math.pi - 6) / 4), atol=1e-4, rtol=0)


def test_known_pose_is_recovered(masked, fitted):
    objective, _, found = fitted
    error = objective.residuals(found)
    assert error[~error.isnan()].mean() < 1.0
    with torch.no_grad():
        joints = objective.predict(found, objective.whole).joints
    rows = [joint_index(name) for name in ("left_shoulder", "left_elbow", "head", "left_knee", "right_ankle")]
    away = (joints - masked.joints)[[0, 1, 2, 4, 5]][:, rows, :2].norm(dim=-1)
    assert away.mean() < 0.03 and away.max() < 0.10


def test_unseen_hands_and_arm_never_move_and_an_unseen_frame_follows_its_neighbours(fitted):
    objective, initial, found = fitted
    still = ~objective.movable.flatten()
    assert still[25:].all() and still[joint_index("right_elbow")]
    torch.testing.assert_close(found.matrices[:, still], initial.matrices[:, still], atol=1e-6, rtol=0)
    assert (found.expression == 0).all() and (found.face_control == 0).all()
    for value in found.named().values():
        assert torch.isfinite(value).all()
    with torch.no_grad():
        joints = objective.predict(found, objective.whole).joints
    assert (joints[3] - (joints[2] + joints[4]) / 2)[:22].norm(dim=-1).max() < 0.03


def test_clip_that_nothing_was_seen_in_stays_as_it_was(model, clip):
    blank = dataclasses.replace(
        clip.keypoints, pose_image=0 * clip.keypoints.pose_image, pose_world=0 * clip.keypoints.pose_world
    )
    objective, initial, frozen = problem_of(model, dataclasses.replace(clip, keypoints=blank))
    found = solve(objective, initial, frozen)
    for name, value in found.named().items():
        torch.testing.assert_close(value, getattr(initial, name), atol=1e-4, rtol=0, msg=name)


def test_equal_input_gives_equal_parameters_on_any_number_of_threads(model, clip):
    results, before = [], torch.get_num_threads()
    problem = problem_of(model, clip)  # made once: register makes it on one thread, as it does everything
    for threads in (1, 2):
        torch.set_num_threads(threads)
        try:
            results.append(solve(*problem))
        finally:
            torch.set_num_threads(before)
    for name, value in results[0].named().items():
        assert torch.equal(value, getattr(results[1], name)), name


def test_long_clip_in_small_pieces_and_thinned(model):
    """20 frames, so that every fourth is fitted first, in pieces of 7."""
    clip = make_clip(*model, count=20)
    objective, initial, frozen = problem_of(model, clip)
    steps = []

    def watch(step, loss, now):
        steps.append((step, loss, len(now().transl)))

    found = solve(objective, initial, frozen, minibatch=7, watch=watch)
    error = objective.residuals(found)
    assert error[~error.isnan()].mean() < 1.0
    assert [step for step, _, _ in steps] == list(range(1, len(steps) + 1)) and len(steps) <= STEPS
    assert {count for _, _, count in steps} == {20}


@pytest.mark.parametrize("count", [1, 2])
def test_shortest_clips_with_a_face(model, count):
    clip = make_clip(*model, count=count, face=True)
    objective, initial, frozen = problem_of(model, clip)
    found = solve(objective, initial, frozen)
    error = objective.residuals(found)
    assert error[~error.isnan()].mean() < 1.0
    assert (found.face_control != 0).any()


def test_body_seen_from_behind_turns_through_pi(model, clip):
    """Root rotations of the start lie on both sides of pi; matrices have no seam there."""
    objective, initial, frozen = problem_of(model, clip)
    away = torch.zeros(6, 55, 3)
    away[:, 0, 1] = torch.linspace(-0.05, 0.05, 6)
    flip = roma.rotvec_to_rotmat(torch.tensor([0.0, math.pi, 0.0])) @ roma.rotvec_to_rotmat(away)
    matrices = initial.matrices.clone()
    matrices[:, 0] = flip[:, 0] @ matrices[:, 0]
    found = solve(objective, initial.with_matrices(matrices), frozen)
    for value in found.named().values():
        assert torch.isfinite(value).all()
    assert roma.rotmat_geodesic_distance(found.matrices[1:, 0], found.matrices[:-1, 0]).max() < 0.5


def test_loss_that_is_not_finite_is_said(model, clip):
    objective, initial, frozen = problem_of(model, clip)
    with pytest.raises(NotFiniteError, match="not finite"):
        solve(objective, dataclasses.replace(initial, transl=initial.transl * math.nan), frozen)
