"""evaluate: numbers, pictures and the report of a finished avatar."""

from pipeline.run.stage import Stage
from stages.evaluate.settings import EvaluateSettings

STAGE = Stage(
    name="evaluate",
    version=7,
    settings=EvaluateSettings,
    run="stages.evaluate.run:run",
    needs={
        "ingest": (
            "frames/*",
            "masks/*",
            "foreground/*",
            "cameras.parquet",
            "keypoints.parquet",
            "split.json",
            "footage.json",
            # Of a mannequin alone: other cameras' pictures, and the surface that was really filmed.
            "views/*",
            "truth_poses.parquet",
            "truth_surface.safetensors",
        ),
        "fit": (
            "identity.safetensors",
            "poses.parquet",
            "fit_quality.parquet",
            "curve.parquet",
            "residuals.parquet",
            "overlay.mp4",
            "overlay.png",
        ),
        "plan": ("plan.json",),
        "train": (
            "avatar.safetensors",
            "curve.parquet",
            "visibility.parquet",
            "gate.json",
            "visibility.png",
            "poses.parquet",
        ),
    },
    assets=lambda settings: settings.assets,
    reads_body=True,
    path_settings=("second_mask", "arcface"),
    path_words=("", "off", "edge", "estimator", "independent"),
)
