"""The truth of a mannequin's clip, which the pipeline does not see, and its files.

Written beside what ingest publishes:

- ``truth_poses.parquet``, ``truth_identity.safetensors``: as the fit stage writes its own;
- ``truth_surface.safetensors``: the same identity with hair and clothes in its offsets: what the camera
  sees is this surface;
- ``truth_points.parquet``: ``frame``, ``joints`` [55 x 3] metres in the world, ``joint_state`` [55],
  ``keypoints`` [133 x 2] pixels, ``keypoint_state`` [133].
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pyarrow as pa
import torch
from torch import Tensor

from pipeline.body import (
    BodyModel,
    Identity,
    Landmarks,
    PointSet,
    Poses,
    expression_offsets,
    joint_transforms,
    linear_blend_skinning,
    locate,
    pose_offsets,
    posed_joints,
    read_identity,
    read_poses,
    rest_joints,
    rest_vertices,
    write_identity,
    write_poses,
)
from pipeline.body.landmarks import join
from pipeline.clip.camera import Camera, project, to_camera
from pipeline.files.tables import read_table, vectors, write_table
from stages.ingest.mannequin.framing import in_picture
from stages.ingest.mannequin.scene import FilmedFrame, limbs_of_joints

OUTSIDE, HIDDEN, SEEN = 0, 1, 2
"""States of a point: not in the picture, behind something, or in view."""

_SURFACE_DEPTH = 0.02  # metres; a point of the skin that lies no deeper below what is seen is seen
_JOINT_DEPTH = 0.03  # metres, with the sleeve above it
_ALONG = 3.0  # times deeper may a joint lie below its own limb: one sees where an arm ends that points at one
_SCHEMA = pa.schema(
    [
        ("frame", pa.int32()),
        ("joints", vectors(55 * 3)),
        ("joint_state", vectors(55, pa.int32())),
        ("keypoints", vectors(133 * 2)),
        ("keypoint_state", vectors(133, pa.int32())),
    ]
)
_CHUNK = 256  # frames that are posed at once, which bounds the memory
_REMEDY = "run the ingest stage of a mannequin again"


@dataclasses.dataclass(frozen=True)
class Truth:
    """The truth of a clip, T frames, metres in the pipeline's world, pixels of its frames.

    Attributes:
        identity: the body's, without hair and clothes.
        surface: the same with hair and clothes in ``face_offset``.
        poses: the motion.
        joints: [T, 55, 3] float32.
        joint_state: [T, 55], OUTSIDE, HIDDEN or SEEN.
        keypoints: [T, 133, 2] float32, where the whole-body points really are.
        keypoint_state: [T, 133].
    """

    identity: Identity
    surface: Identity
    poses: Poses
    joints: np.ndarray
    joint_state: np.ndarray
    keypoints: np.ndarray
    keypoint_state: np.ndarray


@dataclasses.dataclass(frozen=True)
class BodyPoints:
    """The places of the body's joints and landmarks: K = 55 joints, then the four sets of landmarks.

    Attributes:
        world: [T, K, 3], metres.
        thickness: [K], how deep below the nearest surface each still counts as seen, metres.
        limb: [K], the limb whose own surface hides each less, as by ``limbs_of_joints``.
        sets: name -> its rows; ``joints`` and the fields of ``Landmarks``.
    """

    world: Tensor
    thickness: np.ndarray
    limb: np.ndarray
    sets: dict[str, slice]


def pose_points(body: BodyModel, landmarks: Landmarks, identity: Identity, poses: Poses) -> BodyPoints:
    """The posed joints and landmarks, by posing the few vertices that landmarks touch."""
    every = PointSet(
        torch.arange(55), torch.zeros(55, 3, dtype=torch.long), torch.tensor([[1.0, 0, 0]]).expand(55, 3)
    )
    names = ("whole_body", "pose", "hands", "face_mesh")
    points = join(every, *(getattr(landmarks, name) for name in names))
    joints, rest = rest_joints(body, identity), rest_vertices(body, identity)
    ids, compact = points.compact()
    part = dataclasses.replace(
        body,
        v_template=rest[ids],
        skinning_weights=body.skinning_weights[ids],
        expression_directions=body.expression_directions[ids],
        pose_directions=None if body.pose_directions is None else body.pose_directions[ids],
    )
    every_row = torch.arange(len(poses)).split(_CHUNK)
    world = torch.cat([locate(compact, *_posed(part, joints, poses, rows)) for rows in every_row])
    # A joint is as deep inside as its nearest skin is far: from any side it is seen through that much.
    depth = 1.5 * torch.cdist(joints, rest).amin(1) + _JOINT_DEPTH
    thickness = torch.where(points.joint >= 0, depth[points.joint.clamp_min(0)], torch.tensor(_SURFACE_DEPTH))
    starts = np.cumsum([0, 55, *(len(getattr(landmarks, name)) for name in names)])
    sets = {
        name: slice(int(a), int(b))
        for name, a, b in zip(("joints", *names), starts, starts[1:], strict=False)
    }
    return BodyPoints(world, thickness.numpy(), limbs_of_joints(points.joint), sets)


def _posed(part: BodyModel, joints: Tensor, poses: Poses, rows: Tensor) -> tuple[Tensor, Tensor]:
    """Joints and the vertices of a part of the body, whose template is shaped already, in some frames."""
    rotation, shift = poses.rotation[rows], poses.transl[rows][:, None]
    shaped = part.v_template + expression_offsets(part, poses.expression[rows])
    correctives = pose_offsets(part, rotation)
    if correctives is not None:
        shaped = shaped + correctives
    transforms = joint_transforms(rotation, joints, part.parents)
    vertices = linear_blend_skinning(transforms, part.skinning_weights, shaped)
    return posed_joints(rotation, joints, part.parents) + shift, vertices + shift


def point_states(camera: Camera, picture: FilmedFrame, places: BodyPoints, row: int) -> np.ndarray:
    """The state of each joint and landmark in one frame, [K] uint8: OUTSIDE, HIDDEN or SEEN.

    Args:
        camera, picture: the view and what it saw.
        places, row: joints and landmarks, and the frame.
    """
    points = places.world[row]
    within, rows, columns, away = _samples(camera, picture.depth, points)
    own = picture.limb[rows, columns] == places.limb
    hidden = away > picture.depth[rows, columns] + places.thickness * np.where(own, _ALONG, 1.0)
    return np.where(within, np.where(hidden, HIDDEN, SEEN), OUTSIDE).astype(np.uint8)


def seen_vertices(
    camera: Camera, depth: np.ndarray, vertices: Tensor, tolerance: float = _SURFACE_DEPTH
) -> np.ndarray:
    """True where vertices [V, 3] are in view in one frame, [V] bool.

    Args:
        camera, depth: the view, and its depth [h, w] at any resolution, metres, infinite beside the body.
        vertices: metres, in the world.
        tolerance: how deep below what is seen a vertex may lie, metres; hair and clothes count.
    """
    within, rows, columns, away = _samples(camera, depth, vertices)
    return within & (away <= depth[rows, columns] + tolerance)


def _samples(
    camera: Camera, depth: np.ndarray, points: Tensor
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of points [K, 3]: in the picture or not, their rows and columns in ``depth``, their Z; each [K]."""
    pixels = project(camera, points).double().numpy()
    away = to_camera(camera, points)[:, 2].numpy()
    scale = np.array([depth.shape[1] / camera.width, depth.shape[0] / camera.height])
    place = (np.clip(pixels, 0, [camera.width - 1e-6, camera.height - 1e-6]) * scale).astype(int)
    return in_picture(camera, pixels) & (away > 0), place[:, 1], place[:, 0], away


