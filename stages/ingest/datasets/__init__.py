"""The datasets' layouts on disk, one module each, and the way to open a recording in any of them.

An adapter has two functions: ``recognises(folder)`` is true where a folder has its layout, and
``read(source, settings)`` makes a :class:`Recording` of it: footage, masks, cameras, keypoints, poses and
split, as far as the layout has them. The ingest stage estimates what it lacks. To add a layout, write such a
module and name it in ``settings.Layout``. ``plain``, any video or folder of pictures, needs none.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

from pipeline.config.settings import near
from pipeline.errors import UserError
from stages.ingest.datasets.recording import Recording, Shot
from stages.ingest.settings import LAYOUTS, IngestSettings
from stages.ingest.video import PICTURES, open_clip

__all__ = ["LAYOUTS", "Recording", "Shot", "layout_of", "open_recording"]


def open_recording(source: Path, settings: IngestSettings) -> Recording:
    """Read a source in the layout that the settings name, or that it has.

    Raises:
        UserError: there is nothing, the layout is not known or not found, or a file of it is malformed.
    """
    if not source.exists():
        raise UserError(
            f"{source} does not exist: give a video file, a folder of pictures or a dataset's folder"
        )
    name = layout_of(source) if settings.layout == "auto" else settings.layout
    if name not in LAYOUTS:
        known = ", ".join(LAYOUTS)
        raise UserError(f"ingest.layout={name}: there is no such layout, only {known}{near(name, LAYOUTS)}")
    if name == "plain":
        return Recording("plain", (Shot(open_clip(source)),))
    recording: Recording = _module(name).read(source, settings)
    if len(recording.shots) > 1 and settings.cameras != "auto":
        raise UserError(f"ingest.cameras={settings.cameras} is for one camera; {source} is read with several")
    return recording


def layout_of(source: Path) -> str:
    """The layout of a file or folder: ``plain`` for a video and for pictures that lie in it directly."""
    if source.is_file() or any(file.suffix.lower() in PICTURES for file in source.iterdir()):
        return "plain"
    return next((name for name in LAYOUTS if name != "plain" and _module(name).recognises(source)), "plain")


def _module(name: str) -> ModuleType:
    return importlib.import_module(f"stages.ingest.datasets.{name}")
