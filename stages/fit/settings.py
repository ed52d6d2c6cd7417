"""The settings of the fit stage."""

from __future__ import annotations

import dataclasses

FACE_SOURCES = ("auto", "mesh", "flame", "off")
GIVEN = ("start", "keep", "ignore")


@dataclasses.dataclass(frozen=True)
class FitSettings:
    """Settings of the fit stage; lengths in metres, angles in radians."""

    iterations: int = 200  # steps of Adam over the whole clip; 0 publishes the initialisation
    minibatch: int = 256  # frames posed at a time: memory does not grow with the clip
    learning_rate: float = 1.0  # factor on Adam's step of every group of parameters

    # Objective
    masked: bool = True  # m of Eq. 2; false trusts every detection, also outside the picture
    score_threshold: float = 0.4  # tau: keypoints that score less are masked (Eq. 2)
    betas: int = 100  # shape coefficients, as many of these as the body has
    joint_offsets: bool = True  # fit Delta J
    face_offsets: bool = True  # fit Delta V_face, where the face is seen
    lambda_init: float = 0.1  # weight of staying near the initial pose (Eq. 1)
    lambda_sface: float = 1.0  # weight of the distance to the face that was fitted first (Eq. 1)
    lambda_sreg: float = 1.0  # weight of shape, joint offsets and left-right symmetry (Eq. 1)
    smoothness: float = 1.0  # factor on accelerations and velocities

    # Where it starts
    face: str = (
        "auto"  # the face that is fitted first: mesh (the estimator's), flame or off; auto: as there is
    )
    face_init: str = ""  # folder of DECA's flame_params/ and shape_param.json, for face=flame
    flame_model: str = ""  # FLAME model file of the user's own, for face=flame
    pose_init: str = ""  # folder of SMPLest-X poses, smplx_init/*.json; else the estimator's landmarks
    given: str = "start"  # poses that came with the dataset: start from them, keep them as they are, ignore

    # What is published
    smoothing_window: int = 5  # frames of the Savitzky-Golay filter, odd; 0 leaves the poses as fitted
    export_peers: bool = False  # write identity and poses in ExAvatar's and FlexiAvatar's JSON layout too
    overlay_opacity: float = 0.6  # of the mesh in overlay.mp4 and overlay.png

    def __post_init__(self) -> None:
        """Refuse what cannot work."""
        for name, least in (("iterations", 0), ("betas", 1), ("minibatch", 1)):
            self._require(name, getattr(self, name) >= least, f"be at least {least}")
        for name in ("learning_rate", "lambda_init", "lambda_sface", "lambda_sreg", "smoothness"):
            self._require(name, 0 <= getattr(self, name) < float("inf"), "be zero or more")
        for name in ("score_threshold", "overlay_opacity"):
            self._require(name, 0 <= getattr(self, name) <= 1, "lie between 0 and 1")
        for name, words in (("face", FACE_SOURCES), ("given", GIVEN)):
            self._require(name, getattr(self, name) in words, f"be one of {', '.join(words)}")
        window = self.smoothing_window
        self._require(
            "smoothing_window", window == 0 or (window > 2 and window % 2 == 1), "be 0 or odd, from 3"
        )
        if self.face == "flame" and not (self.face_init and self.flame_model):
            raise ValueError("fit.face=flame needs fit.face_init and fit.flame_model")

    def _require(self, name: str, fits: bool, what: str) -> None:
        if not fits:
            raise ValueError(f"fit.{name} must {what}, not {getattr(self, name)}")
