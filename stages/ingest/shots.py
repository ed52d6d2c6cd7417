"""One camera's footage seen through, and several put together."""

from __future__ import annotations

import dataclasses
import shutil
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from pipeline.clip.camera import Camera
from pipeline.clip.keypoints import Keypoints
from pipeline.errors import UserError
from pipeline.pose_files import InitialPoses, on_frames
from stages.ingest.cameras.apply import apply_cameras
from stages.ingest.cameras.calibration import open_calibration
from stages.ingest.cameras.choose import choose_cameras
from stages.ingest.datasets import Recording, Shot
from stages.ingest.datasets.recording import STEP
from stages.ingest.detect import Detected, detect
from stages.ingest.masks import copy_masks, refine_masks
from stages.ingest.sources import open_sources
from stages.ingest.video import Clip

if TYPE_CHECKING:
    from pipeline.run.stage import Context

LEAST_FRAMES = 2


@dataclasses.dataclass(frozen=True)
class Ingested:
    """What came of a shot; frames and masks are on disk.

    Attributes:
        detected: of the kept frames.
        cameras: frame number -> camera.
        camera_record: for ``footage.json``.
        names: what keypoints and masks came from.
        poses: of the kept frames, or None.
        timings: seconds by what they went into.
    """

    detected: Detected
    cameras: Mapping[int, Camera]
    camera_record: Mapping[str, Any]
    names: Mapping[str, str]
    poses: InitialPoses | None
    timings: Mapping[str, float]


def ingest_shot(
    context: Context, shot: Shot, layout: str, span: range | None = None, least: int = LEAST_FRAMES
) -> Ingested:
    """See a shot through: keypoints, masks and cameras of its frames.

    Args:
        context: the stage's.
        shot: the footage and what came with it.
        layout: the dataset's.
        span: the frame numbers that are this shot's, where there are several.
        least: how many frames with a person there must be.

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
    detected = detect(context, clip, sources, raw_masks)
    check_enough(clip, detected, least)
    seen = time.perf_counter()
    if sources.masks is None:
        refine_masks(context, detected.keypoints, raw_masks)
    else:
        copy_masks(context, detected.keypoints.frames.tolist(), raw_masks)
    timings = {"detect_seconds": seen - started, "mask_seconds": time.perf_counter() - seen}
    shutil.rmtree(raw_masks)

    chosen = choose_cameras(context, clip, detected, calibration, shot.poses)
    detected = apply_cameras(output, detected, chosen.cameras, chosen.lenses)
    check_enough(clip, detected, least)
    frames = detected.keypoints.frames.tolist()
    poses = None if shot.poses is None else on_frames(shot.poses, frames)
    cameras = {frame: chosen.cameras[frame] for frame in frames}
    return Ingested(detected, cameras, chosen.record, sources.names, poses, timings)


def check_enough(clip: Clip, detected: Detected, least: int) -> None:
    """UserError where too few frames were read, or too few hold a person."""
    kept, read = len(detected.keypoints.frames), detected.read
    if read < least:
        raise UserError(f"{clip.path} gave {read} frame: an avatar needs a clip of at least {least}")
    if kept < least:
        seen = f"a person in {kept} of {read} frames only" if kept else f"no person in any of {read} frames"
        raise UserError(
            f"{clip.path} shows {seen}{because(detected.dropped)}: "
            "give a clip in which one person is seen clearly"
        )


def because(dropped: Mapping[str, int]) -> str:
    """Why frames were dropped, in brackets; empty where none was."""
    return f" ({', '.join(f'{reason}: {count}' for reason, count in dropped.items())})" if dropped else ""


def ingest_recording(context: Context, recording: Recording) -> Ingested:
    """All shots of a recording as one clip; their frame numbers follow one another."""
    layout = recording.layout
    if len(recording.shots) == 1:
        return ingest_shot(context, recording.shots[0], layout)
    parts = [
        ingest_shot(
            context, shot, layout, range(place * STEP, (place + 1) * STEP), 1 if place else LEAST_FRAMES
        )
        for place, shot in enumerate(recording.shots)
    ]
    dropped: Counter[str] = Counter()
    for part in parts:
        dropped.update(part.detected.dropped)
    first = parts[0]
    detected = dataclasses.replace(
        first.detected,
        keypoints=_joined([part.detected.keypoints for part in parts]),
        seconds=tuple(second for part in parts for second in part.detected.seconds),
        read=sum(part.detected.read for part in parts),
        dropped=dict(sorted(dropped.items())),
        people=max(part.detected.people for part in parts),
    )
    cameras = {frame: camera for part in parts for frame, camera in part.cameras.items()}
    timings = {name: sum(part.timings[name] for part in parts) for name in first.timings}
    record = {**first.camera_record, "shots": len(parts)}
    poses = join_poses([part.poses for part in parts])
    return Ingested(detected, cameras, record, first.names, poses, timings)


def _joined(keypoints: Sequence[Keypoints]) -> Keypoints:
    fields = [field.name for field in dataclasses.fields(Keypoints)]
    return Keypoints(**{name: np.concatenate([getattr(one, name) for one in keypoints]) for name in fields})


def join_poses(poses: Sequence[InitialPoses | None]) -> InitialPoses | None:
    """Poses of several shots as one; None where a shot has none."""
    known = [one for one in poses if one is not None]
    if not known or len(known) < len(poses):
        return None
    names = ("rotation", "expression", "transl", "valid", "hand_pca")
    together: dict[str, Any] = {
        name: torch.cat([getattr(one, name) for one in known])
        for name in names
        if all(getattr(one, name) is not None for one in known)
    }
    frames = tuple(frame for one in known for frame in one.frames)
    return dataclasses.replace(known[0], frames=frames, **together)