def write_truth(folder: Path, truth: Truth, body: BodyModel) -> None:
    """Write the files that the module's docstring lists."""
    write_poses(folder / "truth_poses.parquet", truth.poses)
    write_identity(folder / "truth_identity.safetensors", truth.identity, body)
    write_identity(folder / "truth_surface.safetensors", truth.surface, body)
    columns = {
        "frame": np.array(truth.poses.frames, np.int32),
        "joints": truth.joints,
        "joint_state": truth.joint_state.astype(np.int32),
        "keypoints": truth.keypoints,
        "keypoint_state": truth.keypoint_state.astype(np.int32),
    }
    write_table(folder / "truth_points.parquet", _SCHEMA, columns)


def read_truth(folder: Path, body: BodyModel) -> Truth:
    """Read what ``write_truth`` wrote.

    Raises:
        UserError: a file is missing or damaged, or was made with another body.
    """
    columns = read_table(folder / "truth_points.parquet", _SCHEMA, _REMEDY)
    count = len(columns["frame"])
    return Truth(
        identity=read_identity(folder / "truth_identity.safetensors", body),
        surface=read_identity(folder / "truth_surface.safetensors", body),
        poses=read_poses(folder / "truth_poses.parquet"),
        joints=columns["joints"].reshape(count, 55, 3),
        joint_state=columns["joint_state"].astype(np.uint8),
        keypoints=columns["keypoints"].reshape(count, 133, 2),
        keypoint_state=columns["keypoint_state"].astype(np.uint8),
    )
