"""animate: the avatar in a motion that was never filmed, or turned once, as video, OpenEXR or splats."""

from pipeline.run.stage import Loan, Stage
from stages.animate.motions.source import SUBJECT_FILES, named_subject
from stages.animate.settings import AnimateSettings


def loans(settings: AnimateSettings) -> tuple[Loan, ...]:
    """The files of the subject whose clip is the motion, if it is one."""
    other = named_subject(settings.motion)
    return tuple(Loan(other, stage, files) for stage, files in SUBJECT_FILES.items()) if other else ()


STAGE = Stage(
    name="animate",
    version=3,
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
