"""What can be set about training. The defaults are the ``quick`` preset's values."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

# Written out, because settings are read where torch is not imported; tests compare them with the
# originals in pipeline/device.py, pipeline/avatar/residual.py and pipeline/metrics/lpips.py.
NETWORKS = ("alex", "vgg")
PLACES = ("canonical", "posed")
SKINNINGS = ("own", "nearest")
DEVICES = ("auto", "cpu", "cuda")
UNSEEN = ("nothing", "base", "generated")
PARTS = (
    "torso", "head", "face", "left_arm", "right_arm", "left_hand", "right_hand", "left_leg", "right_leg",
    "rest",
)  # fmt: skip
COUNTS = (
    "iterations", "batch", "held_out_every", "checkpoint_every", "color_frames", "gate_every", "groups",
    "lpips_every",
    "plane_channels", "width", "residual_width", "skin_every",
)  # fmt: skip
FRACTIONS = (
    "subdivide_from", "pose_heads_from", "refine_from", "residual_from", "gate_from", "time_dropout",
    "final_rate", "lpips_from",
)  # fmt: skip
AMOUNTS = (
    "held_out_frames", "gate_rings", "warm_up", "crop_margin", "learning_rate", "plane_learning_rate",
    "pose_learning_rate", "offset_unit", "pose_offset_unit", "seed", "pose_noise",
    "threads", "place_frequencies", "time_frequencies", "lpips_crop", "l1", "ssim", "lpips",
    "face", "generated", "laplacian_offset", "laplacian_offset_face", "laplacian_scale",
    "laplacian_scale_face", "laplacian_color", "laplacian_color_hands", "offset", "offset_hands",
    "offset_face", "pose_offset", "hand_normal", "scale_size", "scale_size_hands", "scale_growth",
    "hand_color", "arm_color", "residual_size", "pose_change",
)  # fmt: skip


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

    # auto: cuda where there is a GPU and gsplat. Equal runs give equal bytes on a CPU only, and the key of an
    # artifact holds this word, not what it came to mean (pipeline/device.py); run.json does.
    device: str = "auto"  # where it computes: auto, cpu or cuda

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
    skinning: str = (
        "own"  # weights of the Gaussian's own vertex; "nearest": of the vertex it has come to lie at
    )
    skin_every: int = 100  # iterations between two looks at which vertex is nearest
    pose_heads_from: float = 0.4  # fraction of the run from which the pose heads take part; 1: never
    # Pose and residual heads: what the frame saw when last drawn. A tenth to a seventh of a step at 40,000
    # Gaussians, nothing at 10,000; turned pictures and held-out frames are the same (docs/results.md).
    pose_seen_only: bool = True
    # Noise on what the pose heads are told of the pose: without it they learn each frame by heart.
    pose_noise: float = 0.05  # standard deviation of each entry of the joints' rotation matrices
    initial_color: bool = True  # colours start at what the training frames show, else at grey
    color_frames: int = 24  # training frames that first colours are looked for in

    # Residual colours (Section 3.5). A part that the plan does not name gets no head.
    residual_parts: tuple[str, ...] = ("face", "left_hand", "right_hand")  # "rest": the authors' fourth net
    residual_moves: bool = False  # move Gaussians, too: the ablation of the paper's supplement E.3
    residual_from: float = 0.5  # fraction of the run from which the residual heads take part; 1: never
    residual_width: int = 64  # hidden channels; the authors' release has 256
    residual_place: str = "canonical"  # what they are told of a Gaussian's place; "posed": in the world
    place_frequencies: int = 6  # of that place's encoding, in the part's box ("posed": metres)
    time_frequencies: int = 6  # of the time's encoding, over the training frames' interval
    time_dropout: float = 0.2  # share of draws without a time, for motion that has none

    # Visibility gate (Section 3.4); it acts only if the plan calls for it
    gate: bool = True  # leave out what is seen too seldom
    early_gate: bool = True  # from the start: what lies in no training frame's picture
    gate_from: float = 0.1  # fraction of the run, the warm-up, after which scores are looked at; 1: never
    gate_every: int = 50  # iterations between looks
    gate_threshold: float | None = None  # scores below are gated; none: found in the scores (Otsu)
    gate_rings: int = 2  # rings of neighbours added to what is left
    # What a finished avatar shows where no captured frame showed enough: nothing, base (the fitted body in
    # the colours next to it), or generated (what generated frames show, and nothing where there are none)
    unseen: str = "generated"

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
    lpips: float = 0.0  # lambda_lpips; the paper's is 0.2
    lpips_network: str = "alex"  # or "vgg", twenty times as dear on a CPU
    lpips_every: int = 4  # drawn frames for one that LPIPS looks at, with as many times the weight
    lpips_crop: int = 96  # pixels of the square around a random place of the person; 0: the whole view
    lpips_from: float = 0.0  # fraction of the run from which it takes part
    face: float = 0.0  # lambda_face; the paper's is 0.8
    generated_every: int = 5  # draws for one of a generated frame; the paper's is 2, equally often
    generated: float = 0.1  # lambda_L1, lambda_ssim and lambda_lpips on generated frames

    # Regularisers, each weighted with its value; the paper's values are in data/presets/paper.toml
    laplacian_offset: float = 1e3  # smoothness of static and of all offsets together
    laplacian_offset_face: float = 1e3  # the same on the face
    laplacian_scale: float = 0.02  # smoothness of log scales
    laplacian_scale_face: float = 0.02  # the same on the face
    laplacian_color: float = 0.002  # smoothness of colours
    laplacian_color_hands: float = 0.002  # the same on the hands
    offset: float = 10.0  # size of static offsets, metres squared
    offset_hands: float = 1000.0  # the same on the hands
    offset_face: float = 10.0  # the same on the face
    pose_offset: float = 50.0  # size of pose-dependent offsets, metres squared
    hand_normal: float = 0.0  # static offsets of the hands that point outwards
    scale_size: float = 0.0  # size of scales, metres squared
    scale_size_hands: float = 0.0  # the same on the hands
    scale_growth: float = 0.002  # log scales above the initial ones
    hand_color: float = 0.0  # differences of the hands' colours from their mean
    arm_color: float = 0.0  # differences of the arms' lower sides from their upper sides
    residual_size: float = 1e-3  # size of residual colours, in logits
    pose_change: float = 0.0  # distance of refined poses from the fitted ones

    crop_margin: int = 8  # pixels around the person that the losses see

    def __post_init__(self) -> None:
        """Refuses values that cannot work."""
        self._require(COUNTS, lambda value: value >= 1, "be at least 1")
        self._require(FRACTIONS, lambda value: 0 <= value <= 1, "lie between 0 and 1")
        self._require(AMOUNTS, lambda value: value >= 0, "not be negative")
        self._require(("subdivisions",), lambda value: value in (0, 1, 2), "be 0, 1 or 2")
        if self.subdivisions:
            self._require(("subdivide_from",), lambda value: value < 1, "be less than 1")
        self._require(("scale", "thickness"), lambda value: value > 0, "be more than 0")
        self._require(("plane_resolution",), lambda value: value >= 2, "be at least 2")
        self._require(("groups",), lambda value: self.width % value == 0, f"divide train.width, {self.width}")
        self._require(("opacity",), lambda value: 0 < value < 1, "lie between 0 and 1")
        self._require(
            ("residual_width",), lambda value: value % self.groups == 0, "be divisible by train.groups"
        )
        self._require(("lpips_network",), lambda value: value in NETWORKS, f"be one of {', '.join(NETWORKS)}")
        words = {"residual_place": PLACES, "unseen": UNSEEN, "device": DEVICES}
        for name, known in words.items():
            self._require((name,), known.__contains__, f"be one of {', '.join(known)}")
        if self.gate_threshold is not None:
            self._require(("gate_threshold",), lambda value: 0 < value <= 1, "lie between 0 and 1")
        self._require(
            ("residual_parts",), lambda value: {*value} <= {*PARTS}, f"hold only {', '.join(PARTS)}"
        )

    def _require(self, names: tuple[str, ...], fits: Callable[[Any], bool], what: str) -> None:
        for name in names:
            if not fits(getattr(self, name)):
                raise ValueError(f"train.{name} must {what}, not {getattr(self, name)}")
