"""Skinning of Gaussians: the weights that each point has, and posing without gradient.

The same as ``Avatar.pose`` computes in torch, on a CPU each in one pass over the Gaussians. A point hangs on
a few of the 55 joints only; the others' weights are zero and are left out here. ``plain_normals`` and
``plain_place`` say what the kernels mean, and are what runs on any other device.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import roma
import scipy.spatial
import torch
from torch import Tensor

from pipeline.avatar.canonical import Canonical
from pipeline.avatar.skinning_kernels import normals_of_vertices, place_gaussians, skin_points
from pipeline.body import blend_transforms, transform_points, vertex_normals
from pipeline.device import kernels_serve
from pipeline.numba_kernels import use_torch_threads

OWN = -1  # in place of a row: the weights that a point had


def joints_of_points(skinning_weights: Tensor) -> tuple[Tensor, Tensor]:
    """The joints that each point hangs on, and their weights: [N, 55] -> [N, K] uint8, [N, K] float32.

    K is the most that any point has; the others are filled up with weights of zero. Nothing is rounded.
    """
    most = int((skinning_weights != 0).sum(1).max())
    weights, joints = skinning_weights.float().topk(most, dim=1)
    return joints.to(torch.uint8).contiguous(), weights.contiguous()


def faces_of_vertices(faces: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The faces around each vertex: [F, 3] -> starts [count + 1] and face numbers [3 F], both int32."""
    corners = faces.flatten()
    order = corners.argsort(stable=True)
    starts = torch.zeros(count + 1, dtype=torch.int32, device=faces.device)
    starts[1:] = torch.bincount(corners, minlength=count).cumsum(0)
    return starts, (order // 3).int()


@dataclasses.dataclass(frozen=True)
class SkinningTables:
    """The tables that skinning of a canonical mesh reads; all contiguous, floating ones float32.

    Attributes:
        joints_of, weights: [N, K] uint8 and float32, see ``joints_of_points``.
        frames: [N, 3, 3], the Gaussians' axes at rest.
        faces: [F, 3] int32.
        starts, around: int32, see ``faces_of_vertices``.
    """

    joints_of: Tensor
    weights: Tensor
    frames: Tensor
    faces: Tensor
    starts: Tensor
    around: Tensor

    @classmethod
    def build(cls, canonical: Canonical) -> SkinningTables:
        """The tables of a mesh."""
        joints_of, weights = joints_of_points(canonical.skinning_weights)
        starts, around = faces_of_vertices(canonical.faces, len(canonical))
        faces = canonical.faces.int().contiguous()
        return cls(joints_of, weights, canonical.frames.float().contiguous(), faces, starts, around)

    def normals(self, transforms: Tensor, points: Tensor) -> Tensor:
        """Unit normals of the posed mesh, without gradient.

        Args:
            transforms: [55, 3, 4] float32, as ``pipeline.body.joint_transforms`` gives them.
            points: [N, 3] float32 at rest, metres.

        Returns:
            [N, 3].
        """
        if not kernels_serve(points):
            return plain_normals(self, transforms, points)
        use_torch_threads()
        posed, normals = torch.empty_like(points), torch.empty_like(points)
        skin_points(*self._skinned(transforms, points), posed.numpy())
        mesh = self.faces.numpy(), self.starts.numpy(), self.around.numpy()
        normals_of_vertices(posed.numpy(), *mesh, normals.numpy())
        return normals

    def place(self, transforms: Tensor, points: Tensor, transl: Tensor) -> tuple[Tensor, Tensor]:
        """Centres [N, 3] and orientations [N, 4] wxyz of the Gaussians in the world, without gradient.

        Args:
            transforms, points: as for ``normals``.
            transl: [3] float32, metres.
        """
        if not kernels_serve(points):
            return plain_place(self, transforms, points, transl)
        use_torch_threads()
        means, quaternions = torch.empty_like(points), points.new_empty(len(points), 4)
        skinned, frames = self._skinned(transforms, points), self.frames.numpy()
        place_gaussians(*skinned, frames, transl.detach().numpy(), means.numpy(), quaternions.numpy())
        return means, quaternions

    def _skinned(
        self, transforms: Tensor, points: Tensor
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        flat, rest = transforms.detach().flatten(1).contiguous(), points.detach().contiguous()
        return flat.numpy(), self.joints_of.numpy(), self.weights.numpy(), rest.numpy()


@torch.no_grad()
def plain_normals(tables: SkinningTables, transforms: Tensor, points: Tensor) -> Tensor:
    """The plain twin of ``SkinningTables.normals``."""
    blended = _blended(tables, transforms)
    return vertex_normals(transform_points(blended, points), tables.faces.long())


@torch.no_grad()
def plain_place(
    tables: SkinningTables, transforms: Tensor, points: Tensor, transl: Tensor
) -> tuple[Tensor, Tensor]:
    """The plain twin of ``SkinningTables.place``."""
    blended = _blended(tables, transforms)
    quaternions = roma.rotmat_to_unitquat(blended[..., :3] @ tables.frames)
    return transform_points(blended, points) + transl, roma.quat_xyzw_to_wxyz(quaternions)


def _blended(tables: SkinningTables, transforms: Tensor) -> Tensor:
    """The transform that each point is carried with, [N, 3, 4]."""
    weights = transforms.new_zeros(len(tables.weights), len(transforms))
    weights.scatter_(1, tables.joints_of.long(), tables.weights.to(weights))
    return blend_transforms(transforms, weights)


def nearest_rows(points: Tensor, original: Tensor, free: Tensor) -> Tensor:
    """The original vertex whose weights each moved point takes.

    A Gaussian keeps the weights of its own vertex, interpolated over the subdivided mesh. ExAvatar, and with
    it the paper (Section 3.6: SMPL-X's weights), takes those of the original vertex that lies nearest to the
    moved point, head and hands apart: cloth that was pushed from the arm onto the chest then follows the
    chest.

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
