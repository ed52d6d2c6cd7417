"""The settings of the ingest stage."""

from __future__ import annotations

import dataclasses

from stages.ingest.layouts import LAYOUTS
from stages.ingest.mannequin.spec import spec_of


@dataclasses.dataclass(frozen=True)
class IngestSettings:
    """See the comment of each field; ValueError where a value makes no sense."""

    long_side: int = 512  # pixels; larger footage is stored at this size, smaller footage as it is
    stride: int = 1  # every stride-th frame is looked at
    max_frames: int = 0  # how many frames are looked at, 0 for all
    layout: str = "auto"  # how the source lies on disk: auto, plain, or a dataset's, see layouts.py
    keypoints: str = "auto"  # the dataset's, else mediapipe; or a folder of mmpose/DWPose JSON, one a frame
    masks: str = (
        "auto"  # the dataset's, else mediapipe; or a folder of grey pictures, white where the person is
    )
    poses: str = ""  # file of poses to start from that lies elsewhere than the footage: SHOW's .pkl
    test_fraction: float = 0.1  # the part of the kept frames, at the clip's end, that is held out
    test_frames: int = 0  # how many of the last frames are held out, in place of test_fraction
    focal: float = 1.2  # the camera's focal length over the longer side of the picture
    cameras: str = "auto"  # pinhole, sfm, a COLMAP model, a calibration file, a folder of cam_params
    camera_name: str = ""  # which camera of a calibrated rig filmed the clip
    test_cameras: tuple[str, ...] = ()  # further cameras of a rig that are held out; others: all the rest
    camera_scale: float = 0.0  # metres a unit of cameras without a scale; 0 finds it from the person
    estimator_long_side: int = 1920  # larger pictures are reduced to this for the estimator
    estimator_short_side: int = 400  # smaller pictures are enlarged towards this, at most three times
    body_score: float = 0.3  # a frame whose best body points score less on average holds no person
    mask_area: float = 0.002  # a frame whose mask covers less of the picture holds no person
    mask_edge: float = 1.0  # how far the mask follows the picture's own edges, 0 to 1
    mask_steadiness: int = 2  # frames on either side that a mask is averaged with along the motion
    background: bool = True  # learn the background where it stands still, and take it out of the masks
    mannequin: str = ""  # full, upper or head: film the open body with known truth instead of footage
    mannequin_motion: str = ""  # names of its motions joined by '+', or a BVH file; empty for what suits
    mannequin_frames: int = 60  # how many frames are filmed
    mannequin_size: int = 256  # pixels, both sides of the picture
    mannequin_fps: float = 25.0  # frames a second
    mannequin_seed: int = 0  # of the motion, the detector's errors and the picture's grain
    mannequin_identity: int = 0  # seed of shape, clothes, hair and colours
    mannequin_detector: str = "mediapipe"  # whose errors the keypoints have: mediapipe or heatmap
    mannequin_noise: float = 1.0  # the detector's error on seen points, 1 for a good detector
    mannequin_hand_failures: float = 0.03  # the part of frames in which a hand's detection begins to fail
    mannequin_views: tuple[str, ...] = ()  # unseen cameras that are filmed too: left, right, back, above
    mannequin_view_stride: int = 10  # every how many frames they are filmed

    def __post_init__(self) -> None:
        """Check the ranges."""
        for name, (least, most) in RANGES.items():
            value = getattr(self, name)
            if not least <= value <= most:
                raise ValueError(f"ingest.{name} must lie between {least} and {most}, not {value}")
        for name, words in (("keypoints", "auto"), ("masks", "auto"), ("cameras", "auto")):
            if not getattr(self, name).strip():
                raise ValueError(f"ingest.{name} must be '{words}' or a path")
        if self.layout not in ("auto", *LAYOUTS):
            raise ValueError(f"ingest.layout must be auto, {', '.join(LAYOUTS)}, not {self.layout}")
        if self.mannequin:
            spec_of(self)

    @property
    def uses_estimator(self) -> bool:
        """Whether MediaPipe may have to look at the footage."""
        return not self.mannequin and bool({"mediapipe", "auto"} & {self.keypoints, self.masks})


RANGES: dict[str, tuple[float, float]] = {
    "long_side": (32, 8192),
    "stride": (1, 1_000_000),
    "max_frames": (0, 10_000_000),
    "test_fraction": (0, 0.9),
    "test_frames": (0, 10_000_000),
    "focal": (0.1, 100),
    "camera_scale": (0, 1e6),
    "estimator_long_side": (128, 8192),
    "estimator_short_side": (32, 8192),
    "body_score": (0, 1),
    "mask_area": (0, 1),
    "mask_edge": (0, 1),
    "mask_steadiness": (0, 20),
}
