"""What the evaluate stage can be told. None of it but the background changes what a metric means."""

import dataclasses

_NETWORKS = ("alex", "vgg")
# As in pipeline/metrics/protocol.py, which is too heavy to load here; a test compares them.
_BACKGROUNDS = ("black", "white")
_CHOICES = ("auto", "on", "off")


@dataclasses.dataclass(frozen=True)
class EvaluateSettings:
    """Settings of the evaluate stage."""

    # What avatar, truth and baselines are composited on: black or white.
    background: str = "black"
    # Whether the held-out frames' poses are refined on the held-out images, for numbers beside those at the
    # fit's poses: on, off, or auto, as the plan decided (test_time_refinement).
    refine_test_poses: str = "auto"
    # Steps of that refinement, a frame.
    refine_steps: int = 60
    # Backbones of LPIPS: alex, vgg or both. On a CPU VGG costs twenty times what AlexNet does.
    lpips_networks: tuple[str, ...] = ("alex",)
    # Training frames that the avatar is scored on too, evenly spaced, to show what it remembers.
    training_frames: int = 8
    # Training frames that the two baselines draw from, evenly spaced; 0: all of them.
    baseline_frames: int = 400
    # Held-out frames shown in the comparison, evenly spaced.
    comparison_frames: int = 3
    # What the error picture is multiplied by.
    error_gain: float = 3.0
    # Frames of the turn, and its size in pixels.
    turntable_frames: int = 90
    turntable_width: int = 480
    turntable_height: int = 640
    # Frames a second of the turn.
    turntable_fps: float = 30.0
    # How far the arms hang below the T pose in the turn, radians.
    arm_angle: float = 1.0

    def __post_init__(self) -> None:
        """Refuse what cannot be done."""
        unknown = [name for name in self.lpips_networks if name not in _NETWORKS]
        if unknown:
            raise ValueError(f"evaluate.lpips_networks may hold {' and '.join(_NETWORKS)}, not {unknown[0]}")
        self._check_words()
        if self.baseline_frames < 0:
            raise ValueError(f"evaluate.baseline_frames must be at least 0, not {self.baseline_frames}")
        for name in ("training_frames", "comparison_frames", "turntable_frames", "refine_steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"evaluate.{name} must be at least 1, not {getattr(self, name)}")
        for name in ("turntable_width", "turntable_height"):
            # H.264 as browsers play it stores colour at half the size.
            if getattr(self, name) < 2 or getattr(self, name) % 2:
                raise ValueError(f"evaluate.{name} must be even and positive, not {getattr(self, name)}")
        for name in ("error_gain", "turntable_fps"):
            if not getattr(self, name) > 0:
                raise ValueError(f"evaluate.{name} must be above 0, not {getattr(self, name)}")

    def _check_words(self) -> None:
        for name, known in (("background", _BACKGROUNDS), ("refine_test_poses", _CHOICES)):
            if (value := getattr(self, name)) not in known:
                raise ValueError(f"evaluate.{name} must be one of {', '.join(known)}, not {value}")
