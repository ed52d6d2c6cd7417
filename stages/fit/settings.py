"""What can be set about the fit."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class FitSettings:
    """Settings of the fit stage; lengths in metres, angles in radians."""

    iterations: int = 400  # steps of Adam over the whole clip
    score_threshold: float = 0.4  # tau: keypoints that score less are masked (Eq. 2)
    betas: int = 16  # shape coefficients, as far as the body has them
    joint_offsets: bool = True  # fit Delta J
    face_offsets: bool = True  # fit Delta V_face, where the face is seen
    learning_rate: float = 1.0  # factor on the step of every group of parameters
    lambda_init: float = 1.0  # factor on staying near the initial pose (Eq. 1)
    lambda_sreg: float = 1.0  # factor on shape, joint offsets and left-right symmetry (Eq. 1)
    smoothness: float = 1.0  # factor on accelerations and velocities
    overlay_opacity: float = 0.6  # of the mesh in overlay.mp4 and overlay.png

    def __post_init__(self) -> None:
        """Refuse what cannot work."""
        for name, least in (("iterations", 1), ("betas", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"fit.{name} must be at least {least}, not {getattr(self, name)}")
        for name in ("learning_rate", "lambda_init", "lambda_sreg", "smoothness"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise ValueError(f"fit.{name} must be zero or more, not {getattr(self, name)}")
        for name in ("score_threshold", "overlay_opacity"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"fit.{name} must lie between 0 and 1, not {getattr(self, name)}")
