"""The avatar before training: the vertices that get a Gaussian, and their colours."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import torch
from torch import Tensor

from pipeline.avatar import Architecture, Avatar, ClipConditions, pose_features
from pipeline.avatar.canonical import dilate
from pipeline.avatar.completion import complete_color_logits
from pipeline.avatar.density import DENSITY_FRAMES, choose_splits, project_surface
from pipeline.avatar.driving_signal import fit_driving_signal, signal_features
from pipeline.clip.frames import spread_from_start
from pipeline.device import moved
from pipeline.errors import UserError
from pipeline.finite import require_finite
from stages.train.data import TrainingData
from stages.train.frame_evidence import evidence_of
from stages.train.poses import PoseRefinement
from stages.train.settings import TrainSettings
from stages.train.visibility_gate import ever_in_frame

FRAMES_TO_BEND = 100  # training frames: smile's 65 gain nothing by bends, carphone's 108 half a decibel
FRAMES_A_BASIS = 8  # training frames for one more: with fewer it learns the clip by heart


def initial_avatar(
    data: TrainingData,
    refinement: PoseRefinement,
    settings: TrainSettings,
    log: Callable[[str], None] = lambda line: None,
) -> tuple[Avatar, TrainingData]:
    """The untrained avatar in its initial colours, on the device of the poses.

    Args:
        data: what it will be learnt from.
        refinement: the fitted poses.
        settings: with the plan applied.
        log: for a line with the numbers of vertices and Gaussians.

    Returns:
        The avatar, and the data with the texture of the face loss where that has a weight.

    Raises:
        UserError: no training frame has any of the body in its picture.
    """
    kept = kept_vertices(data, refinement, settings)
    # What is shown in its base colours in the end belongs to the avatar, though it is never trained.
    rows = torch.nonzero(kept | (settings.unseen == "base"))[:, 0]
    clip, conditions = data.clip, clip_conditions(data)
    sizes = architecture(settings, conditions, clip.body.expression_directions.shape[-1])
    splits = splits_of(data, refinement, rows, settings)
    half = settings.half_precision
    avatar = Avatar(clip.body, clip.identity, rows, sizes, settings.seed, half, splits)
    avatar.to(refinement.poses.rotation.device)
    avatar.pose_heads_active = avatar.residuals_active = False
    avatar.representation.set_clip(moved(conditions, avatar.device))
    if settings.initial_color or settings.face:
        captured, made = (spread_from_start(frames, settings.color_frames) for frames in data.sources)
        evidence = evidence_of(avatar.eval(), refinement, data, captured, made)
        avatar.trust.copy_(evidence.together)
        logits = complete_color_logits(avatar.surface(), evidence)
        if settings.face:
            data = dataclasses.replace(data, texture=torch.sigmoid(logits))
        if settings.initial_color:
            avatar.base_color.copy_(logits)
    avatar.gate(kept[rows].to(avatar.device))
    log(
        f"{int(kept.sum())} of {len(kept)} body vertices are kept, {len(avatar)} Gaussians; "
        f"{described(avatar)}"
    )
    return avatar.train(), data


def kept_vertices(data: TrainingData, refinement: PoseRefinement, settings: TrainSettings) -> Tensor:
    """The body vertices that get a Gaussian to begin with, [V] bool on the CPU.

    Raises:
        UserError: no training frame has any of the body in its picture.
    """
    clip = data.clip
    everything = torch.arange(len(clip.body.v_template))
    bare = Architecture(plane_resolution=2, plane_channels=1, subdivisions=0)
    body = Avatar(clip.body, clip.identity, everything, bare).to(refinement.poses.rotation.device)
    seen = ever_in_frame(body, refinement, data.crops, clip.split.train)
    if not bool(seen.any()):
        raise UserError("the fitted body is outside every frame; run fit again")
    if not (settings.gate and settings.early_gate):
        return torch.ones(len(seen), dtype=torch.bool)
    # The rings are what offsets and refined poses may bring in.
    return dilate(seen, body.surfaces[0].canonical.faces, settings.gate_rings).cpu()


def splits_of(
    data: TrainingData, refinement: PoseRefinement, vertex_ids: Tensor, settings: TrainSettings
) -> tuple[Tensor, ...]:
    """The edges that are split before training, see ``pipeline.avatar.density``; none for a triplane."""
    if settings.representation == "triplane" or not settings.edge_pixels:
        return ()
    clip = data.clip
    bare = Architecture(plane_resolution=2, plane_channels=1, subdivisions=0)
    surface = Avatar(clip.body, clip.identity, vertex_ids, bare).surfaces[0]
    frames = [(clip.pose(frame), data.crops.camera(frame)) for frame in clip.spread(DENSITY_FRAMES)]
    return choose_splits(surface.canonical.faces, project_surface(surface, frames), settings.edge_pixels)


def clip_conditions(data: TrainingData) -> ClipConditions:
    """The fitted poses, expressions and times of the captured training frames, on the CPU.

    Raises:
        NotFiniteError: a pose or an expression is not finite; names the frame.
    """
    clip = data.clip
    poses = [clip.pose(frame) for frame in clip.split.train]
    for frame, pose in zip(clip.split.train, poses, strict=True):
        told = {"the fitted pose": pose.rotation, "the fitted expression": pose.expression}
        require_finite(told, "training", f"in frame {frame}", "run the fit stage again")
    seconds = clip.seconds
    return ClipConditions(
        theta=torch.stack([pose_features(pose.rotation) for pose in poses]),
        expression=torch.stack([pose.expression for pose in poses]),
        seconds=tuple(seconds[frame] for frame in clip.split.train if frame in seconds),
    )


def architecture(settings: TrainSettings, conditions: ClipConditions, expressions: int) -> Architecture:
    """The part of the settings that an avatar's file has to remember; no more bases than the clip drives.

    Args:
        settings: with the plan applied.
        conditions: of the training frames.
        expressions: of the body.
    """
    chosen = {"pose_heads", "bases", "bends"}
    names = [field.name for field in dataclasses.fields(Architecture) if field.name not in chosen]
    remembered = {name: getattr(settings, name) for name in names}
    remembered["residual_parts"] = () if settings.residual_from == 1 else settings.residual_parts
    if settings.representation == "triplane":
        remembered["inset"] = 0.0  # its meshes change on the way, and each would have another
        return Architecture(**remembered, pose_heads=settings.pose_heads_from < 1)
    remembered |= {"plane_resolution": 2, "plane_channels": 1}  # there are no planes
    features = signal_features(conditions.theta, conditions.expression, expressions)
    few_frames = max(1, len(features) // FRAMES_A_BASIS)
    signal = fit_driving_signal(features, min(settings.bases, few_frames))
    if len(features) >= FRAMES_TO_BEND:
        signal = signal.bent(settings.bends)
    bases, bends = len(signal), signal.bends
    return Architecture(**remembered, pose_heads=bases > 0, bases=bases, bends=bends)


def described(avatar: Avatar) -> str:
    """The representation in a few words, for the log."""
    if avatar.architecture.representation == "bases":
        bends = f", {avatar.architecture.bends} of them bends" if avatar.architecture.bends else ""
        return f"bases: {avatar.architecture.bases} driven by pose and face{bends}"
    parts = ", ".join(region.part for region in avatar.surface().residual) or "no part"
    return f"triplane; residual colours of: {parts}"
