"""animate: the avatar in a motion that was never filmed, or turned once, as video, OpenEXR or splats."""

from pipeline.motion.motion_name import borrowed_subject
from pipeline.run.stage import Loan, Stage
from stages.animate.settings import AnimateSettings

# As pipeline.motion.fitted_motion.READ says, which is too heavy to load here; a test compares them.
LENT = {
    "ingest": ("footage.json", "cameras.parquet"),
    "fit": ("identity.safetensors", "poses.parquet"),
}


def loans(settings: AnimateSettings) -> tuple[Loan, ...]:
    """What is read of the subject whose clip is the motion, if it is one."""
    other = borrowed_subject(settings.motion)
    return tuple(Loan(other, stage, files) for stage, files in LENT.items()) if other else ()


STAGE = Stage(
    name="animate",
    version=1,
    settings=AnimateSettings,
    run="stages.animate.run:run",
    needs={
        "ingest": ("cameras.parquet", "split.json"),
        "fit": ("poses.parquet",),
        "train": ("avatar.safetensors",),
    },
    reads_body=True,
    path_settings=("motion",),
    on_request=True,
    words=("motion",),
    loans=loans,
)
