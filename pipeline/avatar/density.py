"""The density of Gaussians: edges of the body's mesh are split until none is long in the picture.

The template has 56% of its vertices on head and hands and 12% on the torso. A Gaussian a vertex makes a face
sharper than the pixels and turns a checked shirt to mush. So edges are split, round after round, where they
are longer in some training frame than a given number of pixels. What no frame shows stays coarser.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from pipeline.avatar.surface import Surface
from pipeline.avatar.visibility import in_frame
from pipeline.body import PARTS, Pose, edges, joint_transforms
from pipeline.body.edge_splits import split_edges
from pipeline.clip.camera import Camera, project

DENSITY_FRAMES = 12  # training frames, evenly spread, in which edges are measured
MOST_ROUNDS = 6  # a sixty-fourth of an edge
FACING = 0.1  # cosine of the angle between normal and line of sight: seen more obliquely counts as unseen
AWAY = 0.35  # of an edge's length, where it is turned away: Gaussians as coarse as the template have halos


@dataclasses.dataclass(frozen=True)
class Projections:
    """The vertices of a mesh in the pictures of S frames.

    Attributes:
        pixels: [V, S, 2].
        facing: [V, S] float, 1 where a vertex lies in the picture and faces the camera, ``AWAY`` where it
            lies in the picture and does not, 0 elsewhere.
    """

    pixels: Tensor  # [V, S, 2]
    facing: Tensor  # [V, S]

    def edge_pixels(self, pairs: Tensor) -> Tensor:
        """The length of edges in the frame that shows them longest: [E, 2] -> [E]; 0 where none does.

        Of what is turned away a part of the length counts.
        """
        ends = pairs.unbind(1)
        length = (self.pixels[ends[0]] - self.pixels[ends[1]]).norm(dim=2)
        return (length * torch.maximum(self.facing[ends[0]], self.facing[ends[1]])).amax(1)


@torch.no_grad()
def project_surface(surface: Surface, frames: Iterable[tuple[Pose, Camera]]) -> Projections:
    """The vertices of a surface in the pictures of at least one frame, without expressions and offsets."""
    canonical, tables = surface.canonical, surface.skinning_tables
    pixels, facing = [], []
    for pose, camera in frames:
        transforms = joint_transforms(pose.rotation[None], canonical.joints, canonical.parents)[0]
        points = tables.place(transforms, canonical.vertices, pose.transl)[0]
        sight = torch.nn.functional.normalize(camera.centre - points, dim=1)
        towards = (tables.normals(transforms, canonical.vertices) * sight).sum(1) > FACING
        pixels.append(project(camera, points))
        facing.append(in_frame(camera, points) * torch.where(towards, 1.0, AWAY))
    return Projections(torch.stack(pixels, 1), torch.stack(facing, 1))


def choose_splits(faces: Tensor, projections: Projections, longest: float) -> tuple[Tensor, ...]:
    """The edges to split, for ``split_repeatedly``: rounds of [S, 2] int64.

    Args:
        faces: [F, 3].
        projections: of the mesh's vertices.
        longest: pixels; no edge that is shown stays longer, unless ``MOST_ROUNDS`` were not enough.
    """
    rounds: list[Tensor] = []
    while len(rounds) < MOST_ROUNDS and len(faces):
        pairs = edges(faces)
        chosen = pairs[projections.edge_pixels(pairs) > longest]
        if not len(chosen):
            break
        faces, (pixels, facing) = split_edges(faces, chosen, projections.pixels, projections.facing)
        projections = Projections(pixels, facing)
        rounds.append(chosen)
    return tuple(rounds)


def count_by_part(parts: Tensor, splits: Sequence[Tensor]) -> dict[str, int]:
    """The Gaussians of each part after the splits; a new one is counted with its edge's first end.

    Args:
        parts: [V], see ``pipeline.body.PARTS``.
        splits: as ``choose_splits`` gives them.
    """
    for chosen in splits:
        parts = torch.cat([parts, parts[chosen[:, 0]]])
    return dict(zip(PARTS, torch.bincount(parts, minlength=len(PARTS)).tolist(), strict=True))
