"""The start of the optimisation: arms down, the torso turned as the 3D landmarks say, in its place.

A T pose is far from every clip. The torso's turn comes from the estimator's 3D landmarks where the
torso is seen; the place comes from a weak-perspective fit of the landmarks to their pixels.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import roma
import torch
from torch import Tensor
from torch.nn.functional import normalize

from pipeline.body import joint_orientations
from pipeline.body.joints import JAW, joint_index
from pipeline.clip.keypoints import Keypoints
from stages.fit.camera_batch import CameraBatch
from stages.fit.face import FaceTarget
from stages.fit.observations import POSE_HIPS, POSE_SHOULDERS, Observations
from stages.fit.parameters import LandmarkModel, Parameters, parameters_of

ARMS_DOWN = 1.1
"""Radians about Z by which the shoulders are lowered from the T pose."""

_LIMB_SCORE = 0.4  # of every landmark of a limb that the start believes
_LIMBS = tuple(
    ((f"{side}_{first}", f"{side}_{second}", f"{side}_{third}"), [row, row + 2, row + 4])
    for first, second, third, left in (("shoulder", "elbow", "wrist", 11), ("hip", "knee", "ankle", 23))
    for side, row in (("left", left), ("right", left + 1))
)
"""A limb's joints and its rows among MediaPipe's pose landmarks."""

_UNSEEN_DISTANCE = 3.0  # metres before the camera for a body of which nothing is seen


def initial_parameters(
    keypoints: Keypoints, observations: Observations, model: LandmarkModel, views: CameraBatch
) -> Parameters:
    """The start of the optimisation for T frames.

    Args:
        keypoints: the clip's detections; only their 3D pose is used here.
    """
    count = len(observations.frames)
    rotation = torch.zeros(count, 55, 3)
    rotation[:, joint_index("left_shoulder"), 2] = -ARMS_DOWN
    rotation[:, joint_index("right_shoulder"), 2] = ARMS_DOWN
    rotation[:, 0] = torso_orientation(keypoints, observations, views)
    bend_limbs(rotation, keypoints, model, views)
    sizes = model.shape.shape[2], model.expression.shape[2], model.face.shape[1]
    parameters = parameters_of(rotation, torch.zeros(count, 3), sizes)
    points, _ = model.posed(parameters, parameters.matrices)
    transl = weak_perspective(points, observations, views)
    return parameters_of(rotation, transl, sizes)


def with_face(parameters: Parameters, target: FaceTarget, movable: Tensor) -> Parameters:
    """The start with the expression and the jaw of the face that was fitted first.

    Frames of which it says nothing take them from their neighbours.

    Args:
        parameters: of T frames.
        movable: [55] bool, joints that are fitted; the jaw stays where it may not move.
    """
    if not target.valid.any():
        return parameters
    expression = _interpolated(target.expression, target.valid)
    jaw = roma.rotvec_to_rotmat(_interpolated(target.jaw, target.valid))[:, None, :, :2].flatten(-2)
    moved = bool(movable[JAW])
    return dataclasses.replace(parameters, expression=expression, jaw=jaw if moved else parameters.jaw)


def bend_limbs(rotation: Tensor, keypoints: Keypoints, model: LandmarkModel, views: CameraBatch) -> None:
    """Turn arms and legs, in place, as the 3D landmarks say where all of a limb is scored well.

    In the picture alone a forearm that points at the camera and one that points away from it look the
    same, and from a hanging arm the fit finds either: elbows that bend backwards. Frames that do not know
    take a limb's rotations from their neighbours.

    Args:
        rotation: [T, 55, 3], rotation vectors; the torso's is set already.
        keypoints: the clip's detections; its 3D pose is used.
        model: the landmarks, for the rest joints.
    """
    world = torch.from_numpy(keypoints.pose_world)
    above = joint_orientations(rotation, model.parents)
    for names, rows in _LIMBS:
        upper, middle, end = (joint_index(name) for name in names)
        bones = world[:, rows[1:], :3] - world[:, rows[:2], :3]  # [T, 2, 3], in the camera's axes
        known = (world[:, rows, 3] >= _LIMB_SCORE).all(1) & (bones.norm(dim=-1) > 1e-3).all(1)
        if not known.any():
            continue
        to_parent = above[:, model.parents[upper]].mT @ views.rotation.mT
        first_bone, second_bone = (to_parent[:, None] @ bones[..., None])[..., 0].unbind(1)
        first = shortest_turn(model.joints[middle] - model.joints[upper], first_bone)
        second_bone = (first.mT @ second_bone[..., None])[..., 0]
        second = shortest_turn(model.joints[end] - model.joints[middle], second_bone)
        for joint, turn in ((upper, first), (middle, second)):
            filled = _fill(roma.rotmat_to_unitquat(turn.double()), known)
            rotation[:, joint] = continuous(roma.unitquat_to_rotvec(filled)).float()


def shortest_turn(start: Tensor, end: Tensor) -> Tensor:
    """The smallest rotation of a direction [3] to others [T, 3]: [T, 3, 3]; none to the opposite one."""
    start = normalize(start, dim=0).expand_as(end)
    end = normalize(end, dim=-1)
    axis = torch.linalg.cross(start, end)
    sine = axis.norm(dim=-1, keepdim=True)
    angle = torch.atan2(sine, (start * end).sum(-1, keepdim=True))
    return roma.rotvec_to_rotmat(axis / sine.clamp_min(1e-8) * angle)


def torso_orientation(keypoints: Keypoints, observations: Observations, views: CameraBatch) -> Tensor:
    """The pelvis' rotation in the world: [T, 3], rotation vectors, continuous over time.

    Where shoulders and hips are seen they give the whole rotation; where shoulders alone are, they give
    the turn about the vertical; frames without either take it from their neighbours, and a clip without
    any faces the camera.
    """
    world, score = keypoints.pose_world[..., :3], keypoints.pose_image[..., 3]
    shoulders = (score[:, POSE_SHOULDERS] >= 0.4).all(1) & np.abs(world).any((1, 2))
    hips = shoulders & torso_is_seen(observations).numpy()
    across = world[:, 11] - world[:, 12]
    up = world[:, POSE_SHOULDERS].mean(1) - world[:, POSE_HIPS].mean(1)
    across = np.where(hips[:, None], across + world[:, 23] - world[:, 24], across * [1, 0, 1])
    up = np.where(hips[:, None], up, [0.0, -1.0, 0.0])
    known = shoulders & (np.linalg.norm(across, axis=1) > 1e-3) & (np.linalg.norm(up, axis=1) > 1e-3)
    in_camera = np.tile(np.diag([1.0, -1.0, -1.0]), (len(world), 1, 1))  # upright, facing the camera
    in_camera[known] = _frame(across[known].astype(np.float64), up[known].astype(np.float64))
    facing = views.rotation.mT.double() @ torch.from_numpy(in_camera)
    quaternions = _fill(roma.rotmat_to_unitquat(facing), torch.from_numpy(known))
    return continuous(roma.unitquat_to_rotvec(quaternions)).float()


def torso_is_seen(observations: Observations) -> Tensor:
    """Frames whose hips are no guess: [T] bool. False throughout if the source has no 3D pose."""
    if observations.limbs.start.numel() == 0:
        return torch.zeros(len(observations.frames), dtype=torch.bool)
    return observations.mask[:, list(POSE_HIPS)].any(1)


def _frame(across: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Rotations whose X axis is nearest to ``across`` for the Y axis ``up``: [T, 3] twice -> [T, 3, 3]."""
    y = up / np.linalg.norm(up, axis=1, keepdims=True)
    x = across - (across * y).sum(1, keepdims=True) * y
    x = x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-9)
    return np.stack([x, y, np.cross(x, y)], axis=2)


