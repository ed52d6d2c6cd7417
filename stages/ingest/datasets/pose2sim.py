"""Pose2Sim: several calibrated cameras that stand still.

::

    videos/cam01.mp4, cam02.mp4, ...
    calibration/Calib*.toml or *.qca.txt    as many cameras, in the order of the videos' names

Source: the demo of the pose2sim package; the conversions are those of ``cameras.rig``: the world's Z axis
points up there and Y here, Qualisys counts millimetres and 64ths of a pixel, and OpenCV half a pixel less.
``ingest.camera_name`` says which video is learnt from, by its name without suffix (the first if nothing is
said), and ``ingest.test_cameras`` which ones are held out (``others``: all the rest). Cameras are numbered
in the order of names where the calibration's own names differ from the videos'.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

from pipeline.clip.records import SHOT_STEP
from pipeline.config.choices import VIDEOS
from pipeline.config.settings import near
from pipeline.errors import UserError
from stages.ingest.cameras.rig import camera_names, read_rig
from stages.ingest.datasets.recording import Recording, Shot
from stages.ingest.settings import IngestSettings
from stages.ingest.video import open_clip

_REMEDY = "give a folder with videos/ and calibration/"


def recognises(folder: Path) -> bool:
    """Videos and a calibration."""
    return (folder / "videos").is_dir() and (folder / "calibration").is_dir()


def read(source: Path, settings: IngestSettings) -> Recording:
    """Read a rig's folder; UserError where a file of it is malformed."""
    videos = sorted(file for file in (source / "videos").glob("*") if file.suffix.lower() in VIDEOS)
    if not videos:
        raise UserError(f"{source / 'videos'} holds no video: {_REMEDY}")
    by_name = {video.stem: video for video in videos}
    train = settings.camera_name or videos[0].stem
    wanted = settings.test_cameras
    test = [name for name in by_name if name != train] if wanted == ("others",) else list(wanted)
    for name in (train, *test):
        if name not in by_name:
            raise UserError(f"{source} has no camera '{name}'{near(name, by_name)}: set ingest.camera_name")
    path = calibration_file(source / "calibration")
    names = camera_names(path)
    if len(names) != len(videos):
        raise UserError(
            f"{path} has {len(names)} cameras, {source / 'videos'} {len(videos)} videos: {_REMEDY}"
        )
    own = dict(zip(by_name, names, strict=True)) if set(names) != set(by_name) else {n: n for n in names}
    shots = [
        Shot(
            dataclasses.replace(open_clip(by_name[name]), first=place * SHOT_STEP), read_rig(path, own[name])
        )
        for place, name in enumerate((train, *(name for name in test if name != train)))
    ]
    if len(shots) == 1:
        return Recording("pose2sim", tuple(shots))
    # How many frames a video has is known once it has been read: what is numbered from STEP is held out.
    held = frozenset(range(SHOT_STEP, len(shots) * SHOT_STEP))
    return Recording("pose2sim", tuple(shots), frozenset(range(SHOT_STEP)), held)


def calibration_file(folder: Path) -> Path:
    """The rig's calibration; UserError where there is none, or are several."""
    tomls = [file for file in sorted(folder.glob("*.toml")) if "alib" in file.name]
    found = tomls or sorted(folder.glob("*.qca.txt"))
    if len(found) != 1:
        raise UserError(f"{folder} holds {len(found)} calibrations (Calib*.toml, *.qca.txt): keep one")
    return found[0]
