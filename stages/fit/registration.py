"""Masked registration of the body to a clip (Section 3.1), from detections to identity and poses."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping

import numpy as np
import roma
import torch
from torch import Tensor

from pipeline.body import BodyModel, Identity, Landmarks, Poses
from pipeline.body.eyes import eyeball, shut_expressions, with_eyeballs
from pipeline.body.joints import LEFT_EYE, RIGHT_EYE
from pipeline.clip.camera import Camera
from pipeline.clip.clock import times_of_numbers, usual_step
from pipeline.clip.curves import Curve
from pipeline.clip.frame_files import ClipFrames
from pipeline.clip.keypoints import Keypoints
from pipeline.errors import UserError
from pipeline.numba_kernels import threads
from pipeline.pose_files import InitialPoses
from stages.fit.adam import Recorder, optimise
from stages.fit.camera_batch import CameraBatch, stack
from stages.fit.eyes import FittedEyes, fit_eyes
from stages.fit.face import FaceTarget, fit_face
from stages.fit.face_offset import on_skin, spread_matrix
from stages.fit.initialise import continuous, initial_parameters, with_face
from stages.fit.initialise_from_poses import initial_facing, initial_from_files
from stages.fit.objective import FaceTerm, RegistrationObjective
from stages.fit.observations import Observations, observe
from stages.fit.outlier_frames import mask_outlier_frames
from stages.fit.parameters import Parameters, landmark_model, movable_joints
from stages.fit.settings import FitSettings


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
        face_frames: in how many frames a face was fitted first, or an expression was given; 0 in none.
        eyes: lids and gaze, which the poses hold already; None where no eye was seen.
    """

    identity: Identity
    poses: Poses
    observations: Observations
    error: Tensor
    curve: Curve
    seconds: tuple[tuple[int, float], ...]
    face_frames: int = 0
    eyes: FittedEyes | None = None


@threads(1)  # sums of many threads differ in their last digits, also those before and after Adam
def register(
    body: BodyModel,
    landmarks: Landmarks,
    keypoints: Keypoints,
    cameras: Mapping[int, Camera],
    settings: FitSettings,
    report: Callable[[str], None] = lambda note: None,
    start: InitialPoses | None = None,
    log: Callable[[str], None] = lambda note: None,
    source: ClipFrames | None = None,
    times: np.ndarray | None = None,
) -> Registration:
    """Fit the body to a clip.

    Args:
        keypoints: detections of T frames.
        report: called after each step with a note on the loss.
        start: poses of the same frames to start from; None starts from the estimator's landmarks.
        log: told in a line each what else a user should know.
        source: all frames of the footage, which names of given files mean.
        times: [T], of the frames, see :mod:`pipeline.clip.clock`; by default their numbers.

    Raises:
        UserError: a frame has no camera, or there are no frames.
    """
    directions = body.expression_directions[..., : settings.expressions]
    body = dataclasses.replace(body, expression_directions=directions)
    views = views_of(keypoints, cameras)
    times = times_of_numbers(keypoints.frames) if times is None else times
    keypoints = _without_outlier_frames(keypoints, times, log) if settings.masked else keypoints
    size = views.size.numpy()
    facing = None if start is None else initial_facing(start, body, views)
    observations = observe(
        keypoints, landmarks, settings.score_threshold, size, settings.masked, facing, times
    )
    target = fit_face(body, landmarks, keypoints, observations, views, settings, log, source)
    seen = observations.mask.any(0)
    on_face = observations.of("face") & on_skin(body, observations.points)
    spread = spread_matrix(body, observations.points[on_face])
    betas = min(settings.betas, body.shape_directions.shape[2])
    model = landmark_model(body, observations.points, betas, spread)
    if start is None:
        initial = initial_parameters(keypoints, observations, model, views)
    else:
        initial = initial_from_files(
            start, body, observations, model, views, log, believe=settings.given == "keep"
        )
    movable = movable_joints(model, seen, observations.vague)
    face = None
    if target is not None:
        initial = with_face(initial, target, movable)
        face = FaceTerm(target, landmark_model(body, target.points, betas, spread))
    if settings.iterations:
        log(described_start(settings, body, betas, start))
    objective = RegistrationObjective(
        body, observations, model, views, initial, movable, settings, face, torch.from_numpy(paced(times))
    )
    frozen = frozen_groups(settings, face_is_seen=bool((seen & on_face).any()))
    recorder = Recorder(objective, settings.iterations, report)
    recorder.begin(initial)
    fitted = optimise(
        objective, initial, settings.iterations, frozen, settings.learning_rate, settings.minibatch, recorder
    )
    if settings.iterations:
        left = ", ".join(f"{name} {value:.3g}" for name, value in objective.values(fitted).items())
        log(f"objective in the end: {left}")
    identity, poses = _outcome(objective, fitted, spread)
    identity = with_eyeballs(body, identity) if bool(seen[on_face].any()) else identity
    eyes = _fit_eyes(body, landmarks, objective, fitted, identity)
    if eyes is not None:
        expression, rotation = eyes.applied(poses.expression, poses.rotation)
        poses = dataclasses.replace(poses, expression=expression, rotation=rotation)
    error = objective.residuals(fitted)
    seconds, registered = tuple(recorder.seconds), registered_faces(settings, target, start)
    return Registration(identity, poses, observations, error, recorder.curve, seconds, registered, eyes)


