"""fit: the body model registered to the clip's keypoints, wherever there are any (Section 3.1)."""

from pipeline.run.stage import Stage
from stages.fit.settings import FitSettings

_FITTING = (
    "iterations", "learning_rate", "smoothing_seconds", "lambda_silhouette", "lambda_lids", "lambda_gaze",
)  # fmt: skip


def idle(settings: FitSettings) -> dict[str, str]:
    """The settings that cannot act beside the others, and what to write."""
    found = {}
    if not settings.pose_init and not settings.face_init:
        found["numbered_from"] = "no folder is given: name one as fit.pose_init or fit.face_init"
    if settings.pose_init and settings.given == "ignore":
        found["given"] = "fit.pose_init is started from: leave out one of the two"
    if settings.given == "keep":
        remedy = "poses that are kept are not fitted: leave out fit.given=keep"
        found.update(dict.fromkeys((*_FITTING, "face"), remedy))
    if not settings.flame_fit or settings.face != "flame":
        found["lambda_flame_init"] = "FLAME is not fitted: set fit.face=flame and fit.flame_fit=true"
    if settings.face != "flame":
        found["flame_fit"] = "there is no FLAME to fit: set fit.face=flame and fit.flame_model"
    if not settings.iterations:
        remedy = "no step is taken: raise fit.iterations"
        found.update(dict.fromkeys(("learning_rate", "lambda_silhouette"), remedy))
    return found


STAGE = Stage(
    name="fit",
    version=10,
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
    idle=idle,
)
