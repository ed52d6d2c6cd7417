"""auxiliary: views the camera never saw, from a generator, checked before they are learnt from."""

from pipeline.run.stage import Stage
from stages.auxiliary.settings import AuxiliarySettings

STAGE = Stage(
    name="auxiliary",
    version=4,
    settings=AuxiliarySettings,
    run="stages.auxiliary.run:run",
    needs={
        "ingest": (
            "frames/*",
            "masks/*",
            "foreground/*",
            "cameras.parquet",
            "keypoints.parquet",
            "split.json",
        ),
        "fit": ("identity.safetensors", "poses.parquet", "fit_quality.parquet"),
        "plan": ("plan.json",),
    },
    assets=lambda settings: settings.assets,
    reads_body=True,
    path_settings=("folder", "weights"),
)
