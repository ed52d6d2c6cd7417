"""The settings of the train stage; the defaults are the ``quick`` preset's values."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from pipeline.config.choices import Device, LpipsNetwork, ResidualPart, ResidualPlace
from pipeline.config.settings import (
    SETTINGS,
    Count,
    CountOrNone,
    Fraction,
    LearningRate,
    Seed,
    Weight,
    setting,
)  # fmt: skip

if TYPE_CHECKING:  # settings are read by what must start quickly
    from pipeline.clip.plan import Plan

Batch = Annotated[int, Field(ge=1, le=10_000)]
Threads = Annotated[int, Field(ge=0, le=1024)]
Levels = Annotated[int, Field(ge=0, le=2)]
Texels = Annotated[int, Field(ge=2, le=4096)]
Channels = Annotated[int, Field(ge=1, le=8192)]
Metres = Annotated[float, Field(ge=0, le=10)]
Size = Annotated[float, Field(gt=0, le=1000)]
Inset = Annotated[float, Field(ge=0, le=10)]
Opacity = Annotated[float, Field(gt=0, lt=1)]
Deviation = Annotated[float, Field(ge=0, le=10)]
Frequencies = Annotated[int, Field(ge=0, le=32)]
Threshold = Annotated[float, Field(gt=0, le=1)]
Rings = Annotated[int, Field(ge=0, le=1000)]
BasesCount = Annotated[int, Field(ge=0, le=256)]
Pixels = Annotated[int, Field(ge=0, le=8192)]
EdgePixels = Annotated[float, Field(ge=0, le=1000)]
Visits = Annotated[float, Field(ge=0, le=1_000_000)]
Factor = Annotated[float, Field(ge=0, le=1e6)]
Effort = Annotated[float, Field(gt=0, le=1000)]

PLANNED_RESIDUALS = ("face", "left_hand", "right_hand")  # the parts whose residuals the plan decides
IGNORED = {
    "triplane": (
        "edge_pixels", "bases", "bends", "color_learning_rate", "scale_learning_rate", "offset_learning_rate",
        "bases_learning_rate", "calm_from", "inset",
    ),
    "bases": (
        "half_precision", "subdivide_from", "plane_resolution", "plane_channels", "width", "groups",
        "pose_heads_from", "pose_seen_only", "pose_noise", "residual_parts", "residual_moves",
        "residual_from", "residual_width", "residual_place", "residual_size", "place_frequencies",
        "time_frequencies", "time_dropout", "residual_ramp", "plane_deviation", "plane_pose", "learning_rate",
        "plane_learning_rate", "pose_scale", "pose_scale_hands", "pose_scale_face",
    ),
}  # fmt: skip
"""The settings that a representation does not read."""

TRIPLANE_STEPS = 2.0  # times as many as the bases take
MOST_LEVELS = 2  # of subdivision, that train.subdivisions can ask for


@dataclass(frozen=True, config=SETTINGS)
class TrainSettings:
    """Settings of the train stage; every schedule counts iterations, never seconds.

    Settings that end in ``_from`` are fractions of the run; 1 means never where they start heads or the gate.
    """

    seed: Seed = setting(0, "of the initial weights and of every random draw")
    iterations: CountOrNone = setting(0, "optimiser steps; 0: as many as the plan says")
    effort: Effort = setting(1.0, "times the plan's steps; without effect where iterations is given")
    batch: Batch = setting(1, "frames an optimiser step; they share one decode of the static part")
    visits: Visits = setting(
        6.0, "how often a frame is drawn; of a longer clip the most different frames are, 0: all of them"
    )
    half_precision: bool = setting(
        True, "heads in bfloat16 where the processor multiplies it faster (AVX-512, a GPU)"
    )
    held_out_every: Count = setting(100, "iterations between points of the held-out curve")
    held_out_frames: CountOrNone = setting(3, "frames of each such point")
    checkpoint_every: Count = setting(250, "iterations between checkpoints")
    # Two are 1.7 times as fast as one. Their bytes are equal wherever there are two cores or more of a kind;
    # sums of a single core are others (docs/stability.md).
    threads: Threads = setting(2, "of the CPU, 0 for all")
    # Equal runs give equal bytes on a CPU only, and the key of an artifact holds this word, not what it came
    # to mean (pipeline/device.py); run.json does.
    device: Device = setting("auto", "where it computes; auto: cuda where there is a GPU and gsplat")

    # Representation; planes, heads, residual colours and noise are the triplane's
    representation: Literal["bases", "triplane"] = setting(
        "bases", "each Gaussian's own parameters and bases, or the paper's triplane and heads"
    )
    # smile (65 frames) lost 0.1 dB with 16 of them, carphone (108) gained 0.8 over 8 (docs/results.md).
    bases: BasesCount = setting(
        16,
        "most linear bases, driven by pose and face: one for 8 training frames, and none for a direction "
        "that the clip does not move in",
    )
    bends: BasesCount = setting(
        8,
        "most bases besides, which begin to act at some distance to one side of the mean, the strongest "
        "directions' first; none in clips of under 100 training frames",
    )
    edge_pixels: EdgePixels | None = setting(
        None,
        "of the bases: edges longer than this in a training frame are split; none: plan.edge_pixels, "
        "0: subdivisions as given",
    )
    subdivisions: Levels = setting(1, "levels of midpoint subdivision")
    subdivide_from: Fraction = setting(0.5, "fraction of the run before which the mesh stays unsubdivided")
    plane_resolution: Texels = setting(128, "texels along a side of each plane")
    plane_channels: Channels = setting(32, "features a texel")
    plane_deviation: Deviation = setting(0.01, "standard deviation of the planes' first features")
    width: Channels = setting(128, "hidden channels of the heads")
    groups: Channels = setting(8, "of the heads' GroupNorm; must divide width")
    offset_unit: Metres = setting(0.04, "metres that a static offset of 1 stands for")
    pose_offset_unit: Metres = setting(0.01, "metres that a pose-dependent offset of 1 stands for")
    scale: Size = setting(0.55, "initial standard deviation of a Gaussian, in mean edge lengths")
    thickness: Size = setting(0.5, "initial standard deviation along the normal, in those along the surface")
    inset: Inset = setting(
        0.7, "how far inside the body's surface bases begin, in Gaussians' standard deviations along it"
    )
    opacity: Opacity = setting(0.999, "of every Gaussian, or to begin with")
    learn_opacity: bool = setting(False, "each Gaussian has an opacity of its own")
    learn_identity: bool = setting(False, "betas and joint offsets move with the poses")
    correctives: Literal["all", "face_and_hands"] = setting(
        "all", "where the body model's pose correctives act; pose heads do not move head and hands"
    )
    plane_pose: Literal["own", "open"] = setting(
        "own", "rest mesh that the planes are laid over: the person's, or the mean's, legs and mouth open"
    )
    skinning: Literal["own", "nearest"] = setting(
        "own", "weights of the Gaussian's own vertex, or of the nearest: the one that it has come to lie at"
    )
    skin_every: Count = setting(100, "iterations between two looks at which vertex is nearest")
    pose_heads_from: Fraction = setting(
        0.4, "fraction of the run from which the pose heads take part; 1: never"
    )
    # A tenth to a seventh of a step at 40,000 Gaussians, nothing at 10,000; turned pictures and held-out
    # frames are the same (docs/log/2026-11.md).
    pose_seen_only: bool = setting(True, "pose and residual heads: only what the frame saw when last drawn")
    # Without it the heads learn each frame by heart.
    pose_noise: Deviation = setting(
        0.05,
        "standard deviation of the noise on each entry of the joints' rotation matrices that they are told",
    )
    initial_color: bool = setting(True, "colours start at what the training frames show, else at grey")
    color_frames: Count = setting(24, "training frames that first colours are looked for in")

    # Residual colours (Section 3.5). A part that the plan does not name gets no head.
    residual_parts: tuple[ResidualPart, ...] = setting(
        ("face", "left_hand", "right_hand"), "parts with a residual head; rest: the whole body, an ablation"
    )
    residual_moves: bool = setting(False, "move Gaussians, too: the ablation of the paper's supplement E.3")
    residual_from: Fraction = setting(
        0.5, "fraction of the run from which the residual heads take part; 1: never"
    )
    residual_ramp: Fraction = setting(0.0, "fraction of the run over which their colours come in evenly")
    residual_width: Channels = setting(64, "hidden channels; the authors' release has 256")
    residual_place: ResidualPlace = setting(
        "canonical", "what they are told of a Gaussian's place; posed: in the world"
    )
    place_frequencies: Frequencies = setting(6, "of that place's encoding, in the part's box (posed: metres)")
    time_frequencies: Frequencies = setting(6, "of the time's encoding, over the training frames' interval")
    time_dropout: Fraction = setting(0.2, "share of draws without a time, for motion that has none")

    # Visibility gate (Section 3.4); it acts only if the plan calls for it
    gate: bool = setting(True, "leave out what is seen too seldom")
    early_gate: bool = setting(True, "from the start: what lies in no training frame's picture")
    gate_from: Fraction = setting(
        0.1, "fraction of the run, the warm-up, after which scores are looked at; 1: never"
    )
    gate_every: Count = setting(50, "iterations between looks")
    gate_threshold: Threshold | None = setting(
        None, "scores below are gated; none: found in the scores (Otsu)"
    )
    gate_rule: Literal["evidence", "otsu"] = setting(
        "evidence", "Otsu's threshold only where little of what is seen goes with it, or as it is"
    )
    gate_rings: Rings = setting(2, "rings of neighbours added to what is left")
    unseen: Literal["completed", "generated", "base", "nothing"] = setting(
        "completed",
        "where no frame showed enough: completed from what frames showed of hair, cloth and skin; generated, "
        "as training left it; nothing; base, completed, and what the gate took as the fitted body",
    )

    # Optimiser
    learning_rate: LearningRate = setting(1e-3, "of the heads")
    plane_learning_rate: LearningRate = setting(5e-3, "of the triplane")
    color_learning_rate: LearningRate = setting(0.02, "of the bases' representation: static colours, logits")
    scale_learning_rate: LearningRate = setting(0.01, "likewise: log scales")
    offset_learning_rate: LearningRate = setting(0.01, "likewise: static offsets, in offset_unit")
    opacity_learning_rate: LearningRate = setting(0.01, "of opacities, logits, where they are learnt")
    bases_learning_rate: LearningRate = setting(0.002, "likewise: the linear bases")
    schedule: Literal["cosine", "steps"] = setting(
        "cosine", "of the rates; steps: a tenth after 75% of the run and a hundredth after 95%"
    )
    final_rate: Fraction = setting(0.05, "the cosine schedule's last factor")
    adam_beta2: Fraction = setting(0.99, "Adam's second beta; the first is 0.9")
    warm_up: CountOrNone = setting(20, "iterations")
    refine_poses: bool = setting(True, "optimise the training frames' poses too")
    refine_from: Fraction = setting(0.15, "fraction of the run from which they move")
    pose_learning_rate: LearningRate = setting(1e-4, "of rotations and expressions")
    transl_rate: Factor = setting(0.1, "times that, for transl: a translation moves every pixel at once")

    # Objective
    l1: Weight = setting(0.8, "lambda_L1")
    ssim: Weight = setting(0.2, "lambda_ssim")
    # Bases: nothing to a quarter less LPIPS, for 0.04 to 0.18 dB (docs/log/2026-11.md). The triplane loses
    # 0.6 dB on smile.
    lpips: Weight = setting(0.05, "lambda_lpips; the paper's is 0.2")
    lpips_network: LpipsNetwork = setting("alex", "its backbone; vgg is twenty times as dear on a CPU")
    lpips_every: Count = setting(2, "drawn frames for one that LPIPS looks at, with as many times the weight")
    lpips_crop: Pixels = setting(
        96, "pixels of the square around a random place of the person; 0: the whole view"
    )
    lpips_from: Fraction = setting(0.5, "fraction of the run from which it takes part")
    face: Weight = setting(0.0, "lambda_face; the paper's is 0.8")
    generated_every: Count = setting(5, "draws for one of a generated frame; the paper's is 2, equally often")
    generated_as_captured: bool = setting(False, "generated frames weigh as much as captured ones instead")
    generated: Weight = setting(0.1, "lambda_L1, lambda_ssim and lambda_lpips on generated frames")

    # ExAvatar renders a frame several times and compares each rendering: docs/paper.md counts.
    l1_renderings: Factor = setting(1.0, "renderings of a captured frame that lambda_L1 stands for")
    renderings: Factor = setting(1.0, "the same of SSIM, LPIPS, face, and all of generated frames")

    scene_share: Fraction = setting(
        0.0, "share of L1, and all of SSIM and LPIPS, over the clip's own background where the camera stands"
    )

    # Regularisers, each weighted with its value; the paper's values are in data/presets/paper.toml
    laplacian_offset: Weight = setting(1e3, "smoothness of static and of all offsets together")
    laplacian_offset_face: Weight = setting(1e3, "the same on the face")
    laplacian_scale: Weight = setting(0.02, "smoothness of scales")
    laplacian_scale_face: Weight = setting(0.02, "the same on the face")
    scale_smoothness: Literal["relative", "metres"] = setting(
        "relative", "scales whose smoothness that is: logarithms of multiples of the first ones, or metres"
    )
    laplacian_color: Weight = setting(0.002, "smoothness of colours")
    laplacian_color_hands: Weight = setting(0.002, "the same on the hands")
    offset: Weight = setting(10.0, "size of static offsets, metres squared")
    offset_hands: Weight = setting(1000.0, "the same on the hands")
    offset_face: Weight = setting(10.0, "the same on the face")
    offset_scalp: Weight = setting(10.0, "the same on the head without the face")
    pose_offset: Weight = setting(50.0, "size of pose-dependent offsets, metres squared")
    hand_normal: Weight = setting(0.0, "static offsets of the hands that point outwards")
    scale_size: Weight = setting(0.0, "size of scales, metres squared")
    scale_size_hands: Weight = setting(0.0, "the same on the hands")
    scale_size_face: Weight = setting(0.0, "the same on the face")
    pose_scale: Weight = setting(0.0, "size of pose-dependent changes of log scales")
    pose_scale_hands: Weight = setting(0.0, "the same on the hands")
    pose_scale_face: Weight = setting(0.0, "the same on the face")
    scale_growth: Weight = setting(0.002, "log scales above the initial ones")
    scale_shrink: Weight = setting(0.002, "log scales below the initial ones, at which neighbours cover")
    weak_smoothness: Factor = setting(
        10.0, "times more that smoothness counts where no frame showed enough, continuously"
    )
    calm_from: Fraction = setting(
        0.2,
        "fraction of the run from which colours of surface that frames saw from its edge alone are held to "
        "its segment's; 1: never",
    )
    joint_change: Weight = setting(0.0, "size of learnt joint offsets, metres squared; tenfold on the hands")
    joint_symmetry: Weight = setting(0.0, "differences of left and right joint offsets, metres")
    hand_color: Weight = setting(0.0, "differences of the hands' colours from their mean")
    arm_color: Weight = setting(0.0, "differences of the arms' lower sides from their upper sides")
    residual_size: Weight = setting(1e-3, "size of residual colours, in logits")
    pose_change: Weight = setting(0.0, "distance of refined poses from the fitted ones")

    crop_margin: Pixels = setting(8, "pixels around the person that the losses see")

    @model_validator(mode="after")
    def _fit_together(self) -> TrainSettings:
        if self.subdivisions and self.subdivide_from == 1:
            raise ValueError("train.subdivide_from must be less than 1, or train.subdivisions 0")
        if self.residual_from < 1 and self.residual_from + self.residual_ramp > 1:
            raise ValueError("train.residual_from and train.residual_ramp must add up to at most 1")
        if self.adam_beta2 == 1:
            raise ValueError("train.adam_beta2 must be less than 1")
        if self.width % self.groups:
            raise ValueError(f"train.groups must divide train.width, {self.width}, not be {self.groups}")
        if self.residual_width % self.groups:
            raise ValueError(
                f"train.residual_width must be divisible by train.groups, {self.groups}, "
                f"not be {self.residual_width}"
            )
        return self


def apply_plan(settings: TrainSettings, plan: Plan) -> TrainSettings:
    """The settings that training really runs with.

    What the plan calls needless is switched off; it switches nothing on. Numbers that are left to it are its.
    Then come the representation's own (``for_bases``).
    """
    needless = {part for part in PLANNED_RESIDUALS if not plan.on(f"{part}_residual")}
    parts = tuple(part for part in settings.residual_parts if part not in needless)
    density = plan["gaussians"]
    edge_pixels = density.threshold if density.on else 0.0
    applied = dataclasses.replace(
        settings,
        iterations=settings.iterations or planned_steps(settings, plan),
        edge_pixels=edge_pixels if settings.edge_pixels is None else settings.edge_pixels,
        residual_parts=parts,
        residual_from=settings.residual_from if parts else 1.0,
        subdivisions=min(settings.subdivisions, subdivision_levels(plan)),
        pose_heads_from=settings.pose_heads_from if plan.on("pose_heads") else 1.0,
        refine_poses=settings.refine_poses and plan.on("pose_refinement"),
        face=settings.face if plan.on("face_loss") else 0.0,
        gate=settings.gate and plan.on("visibility_gate"),
        bases=settings.bases if plan.on("pose_heads") else 0,
        bends=settings.bends if plan.on("pose_heads") else 0,
    )
    return for_bases(applied) if settings.representation == "bases" else applied


def planned_steps(settings: TrainSettings, plan: Plan) -> int:
    """The optimiser steps that the plan says, times ``effort``; the triplane's network needs more of them."""
    more = TRIPLANE_STEPS if settings.representation == "triplane" else 1.0
    return max(1, round(settings.effort * more * plan["steps"].values[0]))


