"""Completion of a trained avatar: what no frame showed well is taken from what frames did.

After training each Gaussian keeps what was learnt as far as evidence trusts it (``evidence.py``), and has for
the rest colour and scale from its own segment of the body (``pipeline/texture/completion.py``); what
follows the pose fades out likewise. Sizes change only as far as filmed pictures allow (``spared.py``), what
was seen is made thin as far as they do, and holes that are left are closed in any case.
Seconds of work, no generator, and an avatar of which everything was seen stays as it was to the byte.

The bases' representation takes the values as its own. The triplane cannot: its values are read from planes
that other Gaussians read, too. So its avatar stores them beside the planes (``Avatar.completion``).
"""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from torch import Tensor

from pipeline.avatar.avatar import Avatar
from pipeline.avatar.color_bounds import ANYWHERE, BRIGHTEST, DARKEST, ColorBounds
from pipeline.avatar.evidence import Evidence, covering_log_scale
from pipeline.avatar.holes import around_holes
from pipeline.avatar.representation import Decoded
from pipeline.avatar.spared import Shown, every_second, made_thin, with_sizes_spared
from pipeline.avatar.surface import Surface
from pipeline.body import Pose
from pipeline.orbit_cameras import relaxed_pose
from pipeline.texture.completion import color_field, complete_colors, complete_log_scales
from pipeline.texture.segments import HEAD, Segments, find_segments

ARMS = 1.0  # radians that they hang down while holes are looked for
FLAT = -1.5  # log scale along the normal of what is guessed: thick ones stand out around every silhouette
ON_HEADS, ELSEWHERE = (0.02, 0.25, 0.4), (0.06, 1.0, 0.8)
"""How far from its segment's a colour may lie, in [0, 1]: where frames saw the edge alone, of what the part
usually differs by, and for a squared cosine of 1."""

FREE = 0.4  # squared cosine from which on a colour may lie anywhere
HAIR = 0.5  # share from which a place is hair


def surface_segments(surface: Surface) -> Segments:
    """The segments of an avatar's surface."""
    mesh = surface.canonical
    return find_segments(mesh.vertices, mesh.faces, mesh.skinning_weights, mesh.parts, mesh.joints)


def complete_color_logits(surface: Surface, evidence: Evidence) -> Tensor:
    """Logits of the colours that frames showed, completed where they showed none: [N, 3]."""
    found = torch.from_numpy(
        complete_colors(surface_segments(surface), *_arrays(evidence.color, *_of_color(evidence)))
    )
    return torch.logit(found.clamp(DARKEST, BRIGHTEST)).to(evidence.color)


@torch.no_grad()
def complete_avatar(avatar: Avatar, evidence: Evidence, shown: Shown | None = None) -> None:
    """Completes an avatar in place; to be called once, after training.

    Args:
        avatar: trained.
        evidence: of its ungated Gaussians, N, see ``covering``.
        shown: poses it in frames that are not to be spoilt (``spared.py``); none are asked if None.
    """
    decoded = avatar.decode()
    rows = decoded.surface.pick(torch.arange(len(avatar.trust), device=avatar.device))
    avatar.trust.index_copy_(0, rows, evidence.together.to(avatar.trust))
    if bool((evidence.together == 1).all()):
        return
    segments = surface_segments(decoded.surface)
    colored = with_completed_colors(decoded, segments, evidence)
    covers = covering_log_scale(avatar.architecture.scale)
    completed = with_completed_scales(colored, segments, evidence.shape_trust, covers)
    if shown is not None:
        some = every_second(shown)
        completed = made_thin(with_sizes_spared(colored, completed, some), shown)
        completed = with_sizes_spared(completed, closed(avatar, completed, covers), some)
    # Where sparing left holes, as in a lap that a desk hides, frames are spoilt rather than a side.
    avatar.take_completion(rows, closed(avatar, completed, covers))


