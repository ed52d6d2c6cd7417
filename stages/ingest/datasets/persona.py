"""PERSONA: a captured clip, generated ones and a test clip of one person.

::

    captured/, test/, generated_0/, generated_1/    each: images/, masks/, cam_params/,
                                                    keypoints_whole_body/, smplx_optimized/smplx_params/,
                                                    frame_idx_list.txt

The source is ``data/subjects/<name>``. Source: PERSONA's release (mks0601/PERSONA_RELEASE). The captured
clip is learnt from and the test clip is held out; without one the captured clip's end is. Generated clips
are another motion's poses painted with this person: they are no footage and are left for the auxiliary
views. Names and conventions are those of ``prepared``.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

from pipeline.clip.frame_files import match_names, number_files
from pipeline.clip.records import SHOT_STEP
from pipeline.errors import UserError
from pipeline.untrusted import read_numbers
from stages.ingest.cameras.calibration import Calibration
from stages.ingest.cameras.calibration_files import open_calibration
from stages.ingest.datasets.exavatar_poses import read_exavatar_poses
from stages.ingest.datasets.prepared import prepared_notes
from stages.ingest.datasets.recording import Recording, Shot, files_of, renumbered
from stages.ingest.settings import IngestSettings
from stages.ingest.video import PICTURES, clip_frames, folder_clip

_REMEDY = "prepare the PERSONA subject again"


def recognises(folder: Path) -> bool:
    """A captured clip."""
    return (folder / "captured" / "images").is_dir()


def read(source: Path, settings: IngestSettings) -> Recording:
    """Read a subject's folder; UserError where a file of it is malformed."""
    if not (source / "captured").is_dir():
        raise UserError(f"{source} has no captured/: {_REMEDY}")
    shots = [_shot(source / "captured", 0)]
    generated = sorted(path.name for path in source.glob("generated_*"))
    notes = prepared_notes(shots[0])
    if generated:
        notes += (f"{', '.join(generated)} are not footage and are left out",)
    if not (source / "test" / "images").is_dir():
        return Recording("persona", tuple(shots), notes=notes)
    shots.append(_shot(source / "test", SHOT_STEP))
    parts = [frozenset(shot.clip.pictures) for shot in shots]
    return Recording("persona", tuple(shots), parts[0], parts[1], notes)


def _shot(folder: Path, first: int) -> Shot:
    """One clip, numbered from ``first``."""
    pictures = number_files(folder / "images", PICTURES)
    whole = folder_clip(folder / "images", pictures)
    listed = folder / "frame_idx_list.txt"
    if listed.is_file():
        wanted = frozenset(read_numbers(listed, _REMEDY))
        pictures = {frame: file for frame, file in pictures.items() if frame in wanted}
    new = {frame: first + frame for frame in pictures}
    clip = folder_clip(folder / "images", {new[frame]: file for frame, file in pictures.items()}, 30.0)

    def of(name: str, suffixes: tuple[str, ...] = PICTURES) -> dict[int, Path] | None:
        files = files_of(folder / name, whole, suffixes) or {}
        return {new[frame]: file for frame, file in files.items() if frame in new} or None

    calibration: Calibration | None = None
    if (folder / "cam_params").is_dir():
        given = open_calibration(str(folder / "cam_params"), "", clip)
        assert given is not None  # a path gives one
        frames = match_names(given.views, clip_frames(whole), given.path).frames
        views = {str(new[frame]): given.views[n] for n, frame in frames.items() if frame in new}
        calibration = dataclasses.replace(given, views=views, by_frame=True)
    poses = renumbered(read_exavatar_poses(folder, clip_frames(whole), smoothed=False), new)
    return Shot(
        clip,
        calibration,
        of("keypoints_whole_body", (".json",)),
        of("masks"),
        poses=poses,
    )
