"""Folders that ExAvatar or FlexiAvatar prepared: Custom, TalkShow and ZJU in their naming, and ``_gen``.

::

    frames/12.png or video.mp4       no zero padding; a video's frames are counted from 0
    masks/12.png                     above one half is the person
    cam_params/12.json               {R, t, focal, princpt}, or sparse/ from COLMAP (names image12.jpg)
    keypoints_whole_body/12.json     133 [x, y, score], pixels
    smplx_init/, smplx_optimized/    see ``exavatar_poses``
    frame_list_{all,train,test}.txt  a number a line

Source: the releases of ExAvatar (mks0601/ExAvatar_RELEASE) and FlexiAvatar (yihalem1/FlexiAvatar_Release).
FlexiAvatar's make_frame_list.py writes the same numbers into all three lists: a test list that is the
training list holds nothing out, and then the clip's end is. A ``_gen`` folder (generated views) has a
training list only; its frames are all learnt from. No conversion is needed but that of the poses, which
``exavatar_poses`` states.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

from pipeline.clip.frame_files import match_names, number_files
from pipeline.untrusted import read_numbers
from stages.ingest.cameras.calibration import Calibration
from stages.ingest.cameras.calibration_files import find_model, open_calibration, read_model
from stages.ingest.datasets.exavatar_poses import read_exavatar_poses
from stages.ingest.datasets.recording import Recording, Shot, files_of, lacking
from stages.ingest.settings import IngestSettings
from stages.ingest.video import PICTURES, Clip, clip_frames, folder_clip, open_clip

_REMEDY = "prepare the folder again"
_SIGNS = ("masks", "cam_params", "keypoints_whole_body", "smplx_init", "smplx_optimized", "sparse")


def recognises(folder: Path) -> bool:
    """Frames or a video, and something that was prepared."""
    footage = (folder / "frames").is_dir() or (folder / "video.mp4").is_file()
    return footage and any((folder / name).is_dir() for name in _SIGNS)


def read(source: Path, settings: IngestSettings) -> Recording:
    """Read a subject's folder; UserError where a file of it is malformed."""
    lists = _lists(source)
    whole = _clip(source)
    clip = whole
    if "all" in lists and whole.pictures:
        listed = {frame: file for frame, file in whole.pictures.items() if frame in lists["all"]}
        clip = folder_clip(whole.path, listed, whole.fps)
    shot = Shot(
        clip=clip,
        calibration=_listed(_cameras(source, clip), whole, clip),
        keypoints=_files_of(source / "keypoints_whole_body", whole, clip, (".json",)),
        masks=_files_of(source / "masks", whole, clip),
        poses=read_exavatar_poses(source, clip_frames(whole), smoothed=True),
    )
    notes = prepared_notes(shot)
    train, test = lists.get("train"), lists.get("test")
    if train is not None and test is None and source.name.endswith("_gen"):
        return Recording("prepared", (shot,), train, frozenset(), notes)
    if train is None or test is None or train & test:
        note = "the test list repeats training frames, so the clip's end is held out"
        return Recording("prepared", (shot,), notes=(*notes, note) if train and test else notes)
    return Recording("prepared", (shot,), train, test, notes)


def prepared_notes(shot: Shot) -> tuple[str, ...]:
    """What a prepared clip promises and does not have, a line each."""
    frames = shot.clip.expected
    poses = 0 if shot.poses is None else len(shot.poses.frames)
    notes = (
        lacking("masks", len(shot.masks or ()), frames, "masks/"),
        lacking("keypoints", len(shot.keypoints or ()), frames, "keypoints_whole_body/"),
        lacking("poses", poses, frames, "smplx_optimized/ and smplx_init/"),
        "" if shot.calibration else "no cameras in sparse/ and cam_params/",
    )
    return tuple(note for note in notes if note)


def _lists(source: Path) -> dict[str, frozenset[int]]:
    paths = {name: source / f"frame_list_{name}.txt" for name in ("all", "train", "test")}
    return {name: frozenset(read_numbers(path, _REMEDY)) for name, path in paths.items() if path.is_file()}


def _clip(source: Path) -> Clip:
    frames = number_files(source / "frames", PICTURES)
    if not frames:
        return open_clip(source / "video.mp4" if (source / "video.mp4").is_file() else source / "frames")
    return folder_clip(source / "frames", frames, _rate(source / "video.mp4"))


def _rate(video: Path) -> float:
    return open_clip(video).fps if video.is_file() else 0.0


def _cameras(source: Path, clip: Clip) -> Calibration | None:
    if (source / "sparse").is_dir() and find_model(source / "sparse") is not None:
        return read_model(find_model(source / "sparse") or source)
    if (source / "cam_params").is_dir():
        return open_calibration(str(source / "cam_params"), "", clip)
    return None


def _listed(calibration: Calibration | None, whole: Clip, clip: Clip) -> Calibration | None:
    """The cameras of the listed frames; without a list all of them."""
    if calibration is None or clip is whole:
        return calibration
    frames = match_names(calibration.views, clip_frames(whole), calibration.path).frames
    views = {name: calibration.views[name] for name, frame in frames.items() if frame in clip.pictures}
    return dataclasses.replace(calibration, views=views or calibration.views)


def _files_of(
    folder: Path, whole: Clip, clip: Clip, suffixes: tuple[str, ...] = PICTURES
) -> dict[int, Path] | None:
    """The files of the listed frames; all of them where a video does not say which it has."""
    files = files_of(folder, whole, suffixes) or {}
    return {
        frame: file for frame, file in files.items() if not clip.pictures or frame in clip.pictures
    } or None
