"""The ingest stage: footage in; frames, masks, cameras, keypoints and the split out.

Three passes over the clip, none of which keeps it in memory: who is in it, what is seen of the chosen
person in each frame, and the masks, which look a few frames back and ahead.
"""

from __future__ import annotations

import shutil
import time
from typing import TYPE_CHECKING

from pipeline.errors import UserError
from pipeline.keypoints import write_keypoints
from pipeline.records import Footage, write_cameras, write_footage, write_split
from stages.ingest.cameras.apply import apply_cameras
from stages.ingest.cameras.calibration import open_calibration
from stages.ingest.cameras.choose import Chosen, choose_cameras
from stages.ingest.detect import Detected, detect
from stages.ingest.mannequin.publish import run_mannequin
from stages.ingest.masks import copy_masks, refine_masks
from stages.ingest.preview import write_preview
from stages.ingest.sources import open_sources
from stages.ingest.split import split_frames
from stages.ingest.video import Clip, open_clip

if TYPE_CHECKING:
    from pipeline.stage import Context

LEAST_FRAMES = 2


def run(context: Context) -> None:
    """Ingest the footage at ``context.source``.

    Raises:
        UserError: the footage, or what came with it, cannot be used; names the file and the remedy.
    """
    if context.settings.mannequin:
        run_mannequin(context)
        return
    if context.source is None:
        raise UserError(f"subject {context.subject} names no footage: add source=CLIP.mp4 to the command")
    settings, output = context.settings, context.output
    clip = open_clip(context.source)
    sources = open_sources(context)
    calibration = open_calibration(settings.cameras, settings.camera_name, clip)
    raw_masks = context.work / "raw_masks"
    shutil.rmtree(raw_masks, ignore_errors=True)
    for folder in (raw_masks, output / "frames", output / "masks"):
        folder.mkdir(parents=True)

    started = time.perf_counter()
    detected = detect(context, clip, sources, raw_masks)
    context.timing("detect_seconds", round(time.perf_counter() - started, 2))
    check_enough(clip, detected)

    started = time.perf_counter()
    if sources.masks is None:
        refine_masks(context, detected.keypoints, raw_masks)
    else:
        copy_masks(context, detected.keypoints.frames.tolist(), raw_masks)
    context.timing("mask_seconds", round(time.perf_counter() - started, 2))

    chosen = choose_cameras(context, clip, detected, calibration)
    detected = apply_cameras(output, detected, chosen.cameras, chosen.lenses)
    check_enough(clip, detected)
    frames = tuple(int(frame) for frame in detected.keypoints.frames)
    split = split_frames(frames, settings.test_fraction, settings.test_frames)
    write_cameras(output / "cameras.parquet", {frame: chosen.cameras[frame] for frame in frames})
    write_keypoints(output / "keypoints.parquet", detected.keypoints)
    write_split(output / "split.json", split)
    write_footage(output / "footage.json", describe(context, clip, detected, chosen))
    write_preview(output / "preview.png", output / "frames", output / "masks", detected.keypoints)
    shutil.rmtree(raw_masks)
    context.log(
        f"{len(frames)} of {detected.read} frames of {detected.width}x{detected.height} kept, "
        f"{len(split.test)} of them held out{_because(detected.dropped)}"
    )


def check_enough(clip: Clip, detected: Detected) -> None:
    """UserError where too few frames were read, or too few hold a person."""
    kept, read = len(detected.keypoints.frames), detected.read
    if read < LEAST_FRAMES:
        raise UserError(f"{clip.path} gave {read} frame: an avatar needs a clip of at least {LEAST_FRAMES}")
    if kept < LEAST_FRAMES:
        seen = f"a person in {kept} of {read} frames only" if kept else f"no person in any of {read} frames"
        raise UserError(
            f"{clip.path} shows {seen}{_because(detected.dropped)}: "
            "give a clip in which one person is seen clearly"
        )


def describe(context: Context, clip: Clip, detected: Detected, chosen: Chosen) -> Footage:
    """The content of ``footage.json``."""
    return Footage(
        name=clip.path.name,
        width=clip.width,
        height=clip.height,
        fps=clip.fps,
        scale=detected.scale,
        read=detected.read,
        kept=len(detected.keypoints.frames),
        dropped=detected.dropped,
        people=detected.people,
        seconds=tuple(round(seconds, 6) for seconds in detected.seconds),
        sources={"keypoints": context.settings.keypoints, "masks": context.settings.masks},
        camera=chosen.record,
    )


def _because(dropped: dict[str, int]) -> str:
    return f" ({', '.join(f'{reason}: {count}' for reason, count in dropped.items())})" if dropped else ""
