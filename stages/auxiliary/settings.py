"""Settings of the auxiliary views. The defaults are the ``quick`` preset's values."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from pipeline.config.choices import Device
from pipeline.config.settings import SETTINGS, Angle, Count, FrameRate, Positive, Seed, setting

TurnFrames = Annotated[int, Field(ge=4, le=100_000)]
Scale = Annotated[float, Field(ge=0, le=1000)]
TurnSide = Annotated[int, Field(ge=64, le=8192)]
Levels = Annotated[int, Field(ge=0, le=2)]
Steps = Annotated[int, Field(ge=1, le=10_000)]

MEASURED = ("mimicmotion", "folder", "named")  # generators whose frames have to be looked at


@dataclass(frozen=True, config=SETTINGS)
class AuxiliarySettings:
    """Settings of the auxiliary stage."""

    # auto costs a minute and some of the seen side's quality, so that the quick preset leaves it.
    generator: Literal["auto", "off", "guidance", "texture", "mimicmotion", "folder", "named"] = setting(
        "off",
        "auto: texture where the plan asks for views; guidance: only what a generator elsewhere needs; "
        "named: mimicmotion or folder, whichever of weights and folder is given",
    )
    folder: str = setting("", "of folder: frames that somebody made, or a video file")
    weights: str = setting("", "of mimicmotion: the folder with the model's weights")

    # The turn
    frames: TurnFrames = setting(48, "of the full turn; the paper has about 500")
    motion: Literal["relaxed", "clip"] = setting(
        "relaxed", "the body's pose while it turns; clip: as it moves in the clip"
    )
    arm_angle: Angle = setting(1.05, "radians below the T pose, of a relaxed arm")
    width: TurnSide = setting(576, "pixels of the guidance, what MimicMotion was trained on")
    height: TurnSide = setting(1024, "pixels of the guidance")
    fps: FrameRate = setting(15.0, "of the guidance's video")

    # texture
    texture_frames: Count = setting(24, "of the clip, whose colours are projected")
    texture_levels: Levels = setting(2, "of subdivision of the mesh that carries the texture")
    texture_light: bool = setting(True, "shade the unseen side as the seen one says that light falls")
    texture_guidance: bool = setting(True, "write the guidance too")

    # mimicmotion
    seed: Seed = setting(42, "of the noise that is denoised")
    steps: Steps = setting(25, "of denoising")
    guidance_scale: Scale = setting(2.0, "of classifier-free guidance")
    tile: Steps = setting(72, "frames that are denoised together")
    overlap: Steps = setting(6, "frames that neighbouring tiles share")
    device: Device = setting("auto", "where it computes")
    half_precision: bool = setting(True, "on a GPU")

    # What is thrown out; distances in parts of the driving pose's height
    keypoint_distance: Positive = setting(
        0.06, "mean distance of trusted body points from the driving pose's"
    )
    mask_missing: Positive = setting(0.4, "share of a limb that the mask may lack")
    mask_outside: Positive = setting(0.5, "of the body's area, how much mask may lie beside the body")
    # One person's faces differ by 0.5, two people's by 0.66.
    identity_distance: Positive = setting(0.55, "of a face from the subject's own")
    flicker: Positive = setting(3.0, "times the usual change from frame to frame")
    check: bool = setting(True, "whether frames of mimicmotion and folder are checked at all")
    register: bool = setting(True, "fit the poses of the kept frames, starting from the driving pose")

    unseen_only: bool = setting(True, "learn from a generated picture only where the clip shows nothing")

    @model_validator(mode="after")
    def _fit_together(self) -> AuxiliarySettings:
        if self.generator == "folder" and not self.folder:
            raise ValueError("auxiliary.generator=folder needs auxiliary.folder=FOLDER_OR_VIDEO")
        if self.generator == "mimicmotion" and not self.weights:
            raise ValueError("auxiliary.generator=mimicmotion needs auxiliary.weights=FOLDER")
        if self.overlap >= self.tile - 1:
            raise ValueError(
                f"auxiliary.overlap must be less than auxiliary.tile - 1, {self.tile - 1}, not {self.overlap}"
            )
        return self

    @property
    def assets(self) -> tuple[str, ...]:
        """The assets that are needed: the detector and the identity network, where frames are checked."""
        return ("mediapipe", "dlib", "identity") if self.generator in MEASURED and self.check else ()
