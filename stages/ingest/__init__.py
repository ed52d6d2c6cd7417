"""Footage in; frames, masks, cameras, 2D keypoints and the split out."""

import dataclasses

from pipeline.run.stage import Stage
from stages.ingest.settings import IngestSettings


def idle(settings: IngestSettings) -> dict[str, str]:
    """The settings that cannot act beside the others, and what to write."""
    fields = [field.name for field in dataclasses.fields(settings)]
    filming = [name for name in fields if name.startswith("mannequin")]
    if settings.mannequin:
        unused = {"long_side", "stride", "max_frames", "layout", "keypoints", "masks", "poses", "cameras",
                  "camera_name", "test_cameras", "camera_scale", "focal", "numbered_from", "body_score",
                  "mask_area", "estimator_long_side", "estimator_short_side", "pose_model"}  # fmt: skip
        return dict.fromkeys(sorted(unused), "a mannequin is made up and not filmed: see ingest.mannequin_*")
    found = dict.fromkeys(filming[1:], "it is filmed: ingest.mannequin=full, upper or head makes footage up")
    if settings.masks not in ("auto", "mediapipe"):
        remedy = "masks that are given are used as they are: leave out ingest.masks, or this"
        found.update(dict.fromkeys(("mask_edge", "mask_parts", "mask_steadiness", "background"), remedy))
    if not settings.uses_estimator:
        remedy = "keypoints and masks are given, MediaPipe looks at nothing: leave out one of them, or this"
        estimators = ("pose_model", "estimator_long_side", "estimator_short_side")
        found.update(dict.fromkeys(estimators, remedy))
    if settings.test_frames:
        found["test_fraction"] = "ingest.test_frames says how many: leave out one of the two"
    if settings.cameras in ("pinhole", "sfm"):
        found["camera_name"] = f"ingest.cameras={settings.cameras} has no names: name a rig's calibration"
    return found


STAGE = Stage(
    name="ingest",
    version=7,
    settings=IngestSettings,
    run="stages.ingest.run:run",
    assets=lambda settings: settings.assets,
    reads_source=lambda settings: not settings.mannequin,
    reads_body=lambda settings: bool(settings.mannequin),
    path_settings=("keypoints", "masks", "cameras", "mannequin_motion", "poses"),
    path_words=("auto", "pinhole", "sfm", "mediapipe"),
    idle=idle,
)
