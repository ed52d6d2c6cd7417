"""Evidence: how much of each Gaussian how many frames really showed, and how squarely.

The paper's visibility score counts a vertex that lies in the picture, hidden or turned away or not. That is
right for the gate, and wrong for every question about colours and places: a back that faces away for the
whole clip is in every picture. Here a frame counts for a Gaussian by

- its *share*: the blending weight that the Gaussian has in the person's own pixels, against the pixels that
  its piece of the surface would cover if nothing stood before it, both together with those of its neighbours
  (``pooled``): training leaves some a hair behind those beside them, which show the same surface. The share
  does not depend on the picture's resolution, nor on how finely the mesh is divided there;
- its *squareness*: the cosine between the surface's normal and the view. Under ``GRAZING`` a frame says
  nothing, because a fit that is a little off shows the wall there.

Evidence is asked of Gaussians that are large enough to cover (``covering``): one that has shrunk because it
lies outside the mask would otherwise count as hidden, and be made whole. What shows between others because
those have shrunk keeps its colour, too (``with_colors_of``). So hardly a pixel of a training frame changes
when what evidence does not reach is completed. What looks at evidence asks for ``trust``, ``shape_trust`` or
``source``, which are continuous.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable

import torch
from torch import Tensor

from pipeline.avatar.representation import Decoded
from pipeline.avatar.surface import Surface
from pipeline.body.mesh import face_normals, vertex_normals
from pipeline.clip.camera import Camera, project, to_camera
from pipeline.clip.views import View
from pipeline.splat import Gaussians, picture_sums

GRAZING, SQUARE = 0.0, 0.2  # cosines: nothing is learnt, all is learnt
PERSON = 0.2, 0.7  # alpha: a pixel does not count, counts wholly
LEAST_TRUST = 0.5  # from which a pixel of a generated frame counts
HIDDEN, OPEN = 0.15, 0.4  # shares: what shines through from behind, what is plainly seen
PROTRUDES = 0.02, 0.1  # shares: wholly hidden, its rim looks out from behind a silhouette
KEPT = 0.005, 0.04  # mean share: nothing, and all, of what was learnt is kept; one frame of 24 is enough
TELLS = 0.01, 0.12  # likewise, of what others are told by: one frame in eight
FRONTAL = 0.02, 0.4  # squared cosines: others are told nothing, and all
EDGE_ON = 0.25  # the least part of its area that a piece of surface covers, however it is turned
COVERING = 0.75  # standard deviations in distances to the neighbours; 0.55 lets a tenth through between four
RINGS = 1  # of neighbours that a share is taken of together
BORROWED = 1e-3  # of the neighbours' sum, some 40 times what is a Gaussian's own, that its colour is told by
SMALLEST = 1e-3  # pixels that a piece of surface covers, under which a frame says nothing of it


@dataclasses.dataclass(frozen=True)
class Evidence:
    """The evidence that some frames give of each of N Gaussians.

    Attributes:
        seen: [N] in [0, 1], mean over the frames of share and squareness together.
        frames: [N] in [0, 1], the part of the frames that showed it at all: the mean share.
        shape: [N] in [0, 1], the same of all pixels, also those beside the person: an empty pixel is evidence
            that nothing is there.
        facing: [N] in [0, 1], the mean cosine in the frames that showed it; 0 where none did.
        square: [N] in [0, 1], the mean squared cosine in the frames that showed it, each of them counted by
            that as well: near that of the frames that showed it most squarely; 0 where none did.
        color: [N, 3], its mean colour in them, RGB in [0, 1]; meaningless where ``frames`` is 0.
        normals: [N, 3], its mean normal in the world over all the frames; short where the body turned.
    """

    seen: Tensor  # [N]
    frames: Tensor  # [N]
    shape: Tensor  # [N]
    facing: Tensor  # [N]
    square: Tensor  # [N]
    color: Tensor  # [N, 3]
    normals: Tensor  # [N, 3]

    @property
    def trust(self) -> Tensor:
        """How far the colour that was learnt of each Gaussian is to be believed, [N] in [0, 1]."""
        return ramp(self.frames, *KEPT)

    @property
    def shape_trust(self) -> Tensor:
        """How far its place and size are, [N] in [0, 1]."""
        return ramp(self.shape, *KEPT)

    @property
    def source(self) -> Tensor:
        """How far others may be told by its colour, [N] in [0, 1]: only what was seen squarely, and often."""
        return ramp(self.seen, *TELLS) * ramp(self.square, *FRONTAL)

    @property
    def together(self) -> Tensor:
        """Trust of colour and of shape, [N, 2], as ``Avatar.trust`` has it."""
        return torch.stack([self.trust, self.shape_trust], 1)

    def filled(self, other: Evidence) -> Evidence:
        """This evidence, and where it is weak the other's, as of generated frames beside captured ones."""
        share = self.trust[:, None]
        return Evidence(
            seen=torch.maximum(self.seen, other.seen),
            frames=torch.maximum(self.frames, other.frames),
            shape=torch.maximum(self.shape, other.shape),
            facing=torch.maximum(self.facing, other.facing),
            square=torch.maximum(self.square, other.square),
            color=share * self.color + (1 - share) * other.color,
            normals=self.normals,
        )

    def with_colors_of(self, other: Evidence) -> Evidence:
        """This evidence, trusting also the colours that the other shows, as of the avatar as it is."""
        better = (other.frames > self.frames)[:, None]
        return dataclasses.replace(
            self,
            frames=torch.maximum(self.frames, other.frames),
            color=torch.where(better, other.color, self.color),
        )