def for_bases(settings: TrainSettings) -> TrainSettings:
    """The settings as linear bases need them.

    They are trained on the fine mesh from the first step: a subdivision on the way costs 4 to 5 dB, most of
    which is only won back. They follow the pose from the first step, too, without noise, and have no residual
    colours.
    """
    return dataclasses.replace(
        settings,
        subdivisions=0 if settings.edge_pixels else settings.subdivisions,
        subdivide_from=0.0,
        pose_heads_from=0.0 if settings.bases else 1.0,
        pose_seen_only=False,
        pose_noise=0.0,
        residual_parts=(),
        residual_from=1.0,
    )


def settings_without_effect(settings: TrainSettings) -> tuple[str, ...]:
    """The names of settings that differ from their defaults and that the representation does not read."""
    usual = TrainSettings()
    ignored = IGNORED[settings.representation]
    if settings.representation == "bases" and settings.edge_pixels != 0:
        ignored = (*ignored, "subdivisions")  # edges are split instead, unless the plan's decision is off
    return tuple(name for name in ignored if getattr(settings, name) != getattr(usual, name))


def learning_rates(settings: TrainSettings) -> tuple[str, ...]:
    """The names of the learning rates that are in use, the pictures' first."""
    opacity = ("opacity_learning_rate",) if settings.learn_opacity else ()
    if settings.representation == "triplane":
        return ("learning_rate", "plane_learning_rate", *opacity, "pose_learning_rate")
    own = ("color_learning_rate", "scale_learning_rate", "offset_learning_rate", "bases_learning_rate")
    return (*own, *opacity, "pose_learning_rate")


def subdivision_levels(plan: Plan) -> int:
    """The most levels of subdivision that the plan allows: all where a setting switched it on."""
    decision = plan["subdivision"]
    if not decision.on:
        return 0
    return MOST_LEVELS if decision.forced or not decision.values else int(decision.values[0])
