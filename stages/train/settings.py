"""What can be set about training. The defaults are the ``quick`` preset's values."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any


@dataclasses.dataclass(frozen=True)
class TrainSettings:
    """Settings of the train stage; every schedule counts iterations, never seconds."""

    seed: int = 0  # of the initial weights and of every random draw
    iterations: int = 1000  # optimiser steps
    batch: int = 1  # frames an optimiser step; they share one decode of the static part
    half_precision: bool = True  # heads in bfloat16
    held_out_every: int = 250  # iterations between points of the held-out curve
    held_out_frames: int = 3  # frames of each such point
    checkpoint_every: int = 250  # iterations between checkpoints
    threads: int = 1  # of the CPU, 0 for all; on 2 cores one is faster at this size (docs/results.md)

    # Representation
    subdivisions: int = 1  # levels of midpoint subdivision: 0, 1 or 2
    subdivide_from: float = 0.5  # fraction of the run before which the mesh stays unsubdivided
    plane_resolution: int = 128  # texels along a side of each plane
    plane_channels: int = 32  # features a texel
    width: int = 128  # hidden channels of the heads
    groups: int = 8  # of the heads' GroupNorm; must divide width
    offset_unit: float = 0.04  # metres that a static offset of 1 stands for
    pose_offset_unit: float = 0.01  # metres that a pose-dependent offset of 1 stands for
    scale: float = 0.55  # initial standard deviation of a Gaussian, in mean edge lengths
    thickness: float = 0.5  # initial standard deviation along the normal, in those along the surface
    opacity: float = 0.999  # of every Gaussian
    pose_heads_from: float = 0.4  # fraction of the run from which the pose heads take part; 1: never
    # Noise on what the pose heads are told of the pose: without it they learn each frame by heart.
    pose_noise: float = 0.05  # standard deviation of each entry of the joints' rotation matrices
    initial_color: bool = True  # colours start at what the training frames show, else at grey

    # Visibility gate
    gate: bool = True  # leave out what no training frame shows
    gate_frames: int = 24  # training frames that the gate looks at
    gate_rings: int = 2  # rings of neighbours added to what was seen

    # Optimiser
    learning_rate: float = 1e-3  # of the heads
    plane_learning_rate: float = 5e-3  # of the triplane
    final_rate: float = 0.05  # the cosine schedule's last factor
    warm_up: int = 20  # iterations
    refine_poses: bool = True  # optimise the training frames' poses too
    refine_from: float = 0.15  # fraction of the run from which they move
    pose_learning_rate: float = 1e-4  # of rotations and expressions; a tenth of it for transl

    # Objective
    l1: float = 0.8  # lambda_L1
    ssim: float = 0.2  # lambda_ssim
    laplacian_offset: float = 1e3  # smoothness of static and pose-dependent offsets
    laplacian_scale: float = 0.02  # smoothness of log scales
    laplacian_color: float = 0.002  # smoothness of colours
    offset: float = 10.0  # size of static offsets
    hand_offset: float = 200.0  # size of static offsets on the hands
    pose_offset: float = 50.0  # size of pose-dependent offsets
    scale_size: float = 50.0  # size of scales
    pose_change: float = 0.0  # distance of refined poses from the fitted ones
    crop_margin: int = 8  # pixels around the person that the losses see

    def __post_init__(self) -> None:
        """Refuses values that cannot work."""
        counts = ("iterations", "batch", "held_out_every", "checkpoint_every", "gate_frames", "groups")
        fractions = ("subdivide_from", "pose_heads_from", "refine_from", "final_rate")
        amounts = (
            "held_out_frames",
            "gate_rings",
            "warm_up",
            "crop_margin",
            "learning_rate",
            "seed",
            "pose_noise",
            "threads",
        )
        self._require(counts, lambda value: value >= 1, "be at least 1")
        self._require(fractions, lambda value: 0 <= value <= 1, "lie between 0 and 1")
        self._require(amounts, lambda value: value >= 0, "not be negative")
        self._require(("subdivisions",), lambda value: value in (0, 1, 2), "be 0, 1 or 2")
        if self.subdivisions:
            self._require(("subdivide_from",), lambda value: value < 1, "be less than 1")
        self._require(("plane_resolution",), lambda value: value >= 2, "be at least 2")
        self._require(("groups",), lambda value: self.width % value == 0, f"divide train.width, {self.width}")
        self._require(("opacity",), lambda value: 0 < value < 1, "lie between 0 and 1")

    def _require(self, names: tuple[str, ...], fits: Callable[[Any], bool], what: str) -> None:
        for name in names:
            if not fits(getattr(self, name)):
                raise ValueError(f"train.{name} must {what}, not {getattr(self, name)}")
