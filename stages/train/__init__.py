"""Training: frames, masks, cameras and poses to an animatable avatar (paper, Sections 3.3 to 3.6)."""

from pipeline.run.stage import Stage
from stages.train.settings import TrainSettings

STAGE = Stage(
    name="train",
    version=10,
    settings=TrainSettings,
    run="stages.train.run:run",
    needs={
        "ingest": ("frames/*", "masks/*", "foreground/*", "cameras.parquet", "split.json", "footage.json"),
        "fit": ("identity.safetensors", "poses.parquet", "fit_quality.parquet"),
        "plan": ("plan.json",),
        "auxiliary": (
            "frames/*",
            "masks/*",
            "trust/*",
            "cameras.parquet",
            "poses.parquet",
            "auxiliary.json",
        ),
    },
    assets=lambda settings: ("lpips",) if settings.lpips else (),
    reads_body=True,
    compile_ahead=lambda settings: (
        "" if settings.device == "cuda" else f"stages.train.compile_ahead:compile_{settings.representation}"
    ),
)
