"""A clip whose truth is known: the open body moving before a camera, its landmarks as detections."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch

from pipeline.body import (
    BodyModel,
    Landmarks,
    Poses,
    joint_index,
    locate,
    mean_identity,
    pose_body,
)
from pipeline.clip.camera import Camera, facing_camera, project
from pipeline.clip.keypoints import Keypoints, empty_keypoints
from stages.fit.face_offset import on_skin, spread_matrix
from stages.fit.initialise import initial_parameters
from stages.fit.objective import RegistrationObjective
from stages.fit.observations import observe
from stages.fit.parameters import Parameters, landmark_model, movable_joints
from stages.fit.registration import frozen_groups, views_of
from stages.fit.settings import FitSettings
from tests.made.body import open_body, open_landmarks

SIZE = 256
QUICK = FitSettings(iterations=100)


@dataclasses.dataclass(frozen=True)
class DetectedClip:
    """Detections, and the poses and joints [T, 55, 3] behind them."""

    keypoints: Keypoints
    cameras: dict[int, Camera]
    poses: Poses
    joints: torch.Tensor


def load() -> tuple[BodyModel, Landmarks]:
    """The open body and its landmarks."""
    return open_body(), open_landmarks()


def true_poses(frames: tuple[int, ...], distance: float = 3.0) -> Poses:
    """Somebody standing, turned a little, who lifts the left forearm while walking to the side."""
    count = len(frames)
    phase = torch.linspace(0, 1, count)
    rotation = torch.zeros(count, 55, 3)
    rotation[:, 0, 1] = 0.3 + 0.2 * phase
    rotation[:, joint_index("left_shoulder"), 2] = -1.0
    rotation[:, joint_index("right_shoulder"), 2] = 1.2
    rotation[:, joint_index("left_elbow"), 1] = -0.6 - 0.6 * phase
    rotation[:, joint_index("head"), 1] = 0.3 * phase
    rotation[:, joint_index("left_knee"), 0] = 0.4
    transl = torch.stack([0.1 * phase, 0.2 + 0 * phase, -distance + 0 * phase], dim=1)
    return Poses(frames, rotation, torch.zeros(count, 1), transl)


def make_clip(body, landmarks: Landmarks, count: int = 6, gap: int = 1, face: bool = False) -> DetectedClip:
    """The clip; the hands are never detected, the face only if asked for."""
    frames = tuple(range(3, 3 + gap * count, gap))
    camera = facing_camera(SIZE, SIZE, 1.2 * SIZE)
    return detected_poses(body, landmarks, true_poses(frames), dict.fromkeys(frames, camera), face)


def detected_poses(
    body, landmarks: Landmarks, poses: Poses, cameras: dict[int, Camera], face: bool = False
) -> DetectedClip:
    """The clip of some poses before one camera; what is detected is as in ``make_clip``."""
    frames, count, camera = poses.frames, len(poses), next(iter(cameras.values()))
    vertices, joints = pose_body(body, mean_identity(body), poses.rotation, poses.expression, poses.transl)

    def seen(points):  # -> [T, K, 4], pixels and score
        pixels = project(camera, locate(points, joints, vertices))
        return torch.cat(
            [pixels, torch.zeros_like(pixels[..., :1]), torch.ones_like(pixels[..., :1])], -1
        ).numpy()

    world = locate(landmarks.pose, joints, vertices)
    world = (world - world[:, 23:25].mean(1, keepdim=True)) * torch.tensor([1.0, -1.0, -1.0])
    blank = empty_keypoints(np.array(frames))
    keypoints = dataclasses.replace(
        blank,
        pose_image=seen(landmarks.pose),
        pose_world=np.concatenate([world.numpy(), np.ones((count, 33, 1), np.float32)], -1),
        face_mesh=seen(landmarks.face_mesh) if face else blank.face_mesh,
    )
    return DetectedClip(keypoints, cameras, poses, joints)


def whole_body(clip: DetectedClip, body, landmarks: Landmarks) -> DetectedClip:
    """The same clip as the 133 points alone, as an mmpose file gives them."""
    vertices, joints = pose_body(
        body, mean_identity(body), clip.poses.rotation, clip.poses.expression, clip.poses.transl
    )
    camera = next(iter(clip.cameras.values()))
    pixels = project(camera, locate(landmarks.whole_body, joints, vertices))
    blank = empty_keypoints(clip.keypoints.frames)
    points = torch.cat([pixels, torch.ones_like(pixels[..., :1])], -1).numpy()
    return dataclasses.replace(clip, keypoints=dataclasses.replace(blank, whole_body=points))


def problem_of(
    model: tuple[BodyModel, Landmarks], clip: DetectedClip, betas: int = 4
) -> tuple[RegistrationObjective, Parameters, frozenset[str]]:
    """Objective, initial parameters and frozen groups, as the registration makes them without a face."""
    body, landmarks = model
    settings = FitSettings(face="off", betas=betas)
    views = views_of(clip.keypoints, clip.cameras)
    seen = observe(clip.keypoints, landmarks, settings.score_threshold, views.size.numpy())
    on_face = seen.of("face") & on_skin(body, seen.points)
    spread = spread_matrix(body, seen.points[on_face])
    found = landmark_model(body, seen.points, settings.betas, spread)
    initial = initial_parameters(clip.keypoints, seen, found, views)
    movable = movable_joints(found, seen.mask.any(0), seen.vague)
    objective = RegistrationObjective(body, seen, found, views, initial, movable, settings)
    frozen = frozen_groups(settings, face_is_seen=bool((seen.mask.any(0) & on_face).any()))
    return objective, initial, frozen
