"""What the training frames show of the body: which vertices to keep, and their first colours.

A clip of a head says nothing about the feet. Before training, the fitted body is rendered in some
training frames; what none of them shows, and is not next to something shown, gets no Gaussian at
all (the idea of the paper's Section 3.4, applied once and early).
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pyarrow as pa
import torch
from torch import Tensor

from pipeline.avatar import Avatar
from pipeline.avatar.canonical import dilate
from pipeline.camera import project
from pipeline.splat import Gaussians, render
from pipeline.tables import write_table
from stages.train.data import Frames, View
from stages.train.losses import trust
from stages.train.poses import PoseRefinement

SCHEMA = pa.schema(
    [
        ("vertex", pa.int32()),
        ("frames", pa.int32()),
        ("weight", pa.float32()),
        ("kept", pa.bool_()),
        ("generated", pa.int32()),
    ]
)
DARKEST, BRIGHTEST = 0.02, 0.98  # first colours stay where the sigmoid still has a slope
BELIEVED = 0.5  # trust from which a pixel has a say in first colours
SPREAD_ROUNDS = 16  # rings over which unseen vertices take their neighbours' colour


@dataclasses.dataclass(frozen=True)
class Visibility:
    """Evidence for each body vertex.

    Attributes:
        looked_at: how many frames were rendered.
        frames: [V] int64, in how many of them the vertex contributed to the image.
        weight: [V], its blending weight summed over pixels and frames.
        kept: [V] bool, whether it carries a Gaussian.
        generated: [V] int64, in how many generated frames it contributed; counted apart, so that what a
            model made up never passes for something that was seen. All zero if not given.
    """

    looked_at: int
    frames: Tensor  # [V]
    weight: Tensor  # [V]
    kept: Tensor  # [V]
    generated: Tensor = None  # type: ignore[assignment]  # [V]; never None once it is made

    def __post_init__(self) -> None:
        """Without generated frames nothing is seen in them."""
        if self.generated is None:
            object.__setattr__(self, "generated", torch.zeros_like(self.frames))


def measure(
    avatar: Avatar,
    poses: PoseRefinement,
    views: Frames,
    chosen: tuple[int, ...],
    rings: int,
    made: tuple[int, ...] = (),
) -> Visibility:
    """Renders the fitted body in the chosen frames.

    Args:
        avatar: untrained, unsubdivided and with every body vertex.
        poses: of every frame.
        views: the cameras.
        chosen: frame numbers.
        rings: of neighbours that are kept with what was seen.
        made: numbers of generated frames, in which a vertex may be seen as well.
    """
    frames, weight = _counted(avatar, poses, views, chosen)
    generated = _counted(avatar, poses, views, made)[0]
    kept = dilate((frames > 0) | (generated > 0), avatar.surfaces[0].canonical.faces, rings)
    return Visibility(len(chosen), frames, weight, kept, generated)


@torch.no_grad()
def _counted(
    avatar: Avatar, poses: PoseRefinement, views: Frames, chosen: tuple[int, ...]
) -> tuple[Tensor, Tensor]:
    """In how many frames each vertex contributed, and its blending weight over all of them, [V] each.

    In a generated frame only what lies within its mask counts: it is cropped to what the clip frames.
    """
    frames, weight = torch.zeros(len(avatar), dtype=torch.long), torch.zeros(len(avatar))
    for frame in chosen:
        view, gaussians = views[frame], _gaussians(avatar, poses, frame)
        rendering = render(gaussians, view.camera)
        seen = rendering.weights > 0
        if view.generated:
            seen &= _within(view, gaussians.means)
        frames += seen
        weight += rendering.weights
    return frames, weight


def _within(view: View, points: Tensor) -> Tensor:
    """Whether points fall on the person in a frame, [N, 3] -> [N] bool."""
    columns, rows = project(view.camera, points).floor().long().unbind(1)
    inside = (columns >= 0) & (rows >= 0) & (columns < view.camera.width) & (rows < view.camera.height)
    place = rows.clamp(0, view.camera.height - 1), columns.clamp(0, view.camera.width - 1)
    return inside & (view.alpha[place] > 0.5)


def write_visibility(path: Path, visibility: Visibility) -> None:
    """Writes ``visibility.parquet``: a row a body vertex."""
    columns = {
        "vertex": np.arange(len(visibility.frames)),
        "frames": visibility.frames.numpy(),
        "weight": visibility.weight.numpy(),
        "kept": visibility.kept.numpy(),
        "generated": visibility.generated.numpy(),
    }
    write_table(path, SCHEMA, columns)


def first_colors(
    avatar: Avatar,
    poses: PoseRefinement,
    views: Frames,
    chosen: tuple[int, ...],
    band: int = 0,
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
        band: pixels on either side of the silhouette where the mask is in doubt. What is seen there
            alone takes its neighbours' colour, not that of the background which the mask may hold.
        made: generated frames; they are asked for what no chosen frame shows.
    """
    total, weight = _shown(avatar, poses, views, chosen, band)
    if made:
        total_made, weight_made = _shown(avatar, poses, views, made, band)
        unseen = weight == 0
        total, weight = torch.where(unseen, total_made, total), torch.where(unseen, weight_made, weight)
    neighbours = avatar.surfaces[-1].neighbours
    return torch.logit(_fill(total, weight, neighbours).clamp(DARKEST, BRIGHTEST))


def _shown(
    avatar: Avatar, poses: PoseRefinement, views: Frames, chosen: tuple[int, ...], band: int
) -> tuple[Tensor, Tensor]:
    """Colours that some frames show at each Gaussian, summed by blending weight, and the weights.

    Returns:
        [N, 3] and [N, 1].
    """
    total, weight = torch.zeros(len(avatar), 3), torch.zeros(len(avatar), 1)
    for frame in chosen:
        view = views[frame]
        with torch.no_grad():
            gaussians = _gaussians(avatar, poses, frame)
        colors = gaussians.colors.clone().requires_grad_()
        color = render(dataclasses.replace(gaussians, colors=colors), view.camera).color
        # All or nothing: a mean does not feel a small weight that all of its members share.
        believed = trust(view.alpha, band) >= BELIEVED
        person = (believed & (view.alpha > 0.5)).float()[..., None]
        total += torch.autograd.grad((color * view.color * person).sum(), colors, retain_graph=True)[0]
        weight += torch.autograd.grad((color[..., :1] * person).sum(), colors)[0][:, :1]
    return total, weight


def _fill(total: Tensor, weight: Tensor, neighbours) -> Tensor:
    """Mean colours; what has no weight takes those of its neighbours, then the overall mean."""
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
