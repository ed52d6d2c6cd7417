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
import re
from collections.abc import Mapping
from pathlib import Path

from pipeline.untrusted import read_numbers
from stages.ingest.cameras.calibration import Calibration
from stages.ingest.cameras.calibration_files import find_model, open_calibration, read_model
from stages.ingest.datasets.exavatar_poses import read_exavatar_poses
from stages.ingest.datasets.recording import Recording, Shot, select_frames
from stages.ingest.settings import IngestSettings
from stages.ingest.video import Clip, folder_clip, numbered_files, open_clip

_REMEDY = "prepare the folder again"
_SIGNS = ("masks", "cam_params", "keypoints_whole_body", "smplx_init", "smplx_optimized", "sparse")


def recognises(folder: Path) -> bool:
    """Frames or a video, and something that was prepared."""
    footage = (folder / "frames").is_dir() or (folder / "video.mp4").is_file()
    return footage and any((folder / name).is_dir() for name in _SIGNS)


def read(source: Path, settings: IngestSettings) -> Recording:
    """Read a subject's folder; UserError where a file of it is malformed."""
    lists = _lists(source)
    clip = _clip(source, lists.get("all"))
    pictures = clip.pictures or None
    shot = Shot(
        clip=clip,
        calibration=_listed(_cameras(source, clip), clip if "all" in lists else None),
        keypoints=_of(numbered_files(source / "keypoints_whole_body", (".json",)), pictures),
        masks=_of(numbered_files(source / "masks"), pictures),
        poses=read_exavatar_poses(source, smoothed=True),
    )
    train, test = lists.get("train"), lists.get("test")
    if train is not None and test is None and source.name.endswith("_gen"):
        return Recording("prepared", (shot,), train, frozenset())
    if train is None or test is None or train & test:
        note = "the test list repeats training frames, so the clip's end is held out"
        return Recording("prepared", (shot,), notes=(note,) if train and test else ())
    return Recording("prepared", (shot,), train, test)


def _lists(source: Path) -> dict[str, frozenset[int]]:
    paths = {name: source / f"frame_list_{name}.txt" for name in ("all", "train", "test")}
    return {name: frozenset(read_numbers(path, _REMEDY)) for name, path in paths.items() if path.is_file()}


def _clip(source: Path, wanted: frozenset[int] | None) -> Clip:
    frames = numbered_files(source / "frames")
    if not frames:
        return open_clip(source / "video.mp4" if (source / "video.mp4").is_file() else source / "frames")
    listed = {frame: file for frame, file in frames.items() if wanted is None or frame in wanted}
    return folder_clip(source / "frames", listed, _rate(source / "video.mp4"))


def _rate(video: Path) -> float:
    return open_clip(video).fps if video.is_file() else 0.0


def _cameras(source: Path, clip: Clip) -> Calibration | None:
    if (source / "sparse").is_dir() and find_model(source / "sparse") is not None:
        return read_model(find_model(source / "sparse") or source)
    if (source / "cam_params").is_dir():
        return open_calibration(str(source / "cam_params"), "", clip)
    return None


def _listed(calibration: Calibration | None, clip: Clip | None) -> Calibration | None:
    """The cameras of the listed frames; without a list all of them."""
    if calibration is None or clip is None or not clip.pictures:
        return calibration
    views = {
        name: view
        for name, view in calibration.views.items()
        if int((re.findall(r"\d+", name) or ["-1"])[-1]) in clip.pictures
    }
    return dataclasses.replace(calibration, views=views or calibration.views)


def _of(files: dict[int, Path], pictures: Mapping[int, Path] | None) -> dict[int, Path] | None:
    """The files of the clip's frames; all of them where a video does not say which it has."""
    return (files or None) if pictures is None else select_frames(files, pictures)
