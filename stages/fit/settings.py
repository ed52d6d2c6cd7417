"""Settings of the fit; lengths in metres, angles in radians."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from pipeline.config.settings import SETTINGS, Count, Fraction, Weight, setting

Steps = Annotated[int, Field(ge=0, le=1_000_000)]
Coefficients = Annotated[int, Field(ge=1, le=1000)]
Factor = Annotated[float, Field(gt=0, le=1000)]
FirstNumber = Annotated[int, Field(ge=-1, le=1_000_000_000)]
Seconds = Annotated[float, Field(ge=0, le=60)]


@dataclass(frozen=True, config=SETTINGS)
class FitSettings:
    """Settings of the fit stage."""

    iterations: Steps = setting(200, "steps of Adam over the whole clip; 0 publishes the initialisation")
    minibatch: Count = setting(256, "frames posed at a time: memory does not grow with the clip")
    learning_rate: Factor = setting(1.0, "factor on Adam's step of every group of parameters")

    # RegistrationObjective
    masked: bool = setting(True, "m of Eq. 2; false trusts every detection, also outside the picture")
    score_threshold: Fraction = setting(0.4, "tau: keypoints that score less are masked (Eq. 2)")
    betas: Coefficients = setting(100, "shape coefficients, as many of these as the body has")
    expressions: Coefficients = setting(1000, "coefficients of the expression, likewise; the paper has 50")
    joint_offsets: bool = setting(True, "fit Delta J")
    face_offsets: bool = setting(True, "fit Delta V_face, where the face is seen")
    lambda_init: Weight = setting(0.1, "weight of staying near the initial pose (Eq. 1)")
    lambda_sface: Weight = setting(1.0, "weight of the distance to the face that was fitted first (Eq. 1)")
    lambda_lids: Weight = setting(1.0, "weight of the lids' gaps against the priors; 0: lids as other points")
    lambda_gaze: Weight = setting(1.0, "weight of the irises' places against the priors; 0: as other points")
    lambda_silhouette: Weight = setting(2.0, "weight of the body's outline against the masks', less clothes")
    lambda_sreg: Weight = setting(1.0, "weight of shape, joint offsets and left-right symmetry (Eq. 1)")
    smoothness: Weight = setting(1.0, "factor on accelerations and velocities")

    # Where it starts
    face: Literal["auto", "mesh", "flame", "off"] = setting(
        "auto", "the face that is fitted first: the estimator's (its mesh, or its 68 points), FLAME's, none"
    )
    face_init: str = setting("", "folder of DECA's flame_params/ and shape_param.json, for face=flame")
    flame_model: str = setting("", "FLAME model file of the user's own, for face=flame")
    flame_fit: bool = setting(
        False, "fit FLAME to the 2D face points first (supplement A), for face=flame; face_init is its start"
    )
    lambda_flame_init: Weight = setting(0.1, "weight of its distance from DECA's start")
    pose_init: str = setting(
        "", "folder of SMPLest-X poses, smplx_init/*.json; else the estimator's landmarks"
    )
    numbered_from: FirstNumber = setting(
        -1, "the first frame's number in the names of pose_init and face_init; -1: as they say"
    )
    given: Literal["start", "keep", "ignore"] = setting(
        "start", "poses that came with the dataset: start from them, keep them as they are, ignore"
    )

    # What is published
    accept: Literal["good", "any"] = setting(
        "good",
        "good: leave out frames whose body is not on the person, and refuse a clip of such; any: go on",
    )
    smoothing_seconds: Seconds = setting(
        0.18,
        "length of the Savitzky-Golay filter: 5 frames of 25 or 30 a second; 0 leaves the poses as fitted",
    )
    export_peers: bool = setting(
        False, "write identity and poses in ExAvatar's and FlexiAvatar's JSON layout too"
    )
    overlay_opacity: Fraction = setting(0.6, "of the mesh in overlay.mp4 and overlay.png")

    @model_validator(mode="after")
    def _fit_together(self) -> FitSettings:
        if self.face == "flame" and not (self.flame_model and (self.face_init or self.flame_fit)):
            raise ValueError("fit.face=flame needs fit.flame_model, and fit.face_init or fit.flame_fit=true")
        if self.face != "flame" and (self.face_init or self.flame_model):
            raise ValueError("fit.face_init and fit.flame_model are not used: set fit.face=flame")
        return self

    @property
    def first_number(self) -> int | None:
        """The first frame's number in the names of given files; None where the names say."""
        return None if self.numbered_from < 0 else self.numbered_from
