"""Footage in; frames, masks, cameras, 2D keypoints and the split out."""

from pipeline.stage import Stage
from stages.ingest.settings import IngestSettings

STAGE = Stage(
    name="ingest",
    version=1,
    settings=IngestSettings,
    run="stages.ingest.run:run",
    assets=("mediapipe",),
    reads_source=True,
)
