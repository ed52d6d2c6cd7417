"""animate: the avatar in a motion that was never filmed, or turned once, as video, OpenEXR or splats."""

from pipeline.errors import UserError
from pipeline.run.stage import Loan, Stage
from stages.animate.motions.source import SUBJECT_FILES, motion_source
from stages.animate.settings import AnimateSettings


def loans(settings: AnimateSettings) -> tuple[Loan, ...]:
    """The files of the subject whose clip is the motion, or of the clip as a subject of its own."""
    try:
        motion = motion_source(settings.motion)
    except UserError:  # the file was there when the settings were read
        return ()
    if not motion.subject:
        return ()
    return tuple(Loan(motion.subject, stage, files, motion.path) for stage, files in SUBJECT_FILES.items())


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