def _fill(quaternions: Tensor, known: Tensor) -> Tensor:
    """[T, 4] with the unknown ones interpolated between their neighbours; all unknown are left alone."""
    rows = torch.nonzero(known)[:, 0]
    if len(rows) == 0:
        return quaternions
    chain = [quaternions[rows[0]]]
    for row in rows[1:]:
        following = quaternions[row]
        chain.append(following if (following * chain[-1]).sum() >= 0 else -following)
    seen = torch.stack(chain).numpy()
    every = np.arange(len(quaternions))
    mixed = np.stack([np.interp(every, rows.numpy(), seen[:, k]) for k in range(4)], axis=1)
    return torch.from_numpy(mixed / np.linalg.norm(mixed, axis=1, keepdims=True))


def continuous(rotation: Tensor) -> Tensor:
    """The same rotations with each vector on the branch nearest to the one before: [T, ..., 3].

    A rotation by angle a about an axis is also one by a - 2 pi, so a turning body's vectors would jump.
    """
    flat = rotation.detach().clone().reshape(len(rotation), -1, 3)
    for t in range(1, len(flat)):
        before, now = flat[t - 1], flat[t]
        length = now.norm(dim=-1, keepdim=True)
        axis = torch.where(length > 1e-6, now / length.clamp_min(1e-6), torch.zeros_like(now))
        turns = torch.round(((before * axis).sum(-1, keepdim=True) - length) / (2 * math.pi))
        flat[t] = torch.where(turns != 0, now + 2 * math.pi * turns * axis, now)
    return flat.reshape(rotation.shape)


