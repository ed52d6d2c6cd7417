"""Measurements that the plan decides by, from what ingest and fit published."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import roma
import torch
from torch import Tensor

from pipeline.avatar import Architecture, Avatar, Surface
from pipeline.avatar.density import DENSITY_FRAMES, choose_splits, count_by_part, project_surface
from pipeline.avatar.visibility import body_in_frame
from pipeline.body import PARTS, pose_body
from pipeline.clip.boxes import MARGIN
from pipeline.clip.camera import Camera, project, to_camera
from pipeline.clip.clock import BREAK, frame_times, usual_step
from pipeline.clip.fitted_clip import FittedClip, read_fitted_clip
from pipeline.clip.keypoints import FACE, LEFT_HAND, RIGHT_HAND
from pipeline.clip.plan import AZIMUTH_STEP
from pipeline.errors import UserError
from pipeline.files.tables import read_table
from pipeline.untrusted import parse_json

TRUSTED = 0.4  # score from which a keypoint is believed, as in Eq. 2
SHOWN = 0.5  # share of a part's points that a frame must show
LEAST_FRAMES = 0.05  # share of the training frames that must show a part for its size to count
POINTS = {"face": FACE, "left_hand": LEFT_HAND, "right_hand": RIGHT_HAND}
LOOKED_AT = 16  # training frames, evenly spaced, in which the pixels between vertices are measured
LEAST_POINTS, ALIGNMENTS = 4, 3  # of keypoints that are laid over each other
LAG = 2.0  # 30ths of a second after which a detector's errors are others

RESIDUALS = pa.schema([("frame", pa.int32()), ("pixels", pa.float32())])
"""The columns of fit's residuals.parquet that are read."""


@dataclasses.dataclass(frozen=True)
class PlanInputs:
    """The inputs of the plan.

    Attributes:
        clip: the clip and the fitted person.
        cameras: of every frame, cropped to the person's box over the training frames.
        errors: frame number -> mean reprojection error of its trusted keypoints, pixels.
        face: what fit says of face registration.
    """

    clip: FittedClip
    cameras: Mapping[int, Camera]
    errors: Mapping[int, float]
    face: Mapping[str, Any]

    @cached_property
    def surface(self) -> Surface:
        """The body's mesh with the clip's identity."""
        bare = Architecture(plane_resolution=2, plane_channels=1, subdivisions=0)
        body = self.clip.body
        return Avatar(body, self.clip.identity, torch.arange(len(body.v_template)), bare).surfaces[0]


def read_inputs(ingest: Path, fit: Path, body_file: Path) -> PlanInputs:
    """Read what ingest and fit published.

    Raises:
        UserError: a file is missing or damaged, or the files do not go together.
    """
    clip = read_fitted_clip(ingest, fit, body_file)
    box = clip.person_box(MARGIN)
    return PlanInputs(
        clip=clip,
        cameras={frame: clip.camera(frame, box) for frame in clip.cameras},
        errors=_errors(fit / "residuals.parquet"),
        face=_face(fit / "face.json"),
    )


def _errors(path: Path) -> dict[int, float]:
    table = read_table(path, RESIDUALS, "run the fit stage again")
    frames, pixels = table["frame"], table["pixels"]
    return {int(frame): float(pixels[frames == frame].mean()) for frame in np.unique(frames)}


def _face(path: Path) -> dict[str, Any]:
    content = parse_json(path, "run the fit stage again")
    if not isinstance(content, dict) or set(content) != {"source", "frames", "registered"}:
        raise UserError(f"{path} is not what fit says of the face: run the fit stage again")
    return content


