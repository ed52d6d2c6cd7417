"""The avatar in a pose, as Gaussians."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from pipeline.avatar import Avatar, Surface, pose_features
from pipeline.avatar.bake import BakedAvatar, bake
from pipeline.body import PARTS, BodyModel, Pose, Poses, part_labels
from pipeline.splat import Gaussians

_LEGS = ("left_leg", "right_leg")


@dataclasses.dataclass(frozen=True)
class PoseRange:
    """The range of poses in the training frames.

    Attributes:
        low, high: [324], of ``pose_features``.
    """

    low: Tensor
    high: Tensor

    @classmethod
    def of(cls, poses: Poses, frames: tuple[int, ...]) -> PoseRange:
        """The range of some frames of a clip."""
        rows = [row for row, frame in enumerate(poses.frames) if frame in set(frames)]
        features = torch.stack([pose_features(poses.rotation[row]) for row in rows])
        return cls(features.amin(0), features.amax(0))

    def nearest(self, pose: Pose) -> Tensor:
        """The features of the nearest pose in the range, [324], which the networks are given."""
        return pose_features(pose.rotation).clamp(self.low, self.high)


@dataclasses.dataclass(frozen=True)
class Actor:
    """An avatar ready to be moved.

    Attributes:
        avatar: as it was trained.
        baked: the same with everything done that does not depend on the pose; None to do without.
        known: what the heads may be told; None: whatever the pose is.
        extra: what the clip did not show and is shown all the same, in its base colours; None for nothing.
        parts: [N] int64, the part of each Gaussian, an index into ``PARTS``.
    """

    avatar: Avatar
    baked: BakedAvatar | None
    known: PoseRange | None
    extra: Surface | None
    parts: Tensor

    def __len__(self) -> int:
        """The number of Gaussians."""
        return len(self.parts)

    @torch.no_grad()
    def gaussians(self, pose: Pose) -> Gaussians:
        """The avatar in a pose, world coordinates.

        There is no clock: the motion was not filmed (see ``pipeline.avatar.residual``).
        """
        theta = self.known.nearest(pose) if self.known is not None else None
        source = self.avatar if self.baked is None else self.baked
        seen = source.gaussians(pose, time=None, theta=theta)
        if self.extra is None:
            return seen
        bare = self.avatar.base_gaussians(self.extra, pose)
        return Gaussians(*(torch.cat(pair) for pair in zip(seen.tensors(), bare.tensors(), strict=True)))


@torch.no_grad()
def make_actor(avatar: Avatar, baking: bool, unseen: str, known: PoseRange | None) -> Actor:
    """An avatar ready to be moved; its ``unseen`` is changed.

    Args:
        avatar: as it was loaded.
        baking: whether it is baked.
        unseen: ``nothing``, ``base``, or ``auto`` for what the avatar itself says.
        known: see ``Actor``.
    """
    shows = avatar.unseen if unseen == "auto" else unseen
    gated = not bool(avatar.active.all())
    extra = avatar.unseen_surface() if shows == "base" and gated else None
    avatar.unseen = "nothing"  # what was gated is added here, to a baked avatar as to one that is not
    parts = avatar.surface().canonical.parts
    parts = parts if extra is None else torch.cat([parts, extra.canonical.parts])
    return Actor(avatar, bake(avatar) if baking else None, known, extra, parts)


def legs_share(avatar: Avatar, body: BodyModel) -> float:
    """The share of the body's legs that the avatar has Gaussians for."""
    labels = part_labels(body).long()
    legs = torch.isin(labels, torch.tensor([PARTS.index(name) for name in _LEGS]))
    kept = avatar.vertex_ids[avatar.active.cpu()]
    return float(legs[kept].sum()) / max(float(legs.sum()), 1.0)
