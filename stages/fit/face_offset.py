"""Smooth offsets of the face's vertices from offsets at its landmarks."""

from __future__ import annotations

import torch
from torch import Tensor

from pipeline.body import BodyModel, is_part
from pipeline.body.joints import LEFT_EYE, RIGHT_EYE
from pipeline.body.landmarks import PointSet

_RADIUS = 0.008  # metres, about the distance between face-mesh landmarks
_REACH = 0.02  # metres from the nearest landmark over which offsets fade out
_MOUTH = 0.03  # metres that lie between two touching points if one follows the jaw and one does not


def spread_matrix(body: BodyModel, controls: PointSet) -> Tensor:
    """The share of each control's offset that each vertex follows.

    A vertex takes the Gaussian-weighted mean of the controls around it, and less of it the farther
    the nearest control is, so that the face's rim has no step; 4 cm outside the controls nothing is
    left. Distances are taken in position and jaw weight together: the two lips touch and yet move
    apart. Eyeballs stay, being rigid.

    Args:
        controls: C landmarks on the face's surface.

    Returns:
        [V, C] float32, rows sum to at most 1, and to 0 away from the face.
    """
    spread = torch.zeros(len(body.v_template), len(controls))
    if len(controls) == 0:
        return spread
    places = torch.cat([body.v_template, _MOUTH * body.skinning_weights[:, 22:23]], dim=1).double()
    corners = places[controls.vertices]
    anchors = (corners * controls.barycentrics.double()[..., None]).sum(1)
    eyes = body.skinning_weights[:, [LEFT_EYE, RIGHT_EYE]].sum(1) > 0.5
    rows = torch.nonzero(is_part(body, "head", "face") & ~eyes)[:, 0]
    squared = torch.cdist(places[rows], anchors, compute_mode="donot_use_mm_for_euclid_dist").square()
    nearest = squared.min(1, keepdim=True).values
    near = nearest[:, 0] < (2 * _REACH) ** 2
    rows, squared, nearest = rows[near], squared[near], nearest[near]
    # Relative to the nearest, so that vertices far from all controls have a mean too.
    weight = torch.exp((nearest - squared) / (2 * _RADIUS**2))
    weight = weight / weight.sum(1, keepdim=True) * torch.exp(-nearest / _REACH**2)
    spread[rows] = weight.float()
    return spread


def on_skin(body: BodyModel, points: PointSet) -> Tensor:
    """The points that may carry an offset, on the surface and not on an eyeball: [N] bool."""
    eyes = body.skinning_weights[:, [LEFT_EYE, RIGHT_EYE]].sum(1)[points.vertices]
    return (points.joint < 0) & ((eyes * points.barycentrics).sum(1) < 0.5)


def mirror_matrix(places: Tensor) -> Tensor:
    """A matrix that picks each point's mirror partner in X, the nearest to its image: [N, 3] -> [N, N]."""
    if len(places) == 0:
        return places.new_zeros(0, 0)
    image = places * places.new_tensor([-1.0, 1.0, 1.0])
    opposite = torch.cdist(image, places).argmin(1)
    return torch.nn.functional.one_hot(opposite, len(places)).to(places.dtype)