def visibility(inputs: PlanInputs) -> tuple[np.ndarray, dict[str, float]]:
    """The share of training frames in whose pictures each vertex of the fitted body lies.

    Returns:
        The scores, [V] in [0, 1], and for each part of the body the largest share of its vertices that a
        training frame shows.
    """
    clip, cameras, surface = inputs.clip, inputs.cameras, inputs.surface
    labels = surface.canonical.parts
    size = torch.bincount(labels, minlength=len(PARTS)).clamp_min(1)
    hits, most = torch.zeros(len(labels)), torch.zeros(len(PARTS))
    for frame in clip.split.train:
        seen = body_in_frame(surface, clip.pose(frame), cameras[frame])
        hits += seen
        most = torch.maximum(most, torch.bincount(labels[seen], minlength=len(PARTS)) / size)
    scores = (hits.double() / len(clip.split.train)).numpy()
    return scores, dict(zip(PARTS, most.tolist(), strict=True))


def gaussian_pixels(inputs: PlanInputs) -> float:
    """The distance of the body's vertices from each other in the picture, pixels.

    The root of the area that each has of what faces the camera within the person's box: the mean over
    ``LOOKED_AT`` training frames. 0 where none of them shows anything.
    """
    clip, cameras = inputs.clip, inputs.cameras
    frames = clip.spread(LOOKED_AT)
    poses = clip.poses.select(frames)
    vertices, _ = pose_body(clip.body, clip.identity, poses.rotation, poses.expression, poses.transl)
    faces = clip.body.faces
    found = [vertex_spacing(seen, faces, cameras[f]) for seen, f in zip(vertices, frames, strict=True)]
    shown = [one for one in found if one > 0]
    return float(np.mean(shown)) if shown else 0.0


def vertex_spacing(vertices: Tensor, faces: Tensor, camera: Camera) -> float:
    """The distance of neighbouring vertices in a picture, pixels; 0 if no face of the mesh is seen.

    Args:
        vertices: [V, 3], world.
        faces: [F, 3], corners to the left seen from outside.
        camera: of the picture.
    """
    pixels, depth = project(camera, vertices), to_camera(camera, vertices)[:, 2]
    corners = pixels[faces.long()]  # [F, 3, 2]
    middle = corners.mean(1)
    size = middle.new_tensor([camera.width, camera.height])
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / 2
    # From outside a face's corners go round to the left; the picture's y axis points down, hence the sign.
    facing = area < 0
    seen = facing & ((middle > 0) & (middle < size)).all(1) & (depth[faces.long()] > 0).all(1)
    # A closed mesh has two faces a vertex.
    return math.sqrt(float(area[seen].abs().sum()) / (int(seen.sum()) / 2)) if seen.any() else 0.0


def gaussians_by_part(inputs: PlanInputs, edge_pixels: float) -> dict[str, int]:
    """The Gaussians that the pixels call for, by part of the body.

    They are the vertices that some training frame has in its picture, and those that splitting its edges adds
    (``pipeline.avatar.density``).

    Args:
        inputs: of the plan.
        edge_pixels: no edge between neighbours is longer than this in a frame that shows it.
    """
    clip, surface = inputs.clip, inputs.surface
    frames = [(clip.pose(frame), inputs.cameras[frame]) for frame in clip.spread(DENSITY_FRAMES)]
    splits = choose_splits(surface.canonical.faces, project_surface(surface, frames), edge_pixels)
    seen = torch.zeros(len(surface.canonical), dtype=torch.bool)
    for frame in clip.split.train:
        seen |= body_in_frame(surface, clip.pose(frame), inputs.cameras[frame])
    added = count_by_part(surface.canonical.parts, splits)
    hidden = torch.bincount(surface.canonical.parts[~seen], minlength=len(PARTS)).tolist()
    return {part: added[part] - unseen for part, unseen in zip(PARTS, hidden, strict=True)}


def part_pixels(clip: FittedClip, part: str) -> float:
    """The diagonal of a part's box of trusted keypoints, pixels: the median over the frames that show it.

    0 where fewer than ``LEAST_FRAMES`` of the training frames show it.
    """
    points = clip.keypoints.whole_body[np.isin(clip.keypoints.frames, clip.split.train)][:, POINTS[part]]
    trusted = points[..., 2] >= TRUSTED
    showing = np.flatnonzero(trusted.mean(1) >= SHOWN)
    if len(showing) < max(1, LEAST_FRAMES * len(points)):
        return 0.0
    sizes = [np.linalg.norm(np.ptp(points[row, trusted[row], :2], axis=0)) for row in showing]
    return float(np.median(sizes))


