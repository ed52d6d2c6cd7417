"""Colours of what the visibility gate took."""

from __future__ import annotations

import torch
from torch import Tensor

from pipeline.avatar import Avatar
from pipeline.avatar.color_bounds import BRIGHTEST, DARKEST
from pipeline.avatar.sparse import SparsePair

FILL_ROUNDS = 16  # rings over which gated vertices take their neighbours' colour


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
