"""The face in its mean texture, pasted into a frame: for L_face (paper, Section 3.6 and Equation 9).

The texture is fixed: each vertex has the mean colour that the training frames show there. The mesh
goes through the Gaussians' posed centres, so what the loss can move is geometry: offsets, pose,
expression and translation. A face that slips over its texture costs, whatever the colour heads have
learnt meanwhile. As in ExAvatar, the mesh is pasted into the picture: the error counts where the face
covers it, and the mean is taken over the whole crop (``objective.py``), so that the weight compares with
L1's.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from pipeline.avatar import Canonical
from pipeline.body.mesh import face_normals
from pipeline.body.rasterize import rasterize
from pipeline.clip.camera import Camera, project, to_camera


@dataclasses.dataclass(frozen=True)
class Pasted:
    """The pixels that a textured mesh covers.

    Attributes:
        rows, columns: [P] int64.
        color: [P, 3], differentiable with respect to the mesh's vertices.
    """

    rows: Tensor  # [P]
    columns: Tensor  # [P]
    color: Tensor  # [P, 3]

    def pixels_of(self, picture: Tensor) -> Tensor:
        """The covered pixels of a picture, [H, W, ...] -> [P, ...]."""
        return picture[self.rows, self.columns]


def face_triangles(canonical: Canonical) -> Tensor:
    """True for triangles whose three corners lie on the face, [F] bool."""
    return canonical.is_part("face")[canonical.faces].all(1)


def paste(
    camera: Camera,
    vertices: Tensor,  # [N, 3]
    faces: Tensor,  # [F, 3] int64
    chosen: Tensor,  # [F] bool
    texture: Tensor,  # [N, 3]
) -> Pasted:
    """The pixels that chosen triangles of a mesh cover in a camera's picture, with their colours.

    Which triangle a pixel sees is found without gradient, on the CPU wherever the mesh is; the place on it
    is differentiable, so that gradients are those of the texture sliding under the pixel. The outline's
    motion has none.

    Args:
        camera: the view.
        vertices: metres, world.
        faces: the whole mesh: what is not chosen hides what lies behind it.
        chosen: the triangles to paste.
        texture: each vertex's colour.
    """
    raster = rasterize(camera, vertices, faces)
    triangle = torch.from_numpy(raster.face).to(faces)
    shown = chosen & _facing(camera, vertices.detach(), faces)
    rows, columns = torch.nonzero((triangle >= 0) & shown[triangle.clamp_min(0)], as_tuple=True)
    corners = faces[triangle[rows, columns]]
    seen = torch.cat([project(camera, vertices), to_camera(camera, vertices)[:, 2:]], 1)
    # index_select: its gradient is an index_add, several times quicker than that of seen[corners].
    weights = _barycentrics(seen.index_select(0, corners.flatten()).view(-1, 3, 3), rows, columns)
    return Pasted(rows, columns, (weights[..., None] * texture[corners]).sum(1))


def _facing(camera: Camera, vertices: Tensor, faces: Tensor) -> Tensor:
    """True for triangles that show the camera their outside, [F] bool."""
    in_camera = to_camera(camera, vertices)
    return (face_normals(in_camera, faces) * in_camera[faces[:, 0]]).sum(1) < 0


def _barycentrics(corners: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """The points where pixels' rays meet their triangles, perspective-correct.

    Args:
        corners: [P, 3, 3], each corner's place in the picture, pixels, and depth, metres.
        rows, columns: [P] int64.

    Returns:
        [P, 3], adding up to 1.
    """
    pixel = torch.stack([columns, rows], 1).to(corners) + 0.5
    spokes = corners[..., :2] - pixel[:, None]  # [P, 3, 2]
    following, last = spokes.roll(-1, dims=1), spokes.roll(-2, dims=1)
    areas = following[..., 0] * last[..., 1] - following[..., 1] * last[..., 0]
    weights = areas / corners[..., 2]  # 1 / z is linear on the screen
    return weights / weights.sum(1, keepdim=True)
