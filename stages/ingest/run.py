"""The ingest stage: footage in; frames, masks, cameras, keypoints and the split out.

Three passes over the clip, none of which keeps it in memory: the people in it, the detections of the chosen
person in each frame, and the masks, which are averaged over a few frames. What a dataset brings (see
``datasets``) takes the place of what would be estimated.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.clip.keypoints import write_keypoints
from pipeline.clip.records import Footage, write_cameras, write_footage, write_split
from pipeline.errors import UserError
from pipeline.pose_files import INITIAL_POSES, write_initial_poses
from stages.ingest.datasets import Recording, open_recording
from stages.ingest.mannequin.footage import run_mannequin
from stages.ingest.preview import write_preview
from stages.ingest.shots import Ingested, drop_reasons, ingest_recording
from stages.ingest.split import split_recording

if TYPE_CHECKING:
    from pipeline.run.stage import Context


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
    recording = open_recording(context.source, settings)
    if recording.layout != "plain":
        context.log(describe_layout(recording))
    for shot in recording.shots:
        for note in shot.clip.notes:
            context.log(f"{shot.clip.path.name}: {note}")
    for folder in ("frames", "masks"):
        (output / folder).mkdir(parents=True)
    found = ingest_recording(context, recording)
    for name, seconds in found.timings.items():
        context.timing(name, round(seconds, 2))

    detected = found.detected
    frames = tuple(int(frame) for frame in detected.keypoints.frames)
    split = split_recording(recording, frames, settings.test_fraction, settings.test_frames)
    write_cameras(output / "cameras.parquet", found.cameras)
    write_keypoints(output / "keypoints.parquet", detected.keypoints)
    write_split(output / "split.json", split)
    whole = settings.stride == 1 and not settings.max_frames
    write_footage(output / "footage.json", describe(recording, found, whole))
    if found.poses is not None:
        write_initial_poses(output / INITIAL_POSES, found.poses)
    write_preview(output, detected.keypoints)
    context.log(
        f"{len(frames)} of {detected.read} frames of {detected.width}x{detected.height} kept, "
        f"{len(split.test)} of them held out{drop_reasons(detected.dropped)}"
    )


def describe_layout(recording: Recording) -> str:
    """The log's line on a dataset's layout and what it brings."""
    shot = recording.shots[0]
    parts = {
        "cameras": shot.calibration, "masks": shot.masks, "keypoints": shot.keypoints, "poses": shot.poses,
        "a split": recording.test,
    }  # fmt: skip
    brought = [name for name, value in parts.items() if value is not None]
    shots = f"{len(recording.shots)} cameras, " if len(recording.shots) > 1 else ""
    notes = "".join(f"; {note}" for note in recording.notes)
    return f"layout {recording.layout}: {shots}brings {', '.join(brought) or 'footage alone'}{notes}"


def describe(recording: Recording, found: Ingested, whole: bool) -> Footage:
    """The content of ``footage.json``; ``whole``: whether every frame was looked at."""
    clip, detected = recording.shots[0].clip, found.detected
    pictures = {frame: file for shot in recording.shots for frame, file in shot.clip.pictures.items()}
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
        sources=dict(found.names),
        camera=found.camera_record,
        total=len(pictures) or (detected.read if whole else clip.expected),
        names={str(frame): file.name for frame, file in sorted(pictures.items())},
        stills=detected.stills,
    )
