"""evaluate: numbers, pictures and the report of a finished avatar."""

from pipeline.stage import Stage
from stages.evaluate.settings import EvaluateSettings

STAGE = Stage(
    name="evaluate",
    version=4,
    settings=EvaluateSettings,
    run="stages.evaluate.run:run",
    needs={
        "ingest": (
            "frames/*",
            "masks/*",
            "cameras.parquet",
            "split.json",
            "footage.json",
        ),
        "fit": ("poses.parquet", "curve.parquet", "overlay.mp4", "overlay.png"),
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
    assets=("lpips",),
    reads_body=True,
)
