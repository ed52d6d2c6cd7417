"""The settings of the ingest stage."""

from __future__ import annotations

from typing import Annotated, Literal, get_args

from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from pipeline.config.settings import (
    SETTINGS,
    Count,
    CountOrNone,
    Fraction,
    FrameRate,
    NotEmpty,
    Seed,
    Side,
    setting,
)  # fmt: skip
from stages.ingest.mannequin.spec import Detector, FrameCount, Framing, Noise, UnseenView, check_motion

Layout = Literal[
    "zju", "wildavatar", "insta", "xhumans", "persona", "pose2sim", "neuman", "prepared", "talkshow", "plain"
]  # fmt: skip
LAYOUTS: tuple[Layout, ...] = get_args(Layout)
"""The layouts of ``stages/ingest/datasets``, in the order in which a folder is tried."""

HEAVY = "pose_heavy"
"""The asset that holds MediaPipe's heavy pose model."""

TestFraction = Annotated[float, Field(ge=0, le=0.9)]
FirstNumber = Annotated[int, Field(ge=-1, le=1_000_000_000)]
Focal = Annotated[float, Field(ge=0.1, le=100)]
UnitScale = Annotated[float, Field(ge=0, le=1e6)]
EstimatorSide = Annotated[int, Field(ge=128, le=8192)]
Steadiness = Annotated[int, Field(ge=0, le=20)]


@dataclass(frozen=True, config=SETTINGS)
class IngestSettings:
    """Settings of the ingest stage."""

    long_side: Side = setting(512, "pixels; larger footage is stored at this size, smaller footage as it is")
    stride: Count = setting(1, "every stride-th frame is looked at")
    max_frames: CountOrNone = setting(0, "how many frames are looked at, 0 for all")
    damaged: Literal["refuse", "skip"] = setting(
        "refuse", "footage that is cut off or damaged: refuse it, or skip the frames that are not whole"
    )
    layout: Literal["auto", Layout] = setting("auto", "how the source lies on disk: plain, or a dataset's")
    keypoints: NotEmpty = setting(
        "auto", "auto: the dataset's, else mediapipe; or a folder of mmpose/DWPose JSON, one a frame"
    )
    masks: NotEmpty = setting(
        "auto", "auto: the dataset's, else mediapipe; or a folder of grey pictures, white where the person is"
    )
    numbered_from: FirstNumber = setting(
        -1, "the first frame's number in the names of files that are not named as the frames; -1: as they say"
    )
    poses: str = setting("", "file of poses to start from that lies elsewhere than the footage: SHOW's .pkl")
    person: CountOrNone = setting(
        0, "which person is kept, counted from 1 as the log lists them; 0: who fills most of it and moves"
    )
    shot: CountOrNone = setting(0, "which shot of a clip with cuts is taken, counted from 1; 0: the longest")
    test_fraction: TestFraction = setting(
        0.1, "the part of the kept frames, at the clip's end, that is held out"
    )
    test_frames: CountOrNone = setting(
        0, "how many of the last frames are held out, in place of test_fraction"
    )
    focal: Focal = setting(1.2, "the camera's focal length over the longer side of the picture")
    cameras: NotEmpty = setting(
        "auto", "auto, pinhole, sfm, a COLMAP model, a calibration file, a folder of cam_params"
    )
    camera_name: str = setting("", "which camera of a calibrated rig filmed the clip")
    test_cameras: tuple[str, ...] = setting(
        (), "further cameras of a rig that are held out; others: all the rest"
    )
    camera_scale: UnitScale = setting(
        0.0, "metres a unit of cameras without a scale; 0 finds it from the person"
    )
    pose_model: Literal["full", "heavy"] = setting(
        "full", "MediaPipe's model of the body: full, or heavy, which takes half as long again"
    )
    estimator_long_side: EstimatorSide = setting(
        1920, "larger pictures are reduced to this for the estimator"
    )
    estimator_short_side: Side = setting(
        400, "smaller pictures are enlarged towards this, at most three times"
    )
    body_score: Fraction = setting(
        0.3, "a frame whose best body points score less on average holds no person"
    )
    mask_area: Fraction = setting(0.002, "a frame whose mask covers less of the picture holds no person")
    mask_edge: Fraction = setting(1.0, "how far the mask follows the picture's own edges")
    mask_parts: bool = setting(
        False, "complete hands and feet that the detector saw and the mask lost, by their colours"
    )
    mask_steadiness: Steadiness = setting(
        2, "frames on either side that a mask is averaged with along the motion"
    )
    background: bool = setting(
        True, "learn the background where it stands still, and take it out of the masks"
    )
    mannequin: Literal["", Framing] = setting(
        "", "film the open body with known truth instead of footage: whole, from the waist, or the head"
    )
    mannequin_motion: str = setting(
        "", "names of its motions joined by '+', or a BVH file; empty for what suits"
    )
    mannequin_frames: FrameCount = setting(60, "how many frames are filmed")
    mannequin_size: Side = setting(256, "pixels, both sides of the picture")
    mannequin_fps: FrameRate = setting(25.0, "frames a second")
    mannequin_seed: Seed = setting(0, "of the motion, the detector's errors and the picture's grain")
    mannequin_identity: Seed = setting(0, "seed of shape, clothes, hair and colours")
    mannequin_detector: Detector = setting("mediapipe", "whose errors the keypoints have")
    mannequin_noise: Noise = setting(1.0, "the detector's error on seen points, 1 for a good detector")
    mannequin_hand_failures: Fraction = setting(
        0.03, "the part of frames in which a hand's detection begins to fail"
    )
    mannequin_views: tuple[UnseenView, ...] = setting((), "unseen cameras that are filmed too")
    mannequin_view_stride: Count = setting(10, "every how many frames they are filmed")

    @model_validator(mode="after")
    def _fit_together(self) -> IngestSettings:
        if self.mannequin:
            check_motion(self.mannequin_motion)
        return self

    @property
    def first_number(self) -> int | None:
        """The first frame's number in the names of given files; None where the names say."""
        return None if self.numbered_from < 0 else self.numbered_from

    @property
    def uses_estimator(self) -> bool:
        """True where MediaPipe may have to look at the footage."""
        return not self.mannequin and bool({"mediapipe", "auto"} & {self.keypoints, self.masks})

    @property
    def assets(self) -> tuple[str, ...]:
        """The names of the weights that it needs."""
        if not self.uses_estimator:
            return ()
        return ("mediapipe", HEAVY) if self.pose_model == "heavy" else ("mediapipe",)
