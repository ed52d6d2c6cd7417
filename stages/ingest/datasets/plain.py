"""Any video, any folder of pictures: nothing comes with it."""

from __future__ import annotations

from pathlib import Path

from stages.ingest.datasets.recording import Recording, Shot
from stages.ingest.settings import IngestSettings
from stages.ingest.video import open_clip


def recognises(folder: Path) -> bool:
    """Never: it is what is left."""
    return False


def read(source: Path, settings: IngestSettings) -> Recording:
    """The clip and nothing else."""
    return Recording("plain", (Shot(open_clip(source)),))
