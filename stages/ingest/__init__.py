"""Footage in; frames, masks, cameras, 2D keypoints and the split out."""

from pipeline.run.stage import Stage
from stages.ingest.settings import IngestSettings

STAGE = Stage(
    name="ingest",
    version=4,
    settings=IngestSettings,
    run="stages.ingest.run:run",
    assets=lambda settings: ("mediapipe",) if settings.uses_estimator else (),
    reads_source=lambda settings: not settings.mannequin,
    reads_body=lambda settings: bool(settings.mannequin),
    path_settings=("keypoints", "masks", "cameras", "mannequin_motion", "poses"),
    path_words=("auto", "pinhole", "sfm", "mediapipe"),
)
