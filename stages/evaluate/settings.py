"""What the evaluate stage can be told. What a metric means is the protocol's three choices; see there."""

import dataclasses

from pipeline import protocols
from pipeline.protocols import Protocol

_NETWORKS = ("alex", "vgg")
_SECOND_MASKS = ("off", "edge", "estimator")
_COUNTS = ("training_frames", "comparison_frames", "turntable_frames", "refine_steps", "bootstrap_rounds")
_MAYBE_COUNTS = ("baseline_frames", "mesh_frames", "second_mask_frames", "slider_frames", "motion_frames")


@dataclasses.dataclass(frozen=True)
class EvaluateSettings:
    """Settings of the evaluate stage."""

    # A named set of the three choices below it: ours, paper (NeuMan's: white, the truth's mask on both
    # pictures, test poses refined) or paper_black (TalkShow's and ZJU-MoCap's: black, the truth's mask on
    # both). See pipeline/protocols.py.
    protocol: str = "ours"
    # What avatar, truth and baselines are composited on: black, white, or auto, as the protocol says.
    background: str = "auto"
    # Whose mask cuts the avatar's picture out: own (its alpha), truth (the truth's mask on both), or auto.
    render_mask: str = "auto"
    # Whether the held-out frames' poses are refined on the held-out images, for numbers beside those at the
    # fit's poses: on, off, plan (as it decided, test_time_refinement), or auto, as the protocol says.
    refine_test_poses: str = "auto"
    # Steps of that refinement, a frame.
    refine_steps: int = 60
    # Backbones of LPIPS: alex, vgg or both. On a CPU VGG costs twenty times what AlexNet does.
    lpips_networks: tuple[str, ...] = ("alex",)
    # Training frames that the avatar is scored on too, evenly spaced, to show what it remembers.
    training_frames: int = 8
    # Training frames that the baselines draw from, evenly spaced; 0: all of them.
    baseline_frames: int = 400
    # Training frames that give the textured mesh, a baseline, its colours; 0: without it.
    mesh_frames: int = 12
    # The mask that the ceiling is measured with: edge (the same, one pixel smaller), estimator (MediaPipe's
    # own, frame by frame: needs the asset mediapipe), a folder of grey pictures named by frame number, off.
    second_mask: str = "estimator"
    # Held-out frames that the ceiling is measured on, evenly spaced; 0: all of them.
    second_mask_frames: int = 12
    # Whether faces are compared by dlib's embedding: needs the assets dlib and identity, 0.15 s a picture.
    identity: bool = False
    # Of the intervals: drawn samples, their seed, and the share of the drawn means that lie inside.
    bootstrap_rounds: int = 2000
    bootstrap_seed: int = 0
    confidence: float = 0.95
    # Held-out frames shown in comparison.png, evenly spaced.
    comparison_frames: int = 3
    # Held-out frames in the report's slider, evenly spaced; each adds about 40 KB at 512 pixels.
    slider_frames: int = 12
    # What the error picture is multiplied by.
    error_gain: float = 3.0
    # Frames of the turn, and its size in pixels.
    turntable_frames: int = 90
    turntable_width: int = 480
    turntable_height: int = 640
    # Frames a second of the turn, and of the motion.
    turntable_fps: float = 30.0
    # How far the arms hang below the T pose in the turn, radians.
    arm_angle: float = 1.0
    # Frames of a motion that was never filmed (arms up, head turned); 0: without it.
    motion_frames: int = 48

    def __post_init__(self) -> None:
        """Refuse what cannot be done."""
        unknown = [name for name in self.lpips_networks if name not in _NETWORKS]
        if unknown:
            raise ValueError(f"evaluate.lpips_networks may hold {' and '.join(_NETWORKS)}, not {unknown[0]}")
        protocols.chosen(dataclasses.asdict(self))
        self._check_numbers()
        for name in ("turntable_width", "turntable_height"):
            # H.264 as browsers play it stores colour at half the size.
            if getattr(self, name) < 2 or getattr(self, name) % 2:
                raise ValueError(f"evaluate.{name} must be even and positive, not {getattr(self, name)}")
        if not self.second_mask.strip():
            raise ValueError(f"evaluate.second_mask must be {', '.join(_SECOND_MASKS)} or a folder")

    def _check_numbers(self) -> None:
        for least, names in ((1, _COUNTS), (0, _MAYBE_COUNTS)):
            for name in names:
                if getattr(self, name) < least:
                    raise ValueError(f"evaluate.{name} must be at least {least}, not {getattr(self, name)}")
        for name in ("error_gain", "turntable_fps"):
            if not getattr(self, name) > 0:
                raise ValueError(f"evaluate.{name} must be above 0, not {getattr(self, name)}")
        if not 0 < self.confidence < 1:
            raise ValueError(f"evaluate.confidence must lie between 0 and 1, not {self.confidence}")

    @property
    def choices(self) -> Protocol:
        """What the protocol and the settings say together."""
        return protocols.chosen(dataclasses.asdict(self))

    @property
    def assets(self) -> tuple[str, ...]:
        """The assets that these settings call for."""
        estimator = ("mediapipe",) if self.second_mask == "estimator" else ()
        return ("lpips", *estimator, *(("dlib", "identity") if self.identity else ()))
