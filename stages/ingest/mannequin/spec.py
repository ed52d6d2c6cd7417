"""What a mannequin clip shows, in a few words. Imports nothing heavy, so that settings can check it."""

from __future__ import annotations

import dataclasses
from typing import Any

FRAMINGS = ("full", "upper", "head")
LAYERS = ("stand", "turn", "sway", "gesture", "curl", "speech", "nod")
DETECTORS = ("mediapipe", "heatmap")
VIEWS = {"left": (60.0, 0.0), "right": (-60.0, 0.0), "back": (180.0, 0.0), "above": (25.0, 40.0)}
"""Cameras that the pipeline never sees: azimuth towards the subject's left and elevation, degrees."""

DEFAULT_MOTION = {
    "full": "turn+gesture+curl+speech",
    "upper": "sway+gesture+curl+speech",
    "head": "nod+speech",
}


@dataclasses.dataclass(frozen=True)
class MannequinSpec:
    """A clip of the mannequin; equal specs give equal bytes.

    Attributes:
        framing: one of ``FRAMINGS``: the whole body, from the waist, or from the collarbones up.
        motion: names of ``LAYERS`` joined by '+', or a BVH file's path; empty for what suits the framing.
        frames: how many.
        size: pixels, both sides of the picture.
        fps: frames a second.
        seed: of the motion, the detector's errors and the picture's grain.
        identity: seed of shape, joint and face offsets, clothes, hair and colours; 0 is a person too.
        noise: the detector's error on seen points, 1 for a good detector, 0 for none.
        hand_failures: the part of the frames in which a hand's detection begins to fail.
        detector: one of ``DETECTORS``, whose errors the keypoints have; see ``detector.py``.
        views: names of ``VIEWS`` that are filmed as well.
        view_stride: every how many frames the views are filmed.
    """

    framing: str = "full"
    motion: str = ""
    frames: int = 60
    size: int = 256
    fps: float = 25.0
    seed: int = 0
    identity: int = 0
    noise: float = 1.0
    hand_failures: float = 0.03
    detector: str = "mediapipe"
    views: tuple[str, ...] = ()
    view_stride: int = 10

    def __post_init__(self) -> None:
        """ValueError where a value makes no sense."""
        if self.framing not in FRAMINGS:
            raise ValueError(
                f"the mannequin's framing must be one of {', '.join(FRAMINGS)}, not {self.framing!r}"
            )
        if self.detector not in DETECTORS:
            raise ValueError(
                f"the mannequin's detector must be one of {', '.join(DETECTORS)}, not {self.detector!r}"
            )
        unknown = [] if self.is_bvh else [name for name in self.layers if name not in LAYERS]
        if unknown:
            raise ValueError(
                f"the mannequin has no motion {unknown[0]!r}: name a .bvh file, or {', '.join(LAYERS)}"
            )
        for name, least in (("frames", 2), ("size", 32), ("view_stride", 1), ("seed", 0), ("identity", 0)):
            if getattr(self, name) < least:
                raise ValueError(
                    f"the mannequin's {name} must be at least {least}, not {getattr(self, name)}"
                )
        if self.fps <= 0 or self.noise < 0 or not 0 <= self.hand_failures <= 1:
            raise ValueError(
                "the mannequin's fps must be positive, noise at least 0, hand_failures in [0, 1]"
            )
        for name in self.views:
            if name not in VIEWS:
                raise ValueError(f"the mannequin has no view {name!r}, only {', '.join(VIEWS)}")

    @property
    def is_bvh(self) -> bool:
        """Whether ``motion`` is a motion-capture file."""
        return self.motion.lower().endswith(".bvh")

    @property
    def layers(self) -> tuple[str, ...]:
        """The generated motions that are added up; over a BVH file, the face that it lacks."""
        if self.is_bvh:
            return ("speech",)
        return tuple((self.motion or DEFAULT_MOTION[self.framing]).split("+"))


def spec_of(settings: Any) -> MannequinSpec:
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