def weak_perspective(points: Tensor, observations: Observations, views: CameraBatch) -> Tensor:
    """The translation that puts landmarks near their pixels, by linear least squares.

    Each frame has a scale s and a shift: pixel = s * place + shift over its reliable points, which gives
    depth = focal / s. The scale is held within 0.7 to 1.4 of the clip's median, and frames with fewer than
    two points are interpolated.

    Args:
        points: [T, N, 3], posed landmarks without translation, in the world.

    Returns:
        [T, 3], metres, in the world.
    """
    weight = _reliable(observations)[..., None]
    focal = views.focal.mean(1)
    place = points @ views.rotation.mT
    total = weight.sum(1).clamp_min(1e-9)
    mean_place = (place * weight).sum(1) / total
    mean_pixel = (observations.pixels * weight).sum(1) / total
    spread = (place - mean_place[:, None])[..., :2]
    shift = observations.pixels - mean_pixel[:, None]
    size = (spread.square() * weight).sum((1, 2))
    known = (weight[..., 0] > 0).sum(1).ge(2) & (size > 1e-8)
    if not known.any():
        ahead = points.new_tensor([0.0, 0.0, _UNSEEN_DISTANCE]).expand(len(points), 3)
        return _to_world(ahead, views)
    scale = (spread * shift * weight).sum((1, 2)) / size.clamp_min(1e-8) / focal  # 1 / metres
    usual = scale[known].clamp_min(1e-3).median()
    scale = torch.where(known, scale, usual).clamp(usual * 0.7, usual * 1.4)
    offset = (mean_pixel - views.centre) / views.focal / scale[:, None] - mean_place[:, :2]
    in_camera = torch.cat([offset, (1 / scale - mean_place[:, 2])[:, None]], dim=1)
    return _to_world(_interpolated(in_camera, known), views)


def _reliable(observations: Observations) -> Tensor:
    """[T, N] weights of the points that place a body: its torso where seen, else all but the limbs' ends."""
    weight = observations.mask * observations.weight
    torso = torso_is_seen(observations)
    if torso.any():
        trunk = torch.zeros_like(weight)
        trunk[:, [*POSE_SHOULDERS, *POSE_HIPS]] = 1.0
        return torch.where(torso[:, None], trunk * observations.mask, torch.zeros_like(weight))
    body, face = observations.of("body"), observations.of("face")
    from_arms = 13 if observations.limbs.start.numel() else 7
    head = body & (torch.arange(len(body)) < from_arms)
    steady = head | face
    return weight * steady if (weight * steady).any() else weight


def _interpolated(values: Tensor, known: Tensor) -> Tensor:
    """[T, K] with the rows that are not known interpolated between those that are."""
    rows = torch.nonzero(known)[:, 0].numpy()
    every = np.arange(len(values))
    columns = [np.interp(every, rows, values[:, k].numpy()[rows]) for k in range(values.shape[1])]
    return torch.from_numpy(np.stack(columns, axis=1)).to(values.dtype)


def _to_world(in_camera: Tensor, views: CameraBatch) -> Tensor:
    """[T, 3] in the camera's axes -> [T, 3] in the world."""
    return views.to_world(in_camera[:, None])[:, 0]
