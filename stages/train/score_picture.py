"""The body coloured by visibility score, front and back."""

from __future__ import annotations

import matplotlib
import numpy as np
import torch

from pipeline.body import BodyModel, Identity, draw_mesh, rest_vertices
from pipeline.clip.camera import facing_camera

SIZE = 360  # pixels, of each of the two pictures
PAPER = 255


def score_picture(body: BodyModel, identity: Identity, scores: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """The rest pose from the front and from behind: colour is the score, grey what is not modelled.

    Args:
        body: the body model.
        identity: the subject's.
        scores: [V] in [0, 1].
        kept: [V] bool, what has a Gaussian in the end.

    Returns:
        [360, 720, 3] uint8 RGB.
    """
    with torch.no_grad():
        vertices = rest_vertices(body, identity)
    colors = 255 * matplotlib.colormaps["viridis"](scores)[:, :3]
    colors[~kept] = 0.35 * colors[~kept] + 0.65 * 150
    low, high = vertices.amin(0), vertices.amax(0)
    middle, extent = (low + high) / 2, float((high - low)[:2].max())
    camera = facing_camera(SIZE, SIZE, 4.0 * SIZE)
    pictures = []
    for side in (1.0, -1.0):
        turned = (vertices - middle) * torch.tensor([side, 1.0, side])
        placed = turned - torch.tensor([0.0, 0.0, 4.2 * extent])
        blank = np.full((SIZE, SIZE, 3), PAPER, np.uint8)
        pictures.append(draw_mesh(blank, camera, placed, body.faces, colors))
    return np.concatenate(pictures, axis=1)