def _fit_eyes(
    body: BodyModel,
    landmarks: Landmarks,
    objective: RegistrationObjective,
    fitted: Parameters,
    identity: Identity,
) -> FittedEyes | None:
    """Lids and gaze of the fitted clip, where eyes were seen, with the eyeballs of its identity."""
    settings, observations = objective.settings, objective.observations
    shut = shut_expressions(body, landmarks.face_mesh, identity)
    shift = torch.zeros(len(observations.group), 3)
    for eye, joint in enumerate((LEFT_EYE, RIGHT_EYE)):
        of_eye = (observations.points.joint < 0) & eyeball(body, eye)[observations.points.vertices].any(1)
        shift[of_eye] = identity.joint_offset[joint]
    model = dataclasses.replace(objective.model, rest=objective.model.rest + shift)
    with torch.no_grad():
        fitted = dataclasses.replace(fitted, joint_offset=identity.joint_offset)
        matrices = torch.where(objective.movable, fitted.matrices, objective.start)
        weights = settings.lambda_lids, settings.lambda_gaze
        return fit_eyes(model, observations, objective.views, fitted, matrices, shut, weights)


def registered_faces(settings: FitSettings, target: FaceTarget | None, start: InitialPoses | None) -> int:
    """The number of frames whose face is registered: fitted first, or with the expression that was given."""
    if target is not None:
        return int(target.valid.sum())
    given = start is not None and start.expression is not None and settings.face != "off"
    return int(start.valid.sum()) if given and start is not None else 0


def described_start(settings: FitSettings, body: BodyModel, betas: int, start: InitialPoses | None) -> str:
    """The line of the log that says where poses start and how many coefficients are fitted."""
    where = "the poses that were given" if start is not None else "keypoints; fit.pose_init names given poses"
    count = body.expression_directions.shape[2]
    fewer = betas < settings.betas or count < settings.expressions
    return f"fits {betas} betas and {count} expressions{', all that the body has' * fewer}, from {where}"


def paced(times: np.ndarray) -> np.ndarray:
    """The times that the objective's priors see: [T] -> [T], 30ths of a second, or frames if shorter.

    In true time the prior on accelerations is 16 times as strong on a clip of 60 frames a second, whose quick
    movements it then flattens (balance: 1.80 px off in place of 1.23, a mannequin's hands 8 px).
    """
    return times / min(1.0, usual_step(times))


def _without_outlier_frames(keypoints: Keypoints, times: np.ndarray, log: Callable[[str], None]) -> Keypoints:
    """The detections with outlier frames masked, see ``outlier_frames.py``; the log names these frames."""
    keypoints, outliers = mask_outlier_frames(keypoints, times)
    if outliers:
        log(
            f"frame {', '.join(map(str, outliers))}: left and right are exchanged, or the points are nowhere "
            "near those of the frames around; body and hands are not believed there"
        )
    return keypoints


def _outcome(objective: RegistrationObjective, fitted: Parameters, spread: Tensor) -> tuple[Identity, Poses]:
    """Identity and poses; joints that nothing was seen of are where they began."""
    observations = objective.observations
    with torch.no_grad():
        matrices = torch.where(objective.movable, fitted.matrices, objective.start)
        rotation = continuous(roma.rotmat_to_rotvec(matrices))
        identity = Identity(fitted.betas, fitted.joint_offset, spread @ fitted.face_control)
    frames, measured = tuple(observations.frames.tolist()), observations.mask.any(1)
    return identity, Poses(frames, rotation, fitted.expression, fitted.transl, measured)


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


def views_of(keypoints: Keypoints, cameras: Mapping[int, Camera]) -> CameraBatch:
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