def covering_log_scale(scale: float) -> float:
    """The log scale at which no light passes between neighbours, also on long triangles.

    Args:
        scale: ``Architecture.scale``, the standard deviation at log scale 0, in distances to the neighbours.
    """
    return max(0.0, math.log(COVERING / scale))


def covering(decoded: Decoded) -> Decoded:
    """What was decoded with no Gaussian smaller than at first, when neighbours all but cover the surface."""
    return dataclasses.replace(decoded, log_scale=decoded.log_scale.clamp_min(0))


def ramp(values: Tensor, low: float, high: float) -> Tensor:
    """0 up to ``low``, 1 from ``high`` on, a smooth step between (``3 x^2 - 2 x^3``)."""
    place = ((values - low) / (high - low)).clamp(0, 1)
    return place.square() * (3 - 2 * place)


def gather_evidence(shown: Iterable[tuple[Gaussians, View]], surface: Surface) -> Evidence:
    """The evidence that frames give of a surface's Gaussians.

    Args:
        shown: for each frame the avatar in its pose, N Gaussians that cover, and the frame, on its device.
        surface: that carries the Gaussians.

    Raises:
        ValueError: there is no frame.
    """
    faces, count = surface.canonical.faces, 0
    sums: list[Tensor] = []
    for gaussians, view in shown:
        found = frame_evidence(gaussians, view, faces)
        sums = [total + one for total, one in zip(sums, found, strict=True)] if sums else list(found)
        count += 1
    if not sums:
        raise ValueError("evidence needs at least one frame")
    seen, frames, shape, facing, second, fourth, color, normals = sums
    return Evidence(
        seen=seen / count,
        frames=frames / count,
        shape=shape / count,
        facing=facing / frames.clamp_min(1e-12),
        square=fourth / second.clamp_min(1e-12),
        color=color / frames.clamp_min(1e-12)[:, None],
        normals=normals / count,
    )


def frame_evidence(gaussians: Gaussians, view: View, faces: Tensor) -> tuple[Tensor, ...]:
    """One frame's part in the sums of ``Evidence``: six of [N], colour times share and normals, [N, 3]."""
    means = gaussians.means.detach()
    normals = vertex_normals(means, faces)
    covered = covered_pixels(view.camera, means, faces)
    towards = torch.nn.functional.normalize(view.camera.centre.to(means) - means, dim=1)
    cosine = (normals * towards).sum(1).clamp(0, 1)
    counts = ramp(view.alpha, *PERSON)[..., None]
    if view.trust is not None:
        counts = counts * (view.trust >= LEAST_TRUST)[..., None]
    sums, weights = picture_sums(gaussians, view.camera, torch.cat([view.color * counts, counts], -1))
    own = torch.cat([sums[:, 3:], weights[:, None], covered[:, None], sums[:, :3]], 1)
    around = pooled(own, faces)
    share = around[:, :2] / around[:, 2:3].clamp_min(SMALLEST)
    showed, shape = ramp(share[:, 0], HIDDEN, OPEN), ramp(share[:, 1], *PROTRUDES)
    seen = showed * ramp(cosine, GRAZING, SQUARE)
    # What has no weight of its own has the colour of what is around it.
    told = own + BORROWED * around
    mean = told[:, 3:] / told[:, :1].clamp_min(1e-12)
    squared = cosine.square()
    by_angle = (showed * cosine, showed * squared, showed * squared.square())
    return seen, showed, shape, *by_angle, mean * showed[:, None], normals


def pooled(
    values: Tensor,  # [N, C]
    faces: Tensor,  # [F, 3]
) -> Tensor:
    """Sums over each point and those within ``RINGS`` triangles, nearer ones oftener, [N, C]."""
    for _ in range(RINGS):
        around = values[faces].sum(1).repeat_interleave(3, 0)
        values = torch.zeros_like(values).index_add_(0, faces.flatten(), around)
    return values


def covered_pixels(
    camera: Camera,
    points: Tensor,  # [N, 3]
    faces: Tensor,  # [F, 3]
) -> Tensor:
    """The pixels that each point's piece of the surface covers, [N], if nothing stands before it.

    A point's piece is a third of each triangle around it, whichever way it faces. A piece that is seen from
    its edge covers a little, too: Gaussians are not flat.

    Args:
        camera: that looks.
        points: posed, metres.
        faces: int64.
    """
    pixels, depth = project(camera, points), to_camera(camera, points)[:, 2]
    a, b, c = (pixels[faces[:, corner]] for corner in range(3))
    ab, ac = b - a, c - a
    area = (ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]).abs() / 2
    scale = (camera.intrinsics[0, 0] / depth[faces].mean(1).clamp_min(1e-2)) ** 2
    area = torch.maximum(area, EDGE_ON * scale * face_normals(points, faces).norm(dim=1) / 2)
    area = torch.where((depth[faces] > 0).all(1), area, torch.zeros_like(area))
    pieces = torch.zeros_like(depth)
    for corner in range(3):
        pieces.index_add_(0, faces[:, corner], area / 3)
    return pieces
