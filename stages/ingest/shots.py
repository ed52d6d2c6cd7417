"""The ingest of one camera's footage, and of several as one clip."""

from __future__ import annotations

import dataclasses
import functools
import shutil
import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.clip.camera import Camera
from pipeline.clip.keypoints import Keypoints
from pipeline.clip.records import SHOT_STEP
from pipeline.errors import UserError
from pipeline.pose_files import InitialPoses, on_frames
from stages.ingest.cameras.calibration_files import open_calibration
from stages.ingest.cameras.choose import ClipCameras, choose_cameras
from stages.ingest.cameras.distortion import undistort_frames
from stages.ingest.datasets.recording import Recording, Shot, join_poses
from stages.ingest.detect import DetectedClip, detect
from stages.ingest.external_detections import open_sources
from stages.ingest.foreground import write_foreground
from stages.ingest.masks import publish_given_masks, refine_masks
from stages.ingest.same_person import KnownPerson, still_camera
from stages.ingest.video import Clip

if TYPE_CHECKING:
    from pipeline.run.stage import Context

LEAST_FRAMES = 2


@dataclasses.dataclass(frozen=True)
class Ingested:
    """An ingested shot, whose frames and masks are on disk.

    Attributes:
        detected: of the kept frames.
        cameras: frame number -> camera.
        camera_record: for ``footage.json``.
        names: the sources of keypoints and masks.
        poses: of the kept frames, or None.
        timings: seconds, by step.
    """

    detected: DetectedClip
    cameras: Mapping[int, Camera]
    camera_record: Mapping[str, Any]
    names: Mapping[str, str]
    poses: InitialPoses | None
    timings: Mapping[str, float]


def ingest_shot(
    context: Context,
    shot: Shot,
    layout: str,
    span: range | None = None,
    least: int = LEAST_FRAMES,
    known: KnownPerson | None = None,
) -> Ingested:
    """Write frames and masks of a shot, and find its keypoints and cameras.

    Args:
        context: the stage's.
        shot: the footage and what came with it.
        layout: the dataset's.
        span: the frame numbers that are this shot's, where there are several.
        least: the fewest frames with a person.
        known: the person, as the first camera of the rig saw them.

    Raises:
        UserError: the footage, or what came with it, cannot be used; names the file and the remedy.
    """
    settings, output, clip = context.settings, context.output, shot.clip
    sources = open_sources(context, shot, layout, span)
    calibration = open_calibration(settings.cameras, settings.camera_name, clip)
    if settings.cameras == "auto":
        calibration = shot.calibration
    raw_masks = context.work / "raw_masks"
    shutil.rmtree(raw_masks, ignore_errors=True)
    raw_masks.mkdir(parents=True)

    started = time.perf_counter()
    camera, choose = still_camera(calibration), None
    if known is not None:
        choose = functools.partial(known.among, camera=camera, first=clip.first)
    detected = detect(context, clip, sources, raw_masks, choose)
    check_enough(clip, detected, least)
    seen = time.perf_counter()
    if sources.masks is None:
        refine_masks(context, detected.keypoints, raw_masks)
    else:
        publish_given_masks(context, detected.keypoints.frames.tolist(), raw_masks)
    timings = {"detect_seconds": seen - started, "mask_seconds": time.perf_counter() - seen}
    shutil.rmtree(raw_masks)

    chosen = choose_cameras(context, clip, detected, calibration, shot.poses)
    detected = apply_cameras(output, detected, chosen)
    check_enough(clip, detected, least)
    frames = detected.keypoints.frames.tolist()
    began = time.perf_counter()
    write_foreground(output, frames, settings.background)
    timings["foreground_seconds"] = time.perf_counter() - began
    poses = None if shot.poses is None else on_frames(shot.poses, frames)
    cameras = {frame: chosen.cameras[frame] for frame in frames}
    return Ingested(detected, cameras, chosen.record, sources.names, poses, timings)


def apply_cameras(output: Path, detected: DetectedClip, chosen: ClipCameras) -> DetectedClip:
    """The clip that fits its cameras: frames without one are removed and counted, distortion is taken out.

    Frames and masks are changed in place in ``output``.
    """
    frames = detected.keypoints.frames.tolist()
    rows = [row for row, frame in enumerate(frames) if frame in chosen.cameras]
    for frame in set(frames) - chosen.cameras.keys():
        for folder in ("frames", "masks"):
            (output / folder / f"{frame:06d}.png").unlink()
    dropped = dict(detected.dropped)
    if len(rows) < len(frames):
        dropped["no camera"] = len(frames) - len(rows)
    keypoints = detected.keypoints.select(np.array(rows, int))
    if chosen.lenses:
        keypoints = undistort_frames(output, chosen.lenses, keypoints)
    seconds = tuple(detected.seconds[row] for row in rows)
    dropped = dict(sorted(dropped.items()))
    return dataclasses.replace(detected, keypoints=keypoints, seconds=seconds, dropped=dropped)


def check_enough(clip: Clip, detected: DetectedClip, least: int) -> None:
    """UserError where too few frames were read, or too few hold a person."""
    kept, read = len(detected.keypoints.frames), detected.read
    if read < least:
        raise UserError(f"{clip.path} gave {read} frame: an avatar needs a clip of at least {least}")
    if kept < least:
        seen = f"a person in {kept} of {read} frames only" if kept else f"no person in any of {read} frames"
        raise UserError(
            f"{clip.path} shows {seen}{drop_reasons(detected.dropped)}: "
            "give a clip in which one person is seen clearly"
        )


def drop_reasons(dropped: Mapping[str, int]) -> str:
    """The reasons why frames were dropped, in brackets; empty where none was."""
    return f" ({', '.join(f'{reason}: {count}' for reason, count in dropped.items())})" if dropped else ""


def ingest_recording(context: Context, recording: Recording) -> Ingested:
    """All shots of a recording as one clip; their frame numbers follow one another."""
    layout = recording.layout
    if len(recording.shots) == 1:
        return ingest_shot(context, recording.shots[0], layout)
    parts: list[Ingested] = []
    known = None
    for place, shot in enumerate(recording.shots):
        span, least = range(place * SHOT_STEP, (place + 1) * SHOT_STEP), 1 if place else LEAST_FRAMES
        parts.append(ingest_shot(context, shot, layout, span, least, known))
        subject = parts[0].detected.subject
        if subject is not None:
            begin = recording.shots[0]
            known = KnownPerson(subject, still_camera(begin.calibration), begin.clip.first)
    first = parts[0]
    clips = [part.detected for part in parts]
    detected = dataclasses.replace(
        first.detected,
        keypoints=Keypoints.concatenate([clip.keypoints for clip in clips]),
        seconds=tuple(second for clip in clips for second in clip.seconds),
        read=sum(clip.read for clip in clips),
        dropped=dict(sorted(sum((Counter(clip.dropped) for clip in clips), Counter()).items())),
        people=max(clip.people for clip in clips),
    )
    cameras = {frame: camera for part in parts for frame, camera in part.cameras.items()}
    timings = {name: sum(part.timings[name] for part in parts) for name in first.timings}
    record = {**first.camera_record, "shots": len(parts)}
    poses = join_poses([part.poses for part in parts])
    return Ingested(detected, cameras, record, first.names, poses, timings)
