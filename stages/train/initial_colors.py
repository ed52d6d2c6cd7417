"""Colours at the start of training, from what the frames show, and colours of what no frame showed."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from pipeline.avatar import Avatar
from pipeline.avatar.sparse import SparsePair
from pipeline.device import moved
from pipeline.splat import Gaussians, render
from stages.train.data import TrainingData
from stages.train.poses import PoseRefinement

DARKEST, BRIGHTEST = 0.02, 0.98  # initial colours stay where the sigmoid still has a slope
LEAST_TRUST = 0.5  # from which a pixel of a generated frame counts
LEAST_ALPHA = 0.5 + 0.125**0.5  # above which a pixel counts: 4 a (1 - a), the mask's variance, is under 1/2
# A Gaussian whose mean weight in captured frames is under this share of that in generated ones only shines
# through the surface there.
SHINES_THROUGH = 0.1
FILL_ROUNDS = 16  # rings over which unseen vertices take their neighbours' colour


def color_unseen(avatar: Avatar) -> None:
    """Gives gated vertices the colours of their neighbours, for ``Avatar.unseen = "base"``."""
    full, surface = avatar.surfaces[-1], avatar.surface()
    if surface.rows is None:
        return
    with torch.no_grad():
        color = torch.zeros(len(full.canonical), 3, device=avatar.device)
        color[surface.rows] = torch.sigmoid(avatar.decode().color_logit)
        known = torch.zeros(len(color), 1, device=avatar.device)
        known[surface.rows] = 1
        filled = torch.logit(fill_from_neighbours(color, known, full.neighbours).clamp(DARKEST, BRIGHTEST))
        avatar.base_color.copy_(torch.where(known > 0, avatar.base_color, filled))


def initial_color_logits(
    avatar: Avatar,
    poses: PoseRefinement,
    data: TrainingData,
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
        data: the frames.
        chosen: frame numbers.
        made: generated frames; they are asked for what no chosen frame shows.
    """
    total, weight = _summed_colors(avatar, poses, data, chosen)
    if made:
        total_made, weight_made = _summed_colors(avatar, poses, data, made)
        # A little of what lies behind shines through: a back has weight in a front view, and its colours.
        unseen = weight / len(chosen) < SHINES_THROUGH * weight_made / len(made)
        total, weight = torch.where(unseen, total_made, total), torch.where(unseen, weight_made, weight)
    neighbours = avatar.surfaces[-1].neighbours
    return torch.logit(fill_from_neighbours(total, weight, neighbours).clamp(DARKEST, BRIGHTEST))


def _summed_colors(
    avatar: Avatar, poses: PoseRefinement, data: TrainingData, chosen: tuple[int, ...]
) -> tuple[Tensor, Tensor]:
    """The colours that frames show at each Gaussian, summed by blending weight, and the summed weights.

    Returns:
        [N, 3] and [N, 1].
    """
    total, weight = (torch.zeros(len(avatar), width, device=avatar.device) for width in (3, 1))
    for frame in chosen:
        view = moved(data.view(frame), avatar.device)
        with torch.no_grad():
            gaussians = _gaussians(avatar, poses, frame)
        colors = gaussians.colors.clone().requires_grad_()
        color = render(dataclasses.replace(gaussians, colors=colors), view.camera).color
        # All or nothing: a mean does not feel a small weight that all of its members share.
        person = view.alpha > LEAST_ALPHA
        if view.trust is not None:
            person &= view.trust >= LEAST_TRUST
        counts = person.float()[..., None]
        total += torch.autograd.grad((color * view.color * counts).sum(), colors, retain_graph=True)[0]
        weight += torch.autograd.grad((color[..., :1] * counts).sum(), colors)[0][:, :1]
    return total, weight


def fill_from_neighbours(total: Tensor, weight: Tensor, neighbours: SparsePair) -> Tensor:
    """Mean colours, [N, 3]; vertices without weight take their neighbours' colours, else the overall mean."""
    known = (weight > 0).float()
    color = total / weight.clamp_min(1e-12) * known
    overall = total.sum(0) / weight.sum().clamp_min(1e-12)
    for _ in range(FILL_ROUNDS):
        near, share = neighbours @ (color * known), neighbours @ known
        reached = (known == 0) & (share > 0)
        color = torch.where(reached, near / share.clamp_min(1e-12), color)
        known = torch.where(reached, 1.0, known)
    return torch.where(known > 0, color, overall)


def _gaussians(avatar: Avatar, poses: PoseRefinement, frame: int) -> Gaussians:
    return avatar.gaussians(poses.fitted(frame))
