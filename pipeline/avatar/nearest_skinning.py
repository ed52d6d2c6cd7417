"""Skinning weights of points that an avatar has moved off the body, taken from where they have come to lie.

A Gaussian keeps the weights of its own vertex, interpolated over the subdivided mesh. ExAvatar, and with it
the paper (Section 3.6: SMPL-X's weights), takes those of the original vertex that lies nearest to the moved
point, head and hands apart: cloth that has been pushed from the arm onto the chest then follows the chest.
"""

from __future__ import annotations

import dataclasses

import scipy.spatial
import torch
from torch import Tensor

from pipeline.avatar.canonical import Canonical

OWN = -1  # in place of a row: the weights that a point had


def nearest_rows(points: Tensor, original: Tensor, free: Tensor) -> Tensor:
    """The original vertex whose weights each moved point takes.

    Args:
        points: [N, 3] at rest, metres.
        original: [K, 3], vertices of the unsubdivided mesh at rest, metres.
        free: [N] bool, the points that may take another's weights.

    Returns:
        [N] int64, rows of ``original``; ``OWN`` where a point may not.
    """
    rows = torch.full((len(points),), OWN, device=points.device)
    tree = scipy.spatial.cKDTree(original.detach().cpu().numpy())
    _, nearest = tree.query(points[free].detach().cpu().numpy())
    rows[free] = torch.from_numpy(nearest).long().to(points.device)
    return rows


def with_weights_of(mesh: Canonical, original: Canonical, rows: Tensor) -> Canonical:
    """A mesh whose vertices have other skinning weights.

    Args:
        mesh: N vertices.
        original: the unsubdivided mesh.
        rows: [N], as ``nearest_rows`` gives them.
    """
    taken = original.skinning_weights[rows.clamp_min(0)]
    weights = torch.where((rows == OWN)[:, None], mesh.skinning_weights, taken)
    return dataclasses.replace(mesh, skinning_weights=weights)
