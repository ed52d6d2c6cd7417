"""fit: the body model registered to the clip's keypoints, wherever there are any (Section 3.1)."""

from pipeline.run.stage import Stage
from stages.fit.settings import FitSettings

STAGE = Stage(
    name="fit",
    version=8,
    settings=FitSettings,
    run="stages.fit.run:run",
    needs={
        "ingest": (
            "keypoints.parquet",
            "cameras.parquet",
            "footage.json",
            "initial_poses.safetensors",
            "frames/*",
            "masks/*",
        )
    },  # fmt: skip
    reads_body=True,
    path_settings=("pose_init", "face_init", "flame_model"),
)
