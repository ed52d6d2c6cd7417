"""Filtering a generator's frames: detected, compared with the driving poses, registered, counted."""

from __future__ import annotations

import dataclasses
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipeline.body import Landmarks, Poses, pose_frame, posed_vertices
from pipeline.clip.camera import Camera
from pipeline.clip.fitted_clip import FittedClip
from pipeline.clip.frames import read_mask, write_frame, write_mask
from stages.auxiliary import frame_checks
from stages.auxiliary.detect_generated import DetectedPicture, PictureDetector
from stages.auxiliary.generator_output import GeneratedPicture, GeneratorOutput
from stages.auxiliary.register import register
from stages.auxiliary.skeleton import driven_keypoints, head_facing

if TYPE_CHECKING:
    from pipeline.run.stage import Context


@dataclasses.dataclass(frozen=True)
class FilteredFrames:
    """The frames that are kept of a generator's output. The pictures are in ``folder``, uncropped.

    Attributes:
        folder: with ``frames`` and ``masks``.
        poses: of the kept frames, registered.
        cameras: frame number -> camera.
        keypoints: [T, 133, 3], of the uncropped pictures.
        offered: how many frames there were.
        refused: reason -> how many.
        identity: each kept frame's distance from the subject's face; None where none was compared.
        notes: what a reader of the counts should know.
    """

    folder: Path
    poses: Poses
    cameras: dict[int, Camera]
    keypoints: np.ndarray
    offered: int
    refused: dict[str, int]
    identity: dict[int, float | None]
    notes: tuple[str, ...] = ()


def take_all(
    context: Context, clip: FittedClip, landmarks: Landmarks, output: GeneratorOutput, total: int
) -> FilteredFrames:
    """All frames of an output whose pictures show their poses exactly; keypoints are the poses' own."""
    folder, frames, points = _made(context), [], []
    with context.progress(total, "frames") as progress:
        for picture in output.pictures:
            _keep(folder, picture, picture.mask)
            vertices, joints = pose_frame(clip.body, clip.identity, output.poses.pose(picture.frame))
            camera = output.cameras[picture.frame]
            points.append(driven_keypoints(clip, landmarks, joints, vertices, camera))
            frames.append(picture.frame)
            progress.advance()
    return FilteredFrames(
        folder=folder,
        poses=output.poses.select(frames),
        cameras={frame: output.cameras[frame] for frame in frames},
        keypoints=np.stack(points) if points else np.zeros((0, 133, 3), np.float32),
        offered=len(frames),
        refused={},
        identity=dict.fromkeys(frames),
    )


def filter_frames(
    context: Context, clip: FittedClip, landmarks: Landmarks, output: GeneratorOutput
) -> FilteredFrames:
    """The frames of an output that pass the checks, registered to their keypoints."""
    settings, folder, detector = context.settings, _made(context), PictureDetector(context)
    detections: list[DetectedPicture] = []
    with context.progress(len(output.poses), "looking") as progress:
        for picture in output.pictures:
            detected = detector.detect(picture)
            _keep(folder, picture, detected.mask)
            detections.append(dataclasses.replace(detected, mask=np.zeros((0, 0), np.uint8)))
            progress.advance()
    driving = _driving(clip, landmarks, output, detections)
    subject = detector.subject(clip)
    reasons = _first_reasons(detections, driving, subject, settings)
    left = [row for row, reason in enumerate(reasons) if reason is None]
    frames = [detections[row].frame for row in left]
    poses = output.poses.select(frames)
    if settings.register and left:
        usable = [frame_checks.usable_points(detections[row].keypoints, driving.matched[row]) for row in left]
        cameras = [output.cameras[frame] for frame in frames]
        poses = register(clip, landmarks, poses, cameras, np.stack(usable))
    for row in left:
        frame = detections[row].frame
        mask = read_mask(folder / "masks", frame)
        vertices = posed_vertices(clip.body, clip.identity, poses.pose(frame))
        if not frame_checks.mask_fits(clip, vertices, output.cameras[frame], mask, settings):
            reasons[row] = frame_checks.MASK
    kept = [row for row in left if reasons[row] is None]
    frames = [detections[row].frame for row in kept]
    notes = (
        ()
        if subject is not None
        else ("no face in the clip is large enough to be known again: identity was not checked",)
    )
    return FilteredFrames(
        folder=folder,
        poses=poses.select(frames),
        cameras={frame: output.cameras[frame] for frame in frames},
        keypoints=np.stack([detections[row].keypoints for row in kept])
        if kept
        else np.zeros((0, 133, 3), np.float32),
        offered=len(detections),
        refused=dict(sorted(Counter(reason for reason in reasons if reason).items())),
        identity={detections[row].frame: driving.identity[row] for row in kept},
        notes=notes,
    )


@dataclasses.dataclass
class _Driving:
    """Each frame compared with its driving pose."""

    matched: list[frame_checks.KeypointMatch]
    cosines: list[float]
    identity: list[float | None] = dataclasses.field(default_factory=list)


def _driving(
    clip: FittedClip, landmarks: Landmarks, output: GeneratorOutput, detections: list[DetectedPicture]
) -> _Driving:
    matched, cosines = [], []
    for detected in detections:
        pose, camera = output.poses.pose(detected.frame), output.cameras[detected.frame]
        vertices, joints = pose_frame(clip.body, clip.identity, pose)
        driven = driven_keypoints(clip, landmarks, joints, vertices, camera)
        cosines.append(head_facing(clip, pose, camera, vertices.mean(0)))
        matched.append(frame_checks.match_keypoints(detected.keypoints, driven, cosines[-1]))
    return _Driving(matched, cosines)


def _first_reasons(
    detections: list[DetectedPicture], driving: _Driving, subject: np.ndarray | None, settings
) -> list[str | None]:
    """The reason for which each frame is refused before it is registered, or None."""
    limit = settings.identity_distance
    driving.identity, stranger = frame_checks.other_faces(detections, driving.cosines, subject, limit)
    flickers = frame_checks.flickering(detections, settings.flicker)
    reasons: list[str | None] = []
    for row, detected in enumerate(detections):
        face = driving.identity[row]
        if not detected.found:
            reasons.append(frame_checks.NOBODY)
        elif stranger or (face is not None and face > limit):
            reasons.append(frame_checks.FACE_OF)
        elif driving.matched[row].distance > settings.keypoint_distance:
            reasons.append(frame_checks.POSE)
        elif frame_checks.wrong_way(detected, driving.cosines[row]):
            reasons.append(frame_checks.AWAY)
        else:
            reasons.append(frame_checks.FLICKER if flickers[row] else None)
    return reasons


def _made(context: Context) -> Path:
    folder = context.work / "made"
    for kind in ("frames", "masks"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    return folder


def _keep(folder: Path, picture: GeneratedPicture, mask: np.ndarray | None) -> None:
    write_frame(folder / "frames", picture.frame, picture.image)
    whole = np.full(picture.image.shape[:2], 255, np.uint8) if mask is None else mask
    write_mask(folder / "masks", picture.frame, whole)
