"""Masked registration of the body to a clip (Section 3.1), from detections to identity and poses."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping

import numpy as np
import roma
import torch
from torch import Tensor

from pipeline.body import BodyModel, Identity, Landmarks, Poses
from pipeline.camera import Camera
from pipeline.curves import Curve
from pipeline.errors import UserError
from pipeline.keypoints import Keypoints
from stages.fit.face import fit_face
from stages.fit.face_offset import on_skin, spread_matrix
from stages.fit.initialise import continuous, initial_parameters, with_face
from stages.fit.objective import Face, Objective
from stages.fit.observations import Observations, observe
from stages.fit.optimise import optimise
from stages.fit.parameters import landmark_model, movable_joints
from stages.fit.pose_files import InitialPoses, initial_from_files
from stages.fit.progress import Recorder
from stages.fit.settings import FitSettings
from stages.fit.solver import STEPS, solve
from stages.fit.views import Views, stack


@dataclasses.dataclass(frozen=True)
class Registration:
    """A fitted clip.

    Attributes:
        identity: beta, Delta J, Delta V_face.
        poses: theta, psi and translation of every frame, not smoothed; valid where a point was trusted.
        observations: what was fitted to.
        error: [T, N], reprojection error in pixels of the stored frames, NaN where masked.
        curve: loss and reprojection error over the steps.
        seconds: (step, seconds since the start) at the curve's points.
    """

    identity: Identity
    poses: Poses
    observations: Observations
    error: Tensor
    curve: Curve
    seconds: tuple[tuple[int, float], ...]


def register(
    body: BodyModel,
    landmarks: Landmarks,
    keypoints: Keypoints,
    cameras: Mapping[int, Camera],
    settings: FitSettings,
    report: Callable[[str], None] = lambda note: None,
    start: InitialPoses | None = None,
    log: Callable[[str], None] = lambda note: None,
) -> Registration:
    """Fit the body to a clip.

    Args:
        body: the body.
        landmarks: where keypoints lie on it.
        keypoints: detections of T frames.
        cameras: frame number -> camera.
        settings: the stage's.
        report: called after each step with a note on the loss.
        start: poses of the same frames to start from; None starts from the estimator's landmarks.
        log: told in a line each what else a user should know.

    Raises:
        UserError: a frame has no camera, or there are no frames.
    """
    views = views_of(keypoints, cameras)
    size = views.size.numpy()
    observations = observe(keypoints, landmarks, settings.score_threshold, size, settings.masked)
    target = fit_face(body, landmarks, keypoints, observations, views, settings, log)
    seen = observations.mask.any(0)
    on_face = observations.of("face") & on_skin(body, observations.points)
    spread = spread_matrix(body, observations.points[on_face])
    betas = min(settings.betas, body.shape_directions.shape[2])
    model = landmark_model(body, observations.points, betas, spread)
    if start is None:
        initial = initial_parameters(keypoints, observations, model, views)
    else:
        initial = initial_from_files(start, body, observations, model, views, log)
    movable = movable_joints(model, seen, observations.vague)
    face = None
    if target is not None:
        initial = with_face(initial, target, movable)
        face = Face(target, landmark_model(body, target.points, betas, spread))
    objective = Objective(body, observations, model, views, initial, movable, settings, face)
    frozen = frozen_groups(settings, face_is_seen=bool((seen & on_face).any()))
    recorder = Recorder(objective, steps_of(settings), report)
    recorder.begin(initial)
    if settings.solver == "lm" and settings.iterations > 0:
        fitted = solve(objective, initial, frozen, settings.minibatch, recorder)
    else:
        fitted = optimise(
            objective,
            initial,
            settings.iterations,
            frozen,
            settings.learning_rate,
            settings.minibatch,
            recorder,
        )
    with torch.no_grad():
        matrices = torch.where(movable[:, None, None], fitted.matrices, initial.matrices)
        rotation = continuous(roma.rotmat_to_rotvec(matrices))
        identity = Identity(fitted.betas, fitted.joint_offset, spread @ fitted.face_control)
    frames, measured = tuple(keypoints.frames.tolist()), observations.mask.any(1)
    poses = Poses(frames, rotation, fitted.expression, fitted.transl, measured)
    error = objective.residuals(fitted)
    return Registration(identity, poses, observations, error, recorder.curve, tuple(recorder.seconds))


def steps_of(settings: FitSettings) -> int:
    """How many steps a fit takes at most: Adam as many as are set, the second-order solver its own number."""
    return STEPS if settings.solver == "lm" and settings.iterations > 0 else settings.iterations


def frozen_groups(settings: FitSettings, face_is_seen: bool) -> frozenset[str]:
    """The groups of parameters that are not fitted: unseen, or switched off."""
    frozen = set()
    if not settings.joint_offsets:
        frozen.add("joint_offset")
    if not settings.face_offsets or not face_is_seen:
        frozen.add("face_control")
    if not face_is_seen:
        frozen.add("expression")
    return frozenset(frozen)


def views_of(keypoints: Keypoints, cameras: Mapping[int, Camera]) -> Views:
    """The cameras of the frames that have keypoints.

    Raises:
        UserError: there are no frames, or one has no camera.
    """
    remedy = "run the ingest stage again"
    if len(keypoints.frames) == 0:
        raise UserError(f"keypoints.parquet holds no frame: {remedy}")
    missing = np.setdiff1d(keypoints.frames, np.array(sorted(cameras), np.int64))
    if len(missing):
        raise UserError(f"cameras.parquet has no camera for frame {missing[0]}: {remedy}")
    return stack([cameras[frame] for frame in keypoints.frames.tolist()])
