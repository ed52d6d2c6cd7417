"""What was saved by leaving an effect out: measured after training, for the report.

The networks that the plan left out are built for a moment, on the Gaussians that they would have had, and
a step of theirs is timed. Seconds go to run.json, since they differ between equal runs.
"""

from __future__ import annotations

import time

import torch

from pipeline.avatar import Avatar
from pipeline.avatar.heads import Head
from pipeline.avatar.residual import encode, part_rows
from pipeline.device import autocast
from stages.train.obey import RESIDUALS
from stages.train.settings import TrainSettings

REPEATS = 3

Saved = dict[str, dict[str, float]]
"""Effect -> what it would have cost: ``seconds``, or how many ``gaussians`` stand where none was needed."""


def saved(avatar: Avatar, vertices: int, wanted: TrainSettings, obeyed: TrainSettings) -> Saved:
    """The costs of what settings wanted and the plan left out, and what the gate took.

    Args:
        avatar: trained.
        vertices: of the whole body.
        wanted: the settings as set.
        obeyed: the settings after the plan was heard.
    """
    found: Saved = {}
    gated = vertices - int(avatar.active.sum())
    if gated:
        found["visibility_gate"] = {"gaussians": float(gated)}
    lost = wanted.subdivisions - obeyed.subdivisions
    if lost:  # a level makes four Gaussians of one
        found["subdivision"] = {"gaussians": float(len(avatar) * (4**lost - 1))}
    if wanted.pose_heads_from < 1 and obeyed.pose_heads_from == 1:
        steps = wanted.iterations * (1 - wanted.pose_heads_from)
        found["pose_heads"] = {"seconds": steps * _pose_heads(avatar)}
    for part in RESIDUALS:
        if wanted.residual_from < 1 and part in wanted.residual_parts and part not in obeyed.residual_parts:
            steps = wanted.iterations * (1 - wanted.residual_from)
            found[f"{part}_residual"] = {"seconds": steps * _residual(avatar, part)}
    return found


def _pose_heads(avatar: Avatar) -> float:
    """Seconds of a step of both pose heads."""
    sizes, features, pose = avatar.architecture, avatar.triplane.features, 6 * _joints(avatar)
    rows, hidden = len(avatar), {"width": sizes.width, "groups": sizes.groups}
    heads = [Head(features, 6, condition=pose, **hidden), Head(features + 3, 3, condition=pose, **hidden)]
    return sum(_timed(avatar, head, torch.zeros(rows, head.first.in_features), pose) for head in heads)


def _residual(avatar: Avatar, part: str) -> float:
    """Seconds of a step of one part's residual head; 0 where the avatar has nothing of the part."""
    rows = part_rows(avatar.surface().canonical, (part,)).get(part)
    if rows is None:
        return 0.0
    sizes = avatar.architecture
    condition = 1 + 2 * sizes.time_frequencies + 6 * _joints(avatar)
    points = encode(torch.zeros(len(rows), 3), sizes.place_frequencies)
    head = Head(points.shape[1], 3, condition=condition, width=sizes.residual_width, groups=sizes.groups)
    return _timed(avatar, head, points, condition)


def _joints(avatar: Avatar) -> int:
    return len(avatar.surfaces[0].canonical.joints) - 1


def _timed(avatar: Avatar, head: Head, points: torch.Tensor, condition: int) -> float:
    """Seconds of the fastest forward and backward pass; the first one is not counted."""
    spent, device = [], avatar.device
    head, points, shared = head.to(device), points.to(device), torch.zeros(condition, device=device)
    for _ in range(1 + REPEATS):
        start = time.perf_counter()
        with autocast(device, avatar.half_precision):
            result = head(points.requires_grad_(), shared)
        result.float().sum().backward()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        spent.append(time.perf_counter() - start)
    return min(spent[1:])