def pose_change(clip: FittedClip) -> float:
    """The change of the person's shape in the picture, in parts of the person's size.

    Joints that are not seen are fitted to anything, so the fit's own angles say little here; the trusted
    keypoints of each frame are laid over their mean shape instead (moved, turned, scaled), and what is
    left is looked at. A detector's errors do not last, and movements do: so it is not the variance that is
    taken but the covariance with what is left ``LAG`` later (in a clip too short to tell the two apart, or of
    single pictures, the variance). The number is that of the point at the 90th percentile, as a length.
    """
    points = clip.keypoints.whole_body[np.isin(clip.keypoints.frames, clip.split.train)]
    trusted = points[..., 2] >= TRUSTED
    often = trusted.mean(0) >= SHOWN
    trusted = trusted[:, often]
    places = np.where(trusted, points[:, often, 0] + 1j * points[:, often, 1], np.nan)
    usable = trusted.sum(1) >= LEAST_POINTS
    if usable.sum() < 2:
        return 0.0
    step = usual_step(frame_times(clip.keypoints.frames, clip.footage))
    lag = 0 if step >= BREAK else max(1, round(LAG / step))
    lag = lag if usable.sum() > 4 * lag else 0
    laid = places = places[usable]
    for _ in range(ALIGNMENTS):
        mean = np.nanmean(laid, 0)
        laid = np.stack([_laid_over(one, mean) for one in places])
    mean = np.nanmean(laid, 0)
    size = float(np.sqrt(np.mean(np.abs(mean - mean.mean()) ** 2)))
    left = laid - mean
    lasting = np.real(left[lag:] * np.conj(left[: len(left) - lag]))
    known = ~np.isnan(lasting).all(0)
    covariance = np.nanmean(lasting[:, known], 0).clip(min=0)
    return float(np.percentile(np.sqrt(covariance), 90)) / size if size and known.any() else 0.0


def _laid_over(points: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Points of a plane, [N] complex, moved, turned and scaled onto a mean shape; NaN is left out."""
    both = ~np.isnan(points) & ~np.isnan(mean)
    mine, theirs = points[both].mean(), mean[both].mean()
    apart = points[both] - mine
    factor = (np.conj(apart) * (mean[both] - theirs)).sum() / max(float((np.abs(apart) ** 2).sum()), 1e-12)
    return (points - mine) * factor + theirs


def unseen_azimuths(clip: FittedClip, joints: Tensor) -> tuple[float, tuple[float, ...]]:
    """The sides of the body that no training frame shows.

    Args:
        joints: [55, 3], rest joints; the first is the pelvis.

    Returns:
        The widest unbroken range of bins without a frame, degrees, and all such bins' centres.
    """
    seen = [False] * (360 // AZIMUTH_STEP)
    for frame in clip.split.train:
        pose = clip.pose(frame)
        turn = roma.rotvec_to_rotmat(pose.global_orient)
        towards = turn.T @ (clip.cameras[frame].centre - pose.transl - joints[0])
        azimuth = float(torch.rad2deg(torch.atan2(towards[0], towards[2])))
        seen[round(azimuth / AZIMUTH_STEP) % len(seen)] = True
    unseen = tuple(float(AZIMUTH_STEP * place) for place, one in enumerate(seen) if not one)
    return float(AZIMUTH_STEP * _longest(seen)), unseen


def _longest(seen: Sequence[bool]) -> int:
    """The longest run of False in a ring."""
    longest = run = 0
    for one in (*seen, *seen):
        run = 0 if one else run + 1
        longest = max(longest, run)
    return min(longest, len(seen))


def mean_error(inputs: PlanInputs, frames: Sequence[int]) -> float:
    """Mean reprojection error of some frames, pixels; 0 where none has a trusted keypoint."""
    errors = [inputs.errors[frame] for frame in frames if frame in inputs.errors]
    return float(np.mean(errors)) if errors else 0.0
