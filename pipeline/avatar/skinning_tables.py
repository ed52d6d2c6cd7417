"""Skinning of Gaussians: the weights that each point has, and posing without gradient.

The same as ``Avatar.pose`` computes in torch, on a CPU each in one pass over the Gaussians. A point hangs on
a few of the 55 joints only; the others' weights are zero and are left out here. ``plain_normals`` and
``plain_place`` say what the kernels mean, and are what runs on any other device.
"""

from __future__ import annotations

import dataclasses

import numba
import numpy as np
import roma
import scipy.spatial
import torch
from torch import Tensor

from pipeline.avatar.canonical import Canonical
from pipeline.avatar.head_kernels import CHUNKS
from pipeline.body import blend_transforms, transform_points, vertex_normals
from pipeline.device import kernels_serve
from pipeline.numba_kernels import checked_parallel_kernel, inline_kernel, use_torch_threads

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


@inline_kernel
def _blend(transforms, joints, weights, point, blended):
    for k in range(12):
        blended[k] = 0
    for place in range(joints.shape[1]):
        weight, joint = weights[point, place], joints[point, place]
        for k in range(12):
            blended[k] += weight * transforms[joint, k]


@checked_parallel_kernel
def skin_points(transforms, joints, weights, points, posed):
    """Rest points carried to their pose.

    Args:
        transforms: [55, 12] float32, each joint's [3, 4] matrix row by row.
        joints, weights: [N, K], as ``joints_of_points`` gives them.
        points: [N, 3], metres.
        posed: output [N, 3], metres.
    """
    count = points.shape[0]
    step = (count + CHUNKS - 1) // CHUNKS
    for chunk in numba.prange(CHUNKS):
        blended = np.empty(12, np.float32)
        for i in range(chunk * step, min(count, (chunk + 1) * step)):
            _blend(transforms, joints, weights, i, blended)
            for row in range(3):
                value = blended[4 * row + 3]
                for column in range(3):
                    value += blended[4 * row + column] * points[i, column]
                posed[i, row] = value


@checked_parallel_kernel
def normals_of_vertices(vertices, faces, starts, around, normals):
    """Unit normals, area-weighted over the faces around each vertex, as ``pipeline.body.vertex_normals``.

    Args:
        vertices: [N, 3], metres.
        faces: [F, 3] int32.
        starts, around: as ``faces_of_vertices`` gives them.
        normals: output [N, 3]; zero where there is no face.
    """
    count = vertices.shape[0]
    step = (count + CHUNKS - 1) // CHUNKS
    area = np.empty((faces.shape[0], 3), np.float32)
    for f in numba.prange(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ux, vx = vertices[b, 0] - vertices[a, 0], vertices[c, 0] - vertices[a, 0]
        uy, vy = vertices[b, 1] - vertices[a, 1], vertices[c, 1] - vertices[a, 1]
        uz, vz = vertices[b, 2] - vertices[a, 2], vertices[c, 2] - vertices[a, 2]
        area[f, 0], area[f, 1], area[f, 2] = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    for chunk in numba.prange(CHUNKS):
        for i in range(chunk * step, min(count, (chunk + 1) * step)):
            x, y, z = np.float32(0), np.float32(0), np.float32(0)
            for place in range(starts[i], starts[i + 1]):
                f = around[place]
                x, y, z = x + area[f, 0], y + area[f, 1], z + area[f, 2]
            length = max(np.sqrt(x * x + y * y + z * z), np.float32(1e-20))
            normals[i, 0], normals[i, 1], normals[i, 2] = x / length, y / length, z / length


@inline_kernel
def _write_quaternion(m, quaternion):
    """A nearly orthonormal matrix [3, 3] as a unit quaternion, wxyz, by the largest of its parts."""
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    i = 0
    for k in range(1, 3):
        if m[k, k] > m[i, i]:
            i = k
    if trace >= m[i, i]:
        quaternion[0] = 1 + trace
        quaternion[1], quaternion[2], quaternion[3] = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    else:
        j, k = (i + 1) % 3, (i + 2) % 3
        quaternion[0] = m[k, j] - m[j, k]
        quaternion[1 + i] = 1 - trace + 2 * m[i, i]
        quaternion[1 + j], quaternion[1 + k] = m[j, i] + m[i, j], m[k, i] + m[i, k]
    square = np.float32(0)
    for k in range(4):
        square += quaternion[k] * quaternion[k]
    for k in range(4):
        quaternion[k] /= np.sqrt(square)


@checked_parallel_kernel
def place_gaussians(transforms, joints, weights, points, frames, transl, means, quaternions):
    """Centres and orientations of the Gaussians in the world.

    Args:
        transforms, joints, weights, points: as for ``skin_points``.
        frames: [N, 3, 3], the Gaussians' axes at rest.
        transl: [3], metres.
        means, quaternions: outputs [N, 3] metres and [N, 4] wxyz.
    """
    count = points.shape[0]
    step = (count + CHUNKS - 1) // CHUNKS
    for chunk in numba.prange(CHUNKS):
        blended, turned = np.empty(12, np.float32), np.empty((3, 3), np.float32)
        for i in range(chunk * step, min(count, (chunk + 1) * step)):
            _blend(transforms, joints, weights, i, blended)
            for row in range(3):
                value = blended[4 * row + 3] + transl[row]
                for column in range(3):
                    value += blended[4 * row + column] * points[i, column]
                    total = np.float32(0)
                    for k in range(3):
                        total += blended[4 * row + k] * frames[i, k, column]
                    turned[row, column] = total
                means[i, row] = value
            _write_quaternion(turned, quaternions[i])


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
