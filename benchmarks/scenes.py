"""A body made of capsules and covered with flat Gaussians, for the rasterizer to draw."""

from __future__ import annotations

import numpy as np
import torch
import trimesh

from pipeline.clip.camera import Camera, facing_camera
from pipeline.splat import Gaussians

# The ends of each limb's axis and its radius, metres. Y is up, the body is 1.75 m tall and stands on y = 0.
_LIMBS = {
    "torso": ((0.0, 0.95, 0.0), (0.0, 1.35, 0.0), 0.15),
    "neck": ((0.0, 1.45, 0.0), (0.0, 1.55, 0.0), 0.055),
    "head": ((0.0, 1.60, 0.0), (0.0, 1.65, 0.01), 0.10),
    "left_upper_arm": ((0.19, 1.38, 0.0), (0.38, 1.14, 0.0), 0.048),
    "right_upper_arm": ((-0.19, 1.38, 0.0), (-0.38, 1.14, 0.0), 0.048),
    "left_forearm": ((0.38, 1.14, 0.0), (0.50, 0.90, 0.07), 0.038),
    "right_forearm": ((-0.38, 1.14, 0.0), (-0.50, 0.90, 0.07), 0.038),
    "left_thigh": ((0.09, 0.90, 0.0), (0.12, 0.48, 0.01), 0.078),
    "right_thigh": ((-0.09, 0.90, 0.0), (-0.12, 0.48, 0.01), 0.078),
    "left_shin": ((0.12, 0.48, 0.01), (0.14, 0.06, -0.02), 0.052),
    "right_shin": ((-0.12, 0.48, 0.01), (-0.14, 0.06, -0.02), 0.052),
}
_DISTANCE = 3.0  # of the body from the camera, metres


def body_scene(count: int, seed: int = 0, dtype: torch.dtype = torch.float32) -> Gaussians:
    """``count`` flat, mostly opaque Gaussians on a body's surface, before ``body_camera``, in random order.

    They overlap about as a subdivided body's do: the wide axes are near the distance between neighbours.
    """
    generator = np.random.default_rng(seed)
    surface = trimesh.util.concatenate([_capsule(*limb) for limb in _LIMBS.values()])
    assert isinstance(surface, trimesh.Trimesh)
    points, faces = trimesh.sample.sample_surface(surface, count, seed=seed)
    spacing = np.sqrt(surface.area / count)
    wide = 0.7 * spacing * np.exp(0.3 * generator.normal(size=(count, 2)))
    arrays = {
        "means": points + np.array([0.0, -0.88, -_DISTANCE]),
        "quaternions": _facing(surface.face_normals[faces]),
        "scales": np.concatenate([wide, np.full((count, 1), 0.2 * spacing)], axis=1),
        "colors": generator.random((count, 3)),
        "opacities": generator.uniform(0.7, 0.98, count),
    }
    return Gaussians(**{name: torch.tensor(array, dtype=dtype) for name, array in arrays.items()})


def body_camera(size: int, dtype: torch.dtype = torch.float32) -> Camera:
    """A camera that shows the whole body in ``size`` x ``size`` pixels."""
    return facing_camera(size, size, focal=1.45 * size).to(dtype)


def _capsule(start: tuple[float, ...], end: tuple[float, ...], radius: float) -> trimesh.Trimesh:
    """The capsule whose axis runs from ``start`` to ``end``."""
    axis = np.subtract(end, start)
    capsule = trimesh.creation.capsule(height=float(np.linalg.norm(axis)), radius=radius, count=(24, 24))
    capsule.apply_transform(trimesh.geometry.align_vectors([0, 0, 1], axis))  # made along Z, from the origin
    capsule.apply_translation(start)
    return capsule


def _facing(normals: np.ndarray) -> np.ndarray:
    """Quaternions (w, x, y, z) that turn the Z axis to ``normals``: [N, 3] -> [N, 4], not normalised."""
    x, y, z = normals.T
    return np.stack([1 + z + 1e-6, -y, x, np.zeros_like(z)], axis=1)
