"""What the training frames show of the body before training: which vertices to keep, and their colours.

A clip of a head says nothing about the feet. Where no training frame has a vertex in its picture, the
score of the paper's Section 3.4 is zero whatever training does, and the gate (``gate.py``) would take it
out after the warm-up; so it gets no Gaussian to begin with. That saves the warm-up's time, and the
triplane is fitted to what is left.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from pipeline.avatar import Avatar
from pipeline.avatar.canonical import dilate
from pipeline.avatar.sparse import SparsePair
from pipeline.device import moved
from pipeline.splat import Gaussians, render
from pipeline.visibility import body_in_frame
from stages.train.data import Frames
from stages.train.poses import PoseRefinement

DARKEST, BRIGHTEST = 0.02, 0.98  # first colours stay where the sigmoid still has a slope
BELIEVED = 0.5  # trust from which a pixel of a generated frame has a say in first colours
INSIDE = 0.5 + 0.125**0.5  # alpha beyond which a pixel has a say: a coin of that mean has half the variance
THROUGH = 0.1  # of the weight in generated frames, under which what captured frames show is not the surface
SPREAD_ROUNDS = 16  # rings over which unseen vertices take their neighbours' colour


def ever_in_frame(avatar: Avatar, poses: PoseRefinement, views: Frames, frames: tuple[int, ...]) -> Tensor:
    """The body vertices that lie in the picture of at least one of the frames, [K] bool.

    Args:
        avatar: untrained.
        poses: of every frame.
        views: the cameras.
        frames: frame numbers.
    """
    seen = torch.zeros(len(avatar.kept), dtype=torch.bool, device=avatar.device)
    for frame in frames:
        pose = poses.fitted(frame)
        camera = moved(views.camera(frame), avatar.device)
        seen |= body_in_frame(avatar.surfaces[0], pose.rotation, pose.transl, camera)
    return seen


def with_surroundings(avatar: Avatar, seen: Tensor, rings: int) -> Tensor:
    """What is seen and ``rings`` rings of neighbours: what offsets and refined poses may bring in."""
    return dilate(seen, avatar.surfaces[0].canonical.faces, rings)


def fill_unseen(avatar: Avatar) -> None:
    """Gives what is gated the colours of what is next to it, for ``Avatar.unseen = "base"``."""
    full, surface = avatar.surfaces[-1], avatar.surface()
    if surface.rows is None:
        return
    with torch.no_grad():
        color = torch.zeros(len(full.canonical), 3, device=avatar.device)
        color[surface.rows] = torch.sigmoid(avatar.decode().color_logit)
        known = torch.zeros(len(color), 1, device=avatar.device)
        known[surface.rows] = 1
        filled = torch.logit(fill(color, known, full.neighbours).clamp(DARKEST, BRIGHTEST))
        avatar.base_color.copy_(torch.where(known > 0, avatar.base_color, filled))


def first_colors(
    avatar: Avatar,
    poses: PoseRefinement,
    views: Frames,
    chosen: tuple[int, ...],
    made: tuple[int, ...] = (),
) -> Tensor:
    """Logits of the mean colour that the chosen frames show at each Gaussian, [N, 3].

    The weights of that mean are the blending weights. They come from the renderer's own backward
    pass: the derivative of ``sum(rendering * picture)`` with respect to a Gaussian's colour is the
    sum of the pixels that it covers, each times its blending weight there.

    Args:
        avatar: untrained.
        poses: of every frame.
        views: the frames.
        chosen: frame numbers.
        made: generated frames; they are asked for what no chosen frame shows.
    """
    total, weight = _shown(avatar, poses, views, chosen)
    if made:
        total_made, weight_made = _shown(avatar, poses, views, made)
        # A little of what lies behind shines through: a back has weight in a front view, and its colours.
        unseen = weight / len(chosen) < THROUGH * weight_made / len(made)
        total, weight = torch.where(unseen, total_made, total), torch.where(unseen, weight_made, weight)
    neighbours = avatar.surfaces[-1].neighbours
    return torch.logit(fill(total, weight, neighbours).clamp(DARKEST, BRIGHTEST))


def _shown(
    avatar: Avatar, poses: PoseRefinement, views: Frames, chosen: tuple[int, ...]
) -> tuple[Tensor, Tensor]:
    """Colours that some frames show at each Gaussian, summed by blending weight, and the weights.

    Returns:
        [N, 3] and [N, 1].
    """
    total, weight = (torch.zeros(len(avatar), width, device=avatar.device) for width in (3, 1))
    for frame in chosen:
        view = moved(views[frame], avatar.device)
        with torch.no_grad():
            gaussians = _gaussians(avatar, poses, frame)
        colors = gaussians.colors.clone().requires_grad_()
        color = render(dataclasses.replace(gaussians, colors=colors), view.camera).color
        # All or nothing: a mean does not feel a small weight that all of its members share.
        believed = view.alpha > INSIDE
        if view.trust is not None:
            believed &= view.trust >= BELIEVED
        person = believed.float()[..., None]
        total += torch.autograd.grad((color * view.color * person).sum(), colors, retain_graph=True)[0]
        weight += torch.autograd.grad((color[..., :1] * person).sum(), colors)[0][:, :1]
    return total, weight


def fill(total: Tensor, weight: Tensor, neighbours: SparsePair) -> Tensor:
    """Mean colours, [N, 3]; what has no weight takes those of its neighbours, then the overall mean."""
    known = (weight > 0).float()
    color = total / weight.clamp_min(1e-12) * known
    overall = total.sum(0) / weight.sum().clamp_min(1e-12)
    for _ in range(SPREAD_ROUNDS):
        near, share = neighbours @ (color * known), neighbours @ known
        reached = (known == 0) & (share > 0)
        color = torch.where(reached, near / share.clamp_min(1e-12), color)
        known = torch.where(reached, 1.0, known)
    return torch.where(known > 0, color, overall)


def _gaussians(avatar: Avatar, poses: PoseRefinement, frame: int) -> Gaussians:
    pose = poses.fitted(frame)
    return avatar.gaussians(pose.rotation, pose.expression, pose.transl)
