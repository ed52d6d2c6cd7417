"""An avatar's colours on the body's surface, spread to the mesh's vertices or baked into a texture."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from pipeline.avatar import Avatar
from pipeline.avatar.surface import Surface
from pipeline.body import Pose, rasterize
from pipeline.clip.camera import Camera
from pipeline.rig.rigged_mesh import RiggedMesh

NEAREST = 4  # known places that a colour is made of
_FACING = 0.01  # metres that a normal of opposite direction counts half of: lips and lids are thin
_BLUR = 2.5e-4  # metres within which places count alike
_GREY = 0.5


@dataclasses.dataclass(frozen=True)
class SurfaceColors:
    """Colours at places of the body's surface in its rest pose.

    Attributes:
        places: [M, 3], metres.
        normals: [M, 3], unit.
        colors: [M, 3], RGB in [0, 1].
    """

    places: np.ndarray
    normals: np.ndarray
    colors: np.ndarray

    def at(self, places: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Colours at other places: [N, 3] with unit normals [N, 3] -> [N, 3] float32; grey if none is."""
        known = np.isfinite(np.column_stack([self.places, self.normals, self.colors])).all(1)
        if not known.any():
            return np.full((len(places), 3), _GREY, np.float32)
        tree = cKDTree(np.column_stack([self.places, _FACING * self.normals])[known])
        count = min(NEAREST, int(known.sum()))
        distance, rows = tree.query(np.column_stack([places, _FACING * normals]), count)
        distance, rows = distance.reshape(len(places), count), rows.reshape(len(places), count)
        weights = 1 / (distance**2 + _BLUR**2)
        weights /= weights.sum(1, keepdims=True)
        mixed = (weights[..., None] * self.colors[known][rows]).sum(1)
        return np.clip(mixed, 0, 1).astype(np.float32)


@torch.no_grad()
def avatar_colors(avatar: Avatar, pose: Pose) -> SurfaceColors:
    """The colours that an avatar's Gaussians have in a pose, where they sit on the rest surface.

    Args:
        avatar: finished.
        pose: colours follow it; a relaxed one without expression is meant.
    """
    surfaces = shown_surfaces(avatar)
    colors = avatar.gaussians(pose).colors
    places = torch.cat([surface.canonical.vertices for surface in surfaces])
    normals = torch.cat([surface.canonical.frames[:, :, 2] for surface in surfaces])
    return SurfaceColors(places.cpu().numpy(), normals.cpu().numpy(), colors.cpu().numpy())


def shown_surfaces(avatar: Avatar) -> list[Surface]:
    """The surfaces of an avatar's Gaussians, in the order in which ``Avatar.gaussians`` has them."""
    whole = avatar.unseen == "nothing" or bool(avatar.active.all())
    return [avatar.surface()] if whole else [avatar.surface(), avatar.unseen_surface()]


def shown_vertices(avatar: Avatar, count: int) -> torch.Tensor:
    """The body's vertices that an avatar shows: [V] bool.

    Args:
        count: of the body's vertices, V.
    """
    shown = torch.zeros(count, dtype=torch.bool)
    everything = avatar.unseen != "nothing"
    shown[avatar.vertex_ids if everything else avatar.vertex_ids[avatar.active.cpu()]] = True
    return shown


def bake_texture(mesh: RiggedMesh, colors: SurfaceColors, size: int) -> np.ndarray:
    """The colours as a texture: [size, size, 3] uint8 RGB, continued beyond the edges of its islands.

    Args:
        mesh: with texture coordinates.
        colors: of the surface.
        size: pixels.
    """
    flat = np.column_stack([mesh.uv * [1, -1], np.full(len(mesh), -1.0)]).astype(np.float32)
    faces = torch.from_numpy(mesh.faces)
    raster = rasterize(_unrolled(size), torch.from_numpy(flat), faces)
    on = raster.covered
    if not on.any():
        return np.full((size, size, 3), round(255 * _GREY), np.uint8)
    there = raster.interpolate(mesh.faces, np.column_stack([mesh.vertices, mesh.normals]))[on]
    normals = there[:, 3:] / np.maximum(np.linalg.norm(there[:, 3:], axis=1, keepdims=True), 1e-9)
    texture = np.zeros((size, size, 3), np.uint8)
    texture[on] = np.rint(255 * colors.at(there[:, :3], normals))
    rows, columns = distance_transform_edt(~on, return_distances=False, return_indices=True)
    return texture[rows, columns]


def _unrolled(size: int) -> Camera:
    """The camera that sees (u, -v, -1) at the pixel (u, v) of a texture."""
    intrinsics = torch.diag(torch.tensor([float(size), float(size), 1.0]))
    return Camera(size, size, intrinsics, torch.diag(torch.tensor([1.0, -1.0, -1.0])), torch.zeros(3))
