"""What completion would spoil of the filmed pictures keeps the size that training gave it.

Guessed Gaussians are made wide enough to cover. Just beyond a silhouette such a one stands out of it, in
frames where training had made it vanish. So the frames are drawn with the trained sizes and with the
completed ones, and each Gaussian is told by how much the pixels that it is in got worse. (Holes that this
leaves are closed nonetheless, see ``completion.py``.)

Thickness likewise: what frames saw squarely is as thick as it began, since they do not care, and from its
side it stands out of the outline. So all are made thinner, but for those whose frames do care.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from pipeline.avatar.evidence import ramp
from pipeline.avatar.representation import Decoded
from pipeline.clip.views import View
from pipeline.splat import Gaussians, picture_sums, render

Shown = Callable[[Decoded], Iterable[tuple[Gaussians, View]]]
"""What was decoded -> for each of some frames the avatar in its pose, and the frame, on its device."""

EVERY = 2  # of the frames tells what a few large Gaussians spoil; all are asked where all change
SPOILT = 0.003, 0.02  # mean error more, in [0, 1]: from none to all of the change of size is taken back
HARDLY_SPOILT = 0.0002, 0.0015  # the same where all Gaussians change at once
THIN = -0.6  # log scale along the normal
LEAST_WEIGHT = 1e-3  # pixels, under which a Gaussian spoils nothing


@torch.no_grad()
def with_sizes_spared(
    trained: Decoded,
    completed: Decoded,
    shown: Shown,
    limits: tuple[float, float] = SPOILT,
) -> Decoded:
    """What was completed, with log scales nearer to the trained ones where they spoil frames.

    Args:
        trained: with sizes as training left them, N Gaussians.
        completed: of the same surface.
        shown: poses either in the same frames, at least one.
        limits: mean error more, in [0, 1], from which some, and all, of the change is taken back.
    """
    views, before = zip(*[(view, errors(one, view)) for one, view in shown(trained)], strict=True)
    after = (one for one, _ in shown(completed))
    share = 1 - ramp(spoilt(before, after, views), *limits)[:, None]
    return dataclasses.replace(completed, log_scale=torch.lerp(trained.log_scale, completed.log_scale, share))


def every_second(shown: Shown) -> Shown:
    """The same of one in ``EVERY`` frames, the first among them."""
    return lambda decoded: itertools.islice(shown(decoded), 0, None, EVERY)


def made_thin(completed: Decoded, shown: Shown) -> Decoded:
    """What was completed, no thicker along its normals than ``THIN`` where that hardly spoils frames."""
    log_scale = completed.log_scale.clone()
    log_scale[:, 2] = log_scale[:, 2].clamp_max(THIN)
    thin = dataclasses.replace(completed, log_scale=log_scale)
    return with_sizes_spared(completed, thin, shown, HARDLY_SPOILT)


def errors(gaussians: Gaussians, view: View) -> Tensor:
    """The error of each pixel, of its colour on black, the mean of red, green and blue: [H, W] in [0, 1]."""
    truth = view.color * view.alpha[..., None]
    return (render(gaussians, view.camera).color - truth).abs().mean(-1)


def spoilt(before: Iterable[Tensor], after: Iterable[Gaussians], views: Iterable[View]) -> Tensor:
    """How much worse the pixels got in which each Gaussian is, the mean by its blending weight: [N].

    Args:
        before: of each frame, see ``errors``.
        after: the avatar in each frame, N Gaussians.
        views: the frames, at least one.
    """
    worse, weight = torch.zeros(()), torch.zeros(())
    for error, gaussians, view in zip(before, after, views, strict=True):
        more = (errors(gaussians, view) - error).clamp_min(0)
        sums, weights = picture_sums(gaussians, view.camera, more[..., None].expand(-1, -1, 4).contiguous())
        worse, weight = worse.to(weights) + sums[:, 0], weight.to(weights) + weights
    return worse / weight.clamp_min(LEAST_WEIGHT)
