"""What the animate stage can be told."""

from __future__ import annotations

import dataclasses
import re

from pipeline.errors import UserError
from pipeline.motion.names import TURNTABLE, motion_name

OUTPUTS = ("video", "exr", "ply")
CAMERAS = ("front", "orbit", "clip")
NAMED_COLORS = {"grey": "#d1d1d1", "black": "#000000", "white": "#ffffff", "green": "#00b140"}
_CHOICES = {
    "camera": CAMERAS,
    "up": ("auto", "y", "z"),
    "way": ("auto", "kept", "still"),
    "heads": ("known", "free"),
    "unseen": ("auto", "nothing", "base"),
    "bake": ("auto", "on", "off"),
}


@dataclasses.dataclass(frozen=True)
class AnimateSettings:
    """Settings of the animate stage. ``motion=`` alone means ``animate.motion=``."""

    # A .bvh file, an AMASS or SMPL-X .npz, a folder of <frame>.json, subject:NAME (what another subject does
    # in its clip), or turntable: the avatar stands still and is turned.
    motion: str = TURNTABLE
    # What is written: video, exr (named layers in linear light), ply (splats, a file a frame).
    outputs: tuple[str, ...] = ("video",)
    # Pixels. With camera=clip the clip's picture is fitted into them.
    width: int = 512
    height: int = 512
    # Frames a second; 0: the motion's own, or every n-th frame of it, as near to 30 as that comes.
    fps: float = 0.0
    # The motion's frames that are shown, both included; -1 is its last.
    first_frame: int = 0
    last_frame: int = -1
    # front: stands still before the person, as near as the whole motion allows; orbit: goes round meanwhile;
    # clip: where the clip was filmed from, and the person where it began there.
    camera: str = "front"
    # How often an orbit or a turntable goes round.
    turns: float = 1.0
    # The pelvis' way: kept, still (the body moves in its place), or auto: still for an avatar without legs.
    way: str = "auto"
    # What the networks are told of a pose: known, no joint turned further than the training frames show, or
    # free, the pose as it is.
    heads: str = "known"
    # What is shown of the body where the clip showed nothing: nothing, base (the fitted body in the colours
    # next to it), or auto, as the avatar was trained (train.unseen).
    unseen: str = "auto"
    # The axis that is up in an .npz: y, z, or auto, the one along which its body stands.
    up: str = "auto"
    # Behind the video's person: grey, black, white, green, or #rrggbb. OpenEXR has an alpha instead.
    background: str = "grey"
    # Whether all that does not depend on the pose is computed beforehand (pipeline/avatar/bake.py): on, off,
    # or auto: from 24 poses on, where it pays (docs/results.md).
    bake: str = "auto"
    # Frames of a turntable, its frames a second, and how far its arms hang below the T pose, in radians: the
    # paper's supplement turns the T pose.
    turntable_frames: int = 90
    turntable_fps: float = 30.0
    arm_angle: float = 0.0
    # Frames on the contact sheet, evenly spaced.
    sheet_frames: int = 12

    def __post_init__(self) -> None:
        """Refuse what cannot be done."""
        self._check_words()
        for name in ("width", "height"):
            # H.264 as browsers play it stores colour at half the size.
            if getattr(self, name) < 16 or getattr(self, name) % 2:
                raise ValueError(f"animate.{name} must be even and at least 16, not {getattr(self, name)}")
        for name in ("turntable_frames", "sheet_frames"):
            if getattr(self, name) < 1:
                raise ValueError(f"animate.{name} must be at least 1, not {getattr(self, name)}")
        if self.fps < 0 or not self.turntable_fps > 0:
            raise ValueError("animate.fps must be at least 0 and animate.turntable_fps above 0")
        if self.first_frame < 0 or (self.last_frame >= 0 and self.last_frame < self.first_frame):
            span = f"{self.first_frame} to {self.last_frame}"
            raise ValueError(f"animate.first_frame and animate.last_frame: {span} is no range")

    def _check_words(self) -> None:
        for name, known in _CHOICES.items():
            if (value := getattr(self, name)) not in known:
                raise ValueError(f"animate.{name} must be one of {', '.join(known)}, not {value}")
        unknown = [name for name in self.outputs if name not in OUTPUTS]
        if unknown or not self.outputs:
            raise ValueError(
                f"animate.outputs may hold {', '.join(OUTPUTS)}, not {unknown[0] if unknown else 'nothing'}"
            )
        if not re.fullmatch(r"#[0-9a-fA-F]{6}", NAMED_COLORS.get(self.background, self.background)):
            raise ValueError(
                f"animate.background must be {', '.join(NAMED_COLORS)} or #rrggbb, not {self.background}"
            )
        try:
            motion_name(self.motion)
        except UserError as error:
            raise ValueError(str(error)) from None

    @property
    def color(self) -> tuple[float, float, float]:
        """The background, RGB in [0, 1]."""
        code = NAMED_COLORS.get(self.background, self.background)
        red, green, blue = (int(code[place : place + 2], 16) / 255 for place in (1, 3, 5))
        return red, green, blue
