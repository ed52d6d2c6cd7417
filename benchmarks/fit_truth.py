"""What a registration is measured against: mannequin clips, and how far a fitted body is from their truth.

Errors of joints and surface are measured after alignment, since one camera does not tell how far away a
body of unknown size is. Two alignments are made, frame by frame:

- *root*: both bodies are moved so that one joint, the anchor, coincides. It is the pelvis where the whole
  body is in the picture, and the neck in closer framings, whose pelvis is never seen;
- *Procrustes*: the similarity (rotation, translation, scale) that brings the seen joints nearest.

Only what the camera saw counts: joints and keypoints whose state is SEEN, and vertices of the body's own
surface (without hair and clothes) that nothing of that surface hides.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import roma
import torch
from torch import Tensor

from pipeline.body import (
    BodyModel,
    Identity,
    Landmarks,
    Poses,
    joint_index,
    load_body,
    load_landmarks,
    locate,
    pose_body,
    rasterize,
)
from pipeline.clip.camera import Camera, project
from pipeline.clip.keypoints import Keypoints
from pipeline.pose_files import InitialPoses
from stages.ingest.mannequin import DETECTORS, MannequinSpec
from stages.ingest.mannequin.footage import Filming
from stages.ingest.mannequin.simulated_detector import simulate_detections
from stages.ingest.mannequin.truth import SEEN, Truth, seen_vertices

BODY_FOLDER = Path(__file__).parents[1] / "data" / "body"
ANCHORS = {"full": "pelvis", "upper": "neck", "head": "neck"}
"""By framing, the joint at which bodies are aligned: one that is in the picture."""

REGRESSOR = "regressor"
SOURCES = (*DETECTORS, REGRESSOR)
"""Who gives the keypoints: a simulated detector alone, or heatmap's points with a regressor's poses to
start from, which is what the paper has (DWPose and SMPLest-X)."""

BODY_JOINTS = 22  # pelvis to wrists: neither jaw, eyes nor fingers
_TRUNK = ("pelvis", "spine1", "spine2", "spine3", "neck", "head", "left_collar", "right_collar")
_DRIFT = 0.9  # how much of a frame's error is left in the next
_LEAST_POINTS = 3  # that fix a similarity
_SURFACE_DEPTH = 0.01  # metres; the rasterized depth is that of a pixel's centre, not of the vertex


@dataclasses.dataclass(frozen=True)
class Stage:
    """A body and where keypoints lie on it."""

    body: BodyModel
    landmarks: Landmarks


@dataclasses.dataclass(frozen=True)
class TrueClip:
    """Detections of T frames and the truth behind them.

    Attributes:
        spec: what was filmed.
        detector: who gave the keypoints.
        keypoints: what the fit is given, with
        cameras: frame number -> camera.
        truth: of the same T frames.
        vertices: [T, V, 3], the body's own surface, metres in the world.
        vertex_seen: [T, V] bool.
        start: poses that another program estimated, to start from; None starts from the keypoints.
    """

    spec: MannequinSpec
    detector: str
    keypoints: Keypoints
    cameras: dict[int, Camera]
    truth: Truth
    vertices: Tensor
    vertex_seen: Tensor
    start: InitialPoses | None = None

    @property
    def joints(self) -> Tensor:
        """[T, 55, 3], metres in the world."""
        return torch.from_numpy(self.truth.joints)

    @property
    def joint_seen(self) -> Tensor:
        """[T, 55] bool."""
        return torch.from_numpy(self.truth.joint_state == SEEN)


@dataclasses.dataclass(frozen=True)
class Errors:
    """Means over everything seen in a clip; millimetres, and pixels of the clip.

    Attributes:
        joints: of the 55 joints, aligned at the anchor.
        pelvis: the same aligned at the pelvis, in whatever framing.
        procrustes: of the 55 joints, after the best similarity.
        body: of the 22 joints without jaw, eyes and fingers, aligned at the anchor.
        surface: vertex to vertex, aligned at the anchor.
        pixels: of the 133 keypoints against their true pixels.
    """

    joints: float
    pelvis: float
    procrustes: float
    body: float
    surface: float
    pixels: float


def load_stage(folder: Path = BODY_FOLDER) -> Stage:
    """The open body and its landmarks."""
    body = load_body(folder / "open_body.npz")
    return Stage(body, load_landmarks(body, folder))


def make_clips(spec: MannequinSpec, stage: Stage, detectors: tuple[str, ...]) -> list[TrueClip]:
    """One motion, filmed once, as several detectors see it.

    Args:
        spec: what is filmed; its own detector is not read.
        stage: the body.
        detectors: of ``SOURCES``.
    """
    filming = Filming(spec, stage.body, stage.landmarks)
    for _ in filming.pictures():
        pass
    keypoints, truth = filming.finish()
    camera = filming.scene.shot.camera
    vertices, _ = pose_body(
        stage.body, truth.identity, truth.poses.rotation, truth.poses.expression, truth.poses.transl
    )
    seen = torch.stack([_seen_surface(camera, stage.body, frame) for frame in vertices])
    cameras = dict.fromkeys(range(spec.frames), camera)
    clips = []
    for name in detectors:
        seer = dataclasses.replace(spec, detector="heatmap" if name == REGRESSOR else name)
        keypoints = simulate_detections(seer, camera, filming.places, filming.point_states)
        start = regressed(truth, camera, spec.seed) if name == REGRESSOR else None
        clips.append(TrueClip(spec, name, keypoints, cameras, truth, vertices, seen, start))
    return clips


def regressed(truth: Truth, camera: Camera, seed: int) -> InitialPoses:
    """The truth as a pose regressor (such as SMPLest-X) would give it: off by errors that drift.

    The errors are assumed, not measured: 0.06 radians a joint from the pelvis to the head, 0.15 a joint of
    the limbs and 0.3 a joint of the hands, twice that where the joint is not in view; no shape, no
    expression, no place.
    """
    rng = np.random.default_rng([seed, 11])
    sigma = np.repeat([0.15, 0.3], [25, 30])[:, None]
    sigma[[joint_index(name) for name in _TRUNK]] = 0.06
    unseen = (truth.joint_state != SEEN)[..., None]
    drift = rng.standard_normal((len(truth.poses), 55, 3))
    for row in range(1, len(drift)):
        drift[row] = _DRIFT * drift[row - 1] + (1 - _DRIFT**2) ** 0.5 * drift[row]
    error = torch.from_numpy(drift * sigma * np.where(unseen, 2.0, 1.0)).float()
    local = roma.rotvec_to_rotmat(truth.poses.rotation) @ roma.rotvec_to_rotmat(error)
    local[:, 0] = camera.rotation @ local[:, 0]
    valid = torch.ones(len(local), dtype=torch.bool)
    return InitialPoses(truth.poses.frames, roma.rotmat_to_rotvec(local), None, None, None, valid)


def _seen_surface(camera: Camera, body: BodyModel, vertices: Tensor) -> Tensor:
    """Which vertices [V, 3] the camera sees where nothing but the body itself can hide them: [V] bool."""
    depth = rasterize(camera, vertices, body.faces).depth
    return torch.from_numpy(seen_vertices(camera, depth, vertices, _SURFACE_DEPTH))


def measure(identity: Identity, poses: Poses, clip: TrueClip, stage: Stage) -> Errors:
    """How far a fitted body and its motion are from the truth of their clip."""
    vertices, joints = pose_body(stage.body, identity, poses.rotation, poses.expression, poses.transl)
    true, seen = clip.joints, clip.joint_seen
    anchor, pelvis = joint_index(ANCHORS[clip.spec.framing]), joint_index("pelvis")
    shift = true[:, anchor] - joints[:, anchor]
    away = from_anchor(joints, true, anchor)
    keypoints = locate(stage.landmarks.whole_body, joints, vertices)
    pixels = torch.stack(
        [project(clip.cameras[f], points) for f, points in zip(poses.frames, keypoints, strict=True)]
    )
    off = (pixels - torch.from_numpy(clip.truth.keypoints)).norm(dim=-1)
    return Errors(
        joints=1e3 * mean_of_seen(away, seen),
        pelvis=1e3 * mean_of_seen(from_anchor(joints, true, pelvis), seen),
        procrustes=1e3 * mean_of_seen((procrustes(joints, true, seen) - true).norm(dim=-1), seen),
        body=1e3 * mean_of_seen(away[:, :BODY_JOINTS], seen[:, :BODY_JOINTS]),
        surface=1e3
        * mean_of_seen((vertices + shift[:, None] - clip.vertices).norm(dim=-1), clip.vertex_seen),
        pixels=mean_of_seen(off, torch.from_numpy(clip.truth.keypoint_state == SEEN)),
    )


def from_anchor(points: Tensor, target: Tensor, anchor: int) -> Tensor:
    """Distances once both sets were moved so that their row ``anchor`` is the same place.

    Args:
        points, target: [T, K, 3].
        anchor: a row of K.

    Returns:
        [T, K].
    """
    return ((points - points[:, anchor, None]) - (target - target[:, anchor, None])).norm(dim=-1)


def procrustes(points: Tensor, target: Tensor, seen: Tensor) -> Tensor:
    """The points after the similarity that brings the seen ones nearest to their targets, frame by frame.

    Args:
        points, target: [T, K, 3].
        seen: [T, K] bool; only these decide on the similarity. It never mirrors.

    Returns:
        [T, K, 3]; NaN in frames with fewer than three seen points.
    """
    aligned = torch.full_like(points, torch.nan)
    enough = seen.sum(1) >= _LEAST_POINTS
    if enough.any():
        source, goal = points[enough].double(), target[enough].double()
        rotation, shift, scale = roma.rigid_points_registration(
            source, goal, seen[enough].double(), compute_scaling=True
        )
        moved = scale[:, None, None] * (source @ rotation.mT) + shift[:, None]
        aligned[enough] = moved.to(points.dtype)
    return aligned


def mean_of_seen(distance: Tensor, seen: Tensor) -> float:
    """The mean over what was seen, [T, K] both; NaN where nothing was, and NaN distances do not count."""
    return float(distance[seen].nanmean())
