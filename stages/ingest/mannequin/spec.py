"""The description of a mannequin's clip. Imports nothing heavy, so that settings can check it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Annotated, Any, Literal, get_args

from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from pipeline.config.settings import SETTINGS, Count, Fraction, FrameRate, Seed, Side

Framing = Literal["full", "upper", "head"]
Detector = Literal["mediapipe", "heatmap"]
UnseenView = Literal["left", "right", "back", "above"]
FrameCount = Annotated[int, Field(ge=2, le=1_000_000)]
Noise = Annotated[float, Field(ge=0, le=100)]

FRAMINGS: tuple[Framing, ...] = get_args(Framing)
DETECTORS: tuple[Detector, ...] = get_args(Detector)
LAYERS = ("stand", "turn", "sway", "gesture", "curl", "speech", "nod", "eyes")
VIEWS: Mapping[UnseenView, tuple[float, float]] = {
    "left": (60.0, 0.0), "right": (-60.0, 0.0), "back": (180.0, 0.0), "above": (25.0, 40.0),
}  # fmt: skip
"""Cameras that the pipeline never sees: azimuth towards the subject's left and elevation, degrees."""

DEFAULT_MOTION: Mapping[Framing, str] = {
    "full": "turn+gesture+curl+speech",
    "upper": "sway+gesture+curl+speech",
    "head": "nod+speech",
}


def is_bvh(motion: str) -> bool:
    """True where a motion is a motion-capture file."""
    return motion.lower().endswith(".bvh")


def check_motion(motion: str) -> None:
    """Refuse a motion that is neither empty nor a BVH file nor names of ``LAYERS``; ValueError."""
    unknown = [] if is_bvh(motion) or not motion else sorted({*motion.split("+")} - {*LAYERS})
    if unknown:
        raise ValueError(
            f"the mannequin has no motion {unknown[0]!r}: name a .bvh file, or {', '.join(LAYERS)}"
        )


@dataclass(frozen=True, config=SETTINGS)
class MannequinSpec:
    """A clip of the mannequin; equal specs give equal bytes. The ranges are those of ingest's settings.

    Attributes:
        framing: the whole body, from the waist, or from the collarbones up.
        motion: names of ``LAYERS`` joined by '+', or a BVH file's path; empty for what suits the framing.
        frames: how many.
        size: pixels, both sides of the picture.
        fps: frames a second.
        seed: of the motion, the detector's errors and the picture's grain.
        identity: seed of shape, joint and face offsets, clothes, hair and colours; 0 is a person too.
        noise: the detector's error on seen points, 1 for a good detector, 0 for none.
        hand_failures: the part of the frames in which a hand's detection begins to fail.
        detector: whose errors the keypoints have; see ``detector.py``.
        views: names of ``VIEWS`` that are filmed as well.
        view_stride: every how many frames the views are filmed.
    """

    framing: Framing = "full"
    motion: str = ""
    frames: FrameCount = 60
    size: Side = 256
    fps: FrameRate = 25.0
    seed: Seed = 0
    identity: Seed = 0
    noise: Noise = 1.0
    hand_failures: Fraction = 0.03
    detector: Detector = "mediapipe"
    views: tuple[UnseenView, ...] = ()
    view_stride: Count = 10

    @model_validator(mode="after")
    def _knows_its_motion(self) -> MannequinSpec:
        check_motion(self.motion)
        return self

    @property
    def is_bvh(self) -> bool:
        """True where ``motion`` is a motion-capture file."""
        return is_bvh(self.motion)

    @property
    def layers(self) -> tuple[str, ...]:
        """The generated motions that are added up; over a BVH file, the face that it lacks."""
        if self.is_bvh:
            return ("speech",)
        return tuple((self.motion or DEFAULT_MOTION[self.framing]).split("+"))


def mannequin_spec(settings: Any) -> MannequinSpec:
    """The clip that the ingest stage's settings describe.

    ``settings.mannequin`` is the framing, and ``settings.mannequin_<field>`` any other field of the
    spec; fields that the settings do not have keep their defaults.
    """
    given = {
        field.name: getattr(settings, f"mannequin_{field.name}")
        for field in dataclasses.fields(MannequinSpec)
        if hasattr(settings, f"mannequin_{field.name}")
    }
    return MannequinSpec(**{**given, "framing": settings.mannequin})
