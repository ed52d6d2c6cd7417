"""What can be set about auxiliary views. The defaults are the ``quick`` preset's values."""

from __future__ import annotations

import dataclasses

GENERATORS = ("auto", "off", "guidance", "texture", "mimicmotion", "folder")
MOTIONS = ("relaxed", "clip")
AMOUNTS = ("keypoint_distance", "mask_missing", "mask_outside", "identity_distance", "flicker", "fps")
MEASURED = ("mimicmotion", "folder")  # generators whose frames have to be looked at


@dataclasses.dataclass(frozen=True)
class AuxiliarySettings:
    """Settings of the auxiliary stage."""

    # auto: texture where the plan asks for auxiliary views, else off; it costs a minute and some of the seen
    # side's quality, so that the quick preset leaves it. guidance: only what a generator elsewhere needs.
    generator: str = "off"
    folder: str = ""  # of folder: frames that somebody made, or a video file
    weights: str = ""  # of mimicmotion: the folder with the model's weights

    # The turn
    frames: int = 48  # of the full turn; the paper has about 500
    motion: str = "relaxed"  # the body's pose while it turns: relaxed, or clip: as it moves in the clip
    arm_angle: float = 1.05  # radians below the T pose, of a relaxed arm
    width: int = 576  # pixels of the guidance, what MimicMotion was trained on
    height: int = 1024
    fps: float = 15.0  # of the guidance's video

    # texture
    texture_frames: int = 24  # of the clip, whose colours are projected
    texture_levels: int = 2  # of subdivision of the mesh that carries the texture
    texture_light: bool = True  # shade the unseen side as the seen one says that light falls
    texture_guidance: bool = True  # write the guidance too

    # mimicmotion
    seed: int = 42
    steps: int = 25
    guidance_scale: float = 2.0
    tile: int = 72  # frames that are denoised together
    overlap: int = 6  # frames that neighbouring tiles share
    device: str = "auto"
    half_precision: bool = True  # on a GPU

    # What is thrown out; distances in parts of the driving pose's height
    keypoint_distance: float = 0.06  # mean distance of trusted body points from the driving pose's
    mask_missing: float = 0.4  # share of a limb that the mask may lack
    mask_outside: float = 0.5  # of the body's area, how much mask may lie beside the body
    identity_distance: float = (
        0.55  # of a face from the subject's own; one person's differ by 0.5, two people's by 0.66
    )
    flicker: float = 3.0  # times the usual change from frame to frame
    check: bool = True  # whether frames of mimicmotion and folder are checked at all
    register: bool = True  # fit the poses of the kept frames, starting from the driving pose

    unseen_only: bool = True  # learn from a generated picture only where the clip shows nothing

    def __post_init__(self) -> None:
        """Refuses values that cannot work."""
        if self.generator not in GENERATORS:
            raise ValueError(f"auxiliary.generator must be one of {', '.join(GENERATORS)}")
        if self.motion not in MOTIONS:
            raise ValueError(f"auxiliary.motion must be one of {', '.join(MOTIONS)}")
        if self.generator == "folder" and not self.folder:
            raise ValueError("auxiliary.generator=folder needs auxiliary.folder=FOLDER_OR_VIDEO")
        if self.generator == "mimicmotion" and not self.weights:
            raise ValueError("auxiliary.generator=mimicmotion needs auxiliary.weights=FOLDER")
        if self.texture_levels not in (0, 1, 2):
            raise ValueError("auxiliary.texture_levels must be 0, 1 or 2")
        if not 1 <= self.overlap < self.tile - 1:
            raise ValueError("auxiliary.overlap must be at least 1 and less than auxiliary.tile - 1")
        self._require(("frames",), 4)
        self._require(("width", "height"), 64)
        self._require(("texture_frames", "steps"), 1)
        for name in AMOUNTS:
            if getattr(self, name) <= 0:
                raise ValueError(f"auxiliary.{name} must be more than 0, not {getattr(self, name)}")

    def _require(self, names: tuple[str, ...], least: int) -> None:
        for name in names:
            if getattr(self, name) < least:
                raise ValueError(f"auxiliary.{name} must be at least {least}, not {getattr(self, name)}")

    @property
    def assets(self) -> tuple[str, ...]:
        """What has to be on disk: the detector and the identity network, where frames are looked at."""
        return ("mediapipe", "dlib", "identity") if self.generator in MEASURED and self.check else ()
