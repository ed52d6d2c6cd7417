"""The evidence that training frames give of an avatar, and what is done with it when training has ended."""

from __future__ import annotations

from collections.abc import Iterator

import torch

from pipeline.avatar import Avatar
from pipeline.avatar.canonical import dilate
from pipeline.avatar.completion import complete_avatar
from pipeline.avatar.evidence import Evidence, covering, gather_evidence
from pipeline.avatar.representation import Decoded
from pipeline.clip.frames import spread_from_start
from pipeline.clip.views import View
from pipeline.device import moved
from pipeline.splat import Gaussians
from stages.train.data import TrainingData
from stages.train.poses import PoseRefinement
from stages.train.settings import TrainSettings


def evidence_of(
    avatar: Avatar,
    poses: PoseRefinement,
    data: TrainingData,
    captured: tuple[int, ...],
    made: tuple[int, ...] = (),
    cover: bool = True,
) -> Evidence:
    """The evidence of an avatar's ungated Gaussians, in the poses as they now are.

    Args:
        avatar: as trained so far.
        poses: of every frame.
        data: the frames.
        captured: frame numbers, at least one.
        made: generated frames; they are asked for what no captured frame shows.
        cover: of Gaussians that are all large enough to cover, else of the avatar as it is.
    """
    with torch.no_grad():
        decoded = covering(avatar.decode()) if cover else avatar.decode()

    def gathered(frames: tuple[int, ...]) -> Evidence:
        return gather_evidence(in_frames(avatar, decoded, poses, data, frames), decoded.surface)

    return gathered(captured).filled(gathered(made)) if made else gathered(captured)


def in_frames(
    avatar: Avatar, decoded: Decoded, poses: PoseRefinement, data: TrainingData, frames: tuple[int, ...]
) -> Iterator[tuple[Gaussians, View]]:
    """For each frame what was decoded of an avatar in its pose, and the frame, on the avatar's device."""
    for frame in frames:
        with torch.no_grad():
            posed = avatar.pose(decoded, poses(frame), time=data.clip.seconds.get(frame))
        yield posed.gaussians, moved(data.view(frame), avatar.device)


def settle_unseen(
    avatar: Avatar, poses: PoseRefinement, data: TrainingData, settings: TrainSettings
) -> Evidence:
    """Gives an avatar, after training, what ``train.unseen`` says where no frame showed enough.

    Args:
        avatar: trained; it is changed.
        poses: as training left them.
        data: that it was learnt from.
        settings: of the stage.

    Returns:
        The evidence that this was decided by.
    """
    captured, made = (spread_from_start(frames, settings.color_frames) for frames in data.sources)
    evidence = evidence_of(avatar, poses, data, captured, made)
    # What shows between others does so in most frames: half of them tell.
    evidence = evidence.with_colors_of(
        evidence_of(avatar, poses, data, captured[::2], made[::2], cover=False)
    )
    rows = avatar.surface().pick(torch.arange(len(avatar.trust), device=avatar.device))
    avatar.trust.index_copy_(0, rows, evidence.together)
    avatar.representation.forget_unseen(avatar.trust.amax(1) > 0)
    if settings.unseen in ("completed", "base"):
        complete_avatar(
            avatar, evidence, lambda decoded: in_frames(avatar, decoded, poses, data, captured[::2])
        )
    if settings.unseen == "nothing":
        leave_seen(avatar)
    return evidence


def leave_seen(avatar: Avatar) -> None:
    """Gates the body vertices that no frame showed, one ring around the others excepted."""
    coarse = avatar.surfaces[0].canonical
    seen = dilate(avatar.trust[: len(coarse), 1] > 0, coarse.faces, rings=1) & avatar.active
    if bool(seen.any()):
        avatar.gate(seen)
