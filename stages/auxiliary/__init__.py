"""Views the camera never saw: guidance for a generator, and what of its frames is fit to learn from."""

from pipeline.run.stage import Stage
from stages.auxiliary.settings import AuxiliarySettings

STAGE = Stage(
    name="auxiliary",
    version=2,
    settings=AuxiliarySettings,
    run="stages.auxiliary.run:run",
    needs={
        "ingest": ("frames/*", "masks/*", "cameras.parquet", "keypoints.parquet", "split.json"),
        "fit": ("identity.safetensors", "poses.parquet"),
        "plan": ("plan.json",),
    },
    assets=lambda settings: settings.assets,
    reads_body=True,
    path_settings=("folder", "weights"),
)
