"""plan: which effects this scene calls for, each with the number that decided it."""

from pipeline.run.stage import Stage
from stages.plan.settings import PlanSettings

STAGE = Stage(
    name="plan",
    version=4,
    settings=PlanSettings,
    run="stages.plan.run:run",
    needs={
        "ingest": ("keypoints.parquet", "masks/*", "cameras.parquet", "split.json", "footage.json"),
        "fit": (
            "identity.safetensors",
            "poses.parquet",
            "fit_quality.parquet",
            "residuals.parquet",
            "face.json",
        ),
    },
    reads_body=True,
)
