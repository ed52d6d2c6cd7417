"""Settings of the animate stage."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from pipeline.config.choices import PlyUp, SplatFormat, Up
from pipeline.config.settings import SETTINGS, Angle, CountOrNone, EvenSide, FrameRate, Frames, setting
from pipeline.errors import UserError
from stages.animate.motions.source import TURNTABLE, motion_source

ColorName = Literal["grey", "black", "white", "green"]
NAMED_COLORS: Mapping[ColorName, str] = {
    "grey": "#d1d1d1", "black": "#000000", "white": "#ffffff", "green": "#00b140",
}  # fmt: skip
HexColor = Annotated[str, Field(pattern=r"^#[0-9a-fA-F]{6}$", examples=["#00b140"])]
Output = Literal["video", "exr", SplatFormat]
Outputs = Annotated[tuple[Output, ...], Field(min_length=1)]
Fps = Annotated[float, Field(ge=0, le=1000)]
LastFrame = Annotated[int, Field(ge=-1, le=1_000_000_000)]
Turns = Annotated[float, Field(ge=-1000, le=1000)]


@dataclass(frozen=True, config=SETTINGS)
class AnimateSettings:
    """Settings of the animate stage. ``motion=`` alone means ``animate.motion=``."""

    motion: str = setting(
        TURNTABLE,
        "a .bvh file, an AMASS or SMPL-X .npz, a folder of <frame>.json, a clip of somebody (its ingest and "
        "fit are made first), subject:NAME (what another subject does in its clip), or turntable: the avatar "
        "stands still and is turned",
    )
    outputs: Outputs = setting(
        ("video",),
        "what is written: video, exr (named layers in linear light), splats, a file a frame: ply, spz, glb",
    )
    width: EvenSide = setting(512, "pixels; with camera=clip the clip's picture is fitted into them")
    height: EvenSide = setting(512, "pixels")
    fps: Fps = setting(
        0.0, "frames a second; 0: the motion's own, or every n-th frame of it, as near to 30 as that comes"
    )
    first_frame: CountOrNone = setting(0, "the motion's first frame that is shown")
    last_frame: LastFrame = setting(-1, "the last that is shown; -1: the motion's last")
    camera: Literal["front", "orbit", "clip"] = setting(
        "front",
        "front: stands still before the person, as near as the whole motion allows; orbit: goes round "
        "meanwhile; clip: where the clip was filmed from, and the person where it began there",
    )
    turns: Turns = setting(1.0, "how often an orbit or a turntable goes round")
    way: Literal["auto", "kept", "still"] = setting(
        "auto", "the pelvis' way: kept, still (the body moves in its place), auto: still for who has no legs"
    )
    heads: Literal["known", "free"] = setting(
        "known", "the pose that the networks are told: no joint turned further than in training, or as it is"
    )
    unseen: Literal["auto", "nothing", "base"] = setting(
        "auto",
        "where the clip showed nothing: nothing, base (the fitted body in the colours next to it), "
        "auto: as it was trained (train.unseen)",
    )
    up: Up = setting(
        "auto", "the axis that is up in a .bvh or an .npz; auto: the one along which its body stands"
    )
    ply_up: PlyUp = setting(
        "y", "the axis that points up in ply/: y as in cameras.parquet; most viewers show -y upright"
    )
    background: ColorName | HexColor = setting(
        "grey", "behind the video's person; OpenEXR has an alpha instead"
    )
    # auto: from 24 poses on, where it pays (docs/results.md).
    bake: Literal["auto", "on", "off"] = setting(
        "auto", "whether all that does not depend on the pose is computed beforehand"
    )
    turntable_frames: Frames = setting(90, "frames of a turntable")
    turntable_fps: FrameRate = setting(30.0, "its frames a second")
    arm_angle: Angle = setting(
        0.0, "how far its arms hang below the T pose, radians; the paper's supplement turns the T pose"
    )
    sheet_frames: Frames = setting(12, "frames on the contact sheet, evenly spaced")

    @model_validator(mode="after")
    def _fit_together(self) -> AnimateSettings:
        if 0 <= self.last_frame < self.first_frame:
            span = f"{self.first_frame} to {self.last_frame}"
            raise ValueError(f"animate.first_frame and animate.last_frame: {span} is no range")
        try:
            motion_source(self.motion)
        except UserError as error:
            raise ValueError(str(error)) from None
        return self

    @property
    def color(self) -> tuple[float, float, float]:
        """The background, RGB in [0, 1]."""
        code = NAMED_COLORS.get(self.background, self.background)  # type: ignore[call-overload]
        red, green, blue = (int(code[place : place + 2], 16) / 255 for place in (1, 3, 5))
        return red, green, blue