def closed(avatar: Avatar, completed: Decoded, covers: float) -> Decoded:
    """What was completed with the scales about holes no smaller than ``covers``, a log scale.

    Frames that show a surface from its edge alone let it become a sieve, which shows from its side.
    """
    mesh, still = completed.surface.canonical, torch.zeros(3, device=avatar.device)
    expression = still.new_zeros(mesh.expression_directions.shape[-1])
    pose = Pose(relaxed_pose(ARMS).to(still), expression, still)
    sieve = around_holes(avatar.pose(completed, pose).gaussians, mesh.faces)
    larger = torch.maximum(completed.log_scale, torch.tensor([covers, covers, FLAT], device=avatar.device))
    log_scale = torch.where(sieve[:, None], larger, completed.log_scale)
    return dataclasses.replace(completed, log_scale=log_scale)


def with_completed_scales(decoded: Decoded, segments: Segments, trust: Tensor, covers: float) -> Decoded:
    """What was decoded with scales completed by ``covers``, a log scale, where trust, [N], is weak."""
    log_scale, known = _arrays(decoded.log_scale, trust)
    scales = complete_log_scales(segments, log_scale, known, (covers, covers, FLAT))
    return dataclasses.replace(decoded, log_scale=torch.from_numpy(scales).to(decoded.log_scale))


def with_completed_colors(decoded: Decoded, segments: Segments, evidence: Evidence) -> Decoded:
    """What was decoded with colours completed.

    Offsets stay: what no frame shows must keep behind the silhouettes that frames do show, and training has
    put it there.
    """
    told = _arrays(torch.sigmoid(decoded.color_logit), *_of_color(evidence))
    found = torch.from_numpy(complete_colors(segments, *told))
    logits = torch.logit(found.clamp(DARKEST, BRIGHTEST)).to(decoded.color_logit)
    known = (evidence.trust == 1)[:, None]
    return dataclasses.replace(decoded, color_logit=torch.where(known, decoded.color_logit, logits))


@torch.no_grad()
def calm_colors(decoded: Decoded, evidence: Evidence) -> ColorBounds:
    """The bounds within which evidence leaves the colours of each Gaussian.

    They lie about what its segment shows there, as far from it as its part of the body usually is (a checked
    shirt is farther than skin), and farther the more squarely frames saw it: what they saw from its edge
    alone has the colours of whatever stands at that edge of the person. A head's are narrower: eyes and mouth
    are what it usually differs by, and its sides have none.
    """
    free = torch.full_like(evidence.square, ANYWHERE)
    color, telling, normals = _arrays(torch.sigmoid(decoded.color_logit), evidence.source, evidence.normals)
    if not (telling > 0).any():
        return ColorBounds(torch.zeros_like(decoded.color_logit), free, free < 0)
    segments = surface_segments(decoded.surface)
    field, hair = (torch.from_numpy(one).to(free) for one in color_field(segments, color, telling, normals))
    apart = (torch.sigmoid(decoded.color_logit) - field).abs().amax(1)
    usual = _group_means(apart, evidence.source, torch.from_numpy(segments.part).to(free.device))
    head = torch.from_numpy(segments.is_in(*HEAD)).to(free.device)
    least, share, own = (torch.where(head, *pair) for pair in zip(ON_HEADS, ELSEWHERE, strict=True))
    around = least + share * usual + own * evidence.square
    return ColorBounds(field, torch.where(evidence.square > FREE, free, around), hair > HAIR)


def _group_means(values: Tensor, weights: Tensor, group: Tensor) -> Tensor:
    """The weighted mean of each one's group, [N]; 0 where a group has no weight."""
    count = int(group.max()) + 1
    sums = [values.new_zeros(count).index_add_(0, group, one) for one in (weights * values, weights)]
    return (sums[0] / sums[1].clamp_min(1e-12))[group]


def _of_color(evidence: Evidence) -> tuple[Tensor, Tensor, Tensor]:
    # What is trusted by half has been held near its segment's in training: its own colour is calm.
    return evidence.trust.sqrt(), evidence.normals, evidence.source


def _arrays(*tensors: Tensor) -> tuple[np.ndarray, ...]:
    return tuple(one.detach().double().cpu().numpy() for one in tensors)
