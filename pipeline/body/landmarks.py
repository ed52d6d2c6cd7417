"""The places on the body of the points that 2D estimators detect.

Four sets, each in its estimator's order:

- ``whole_body``: the 133 keypoints of COCO-WholeBody (17 body, 6 feet, 68 face in iBUG order, 21 of
  each hand), for DWPose, mmpose and our own records;
- ``pose``: MediaPipe's 33 pose landmarks;
- ``hands``: MediaPipe's 21 hand landmarks, left then right;
- ``face_mesh``: MediaPipe's 478 face landmarks, 468 of the face and 5 of each iris.

``tools/build_landmarks.py`` finds them for a body; they are kept beside it by its topology.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pipeline.body.body_model import BodyModel
from pipeline.errors import UserError, first_line

SIZES = {"whole_body": 133, "pose": 33, "hands": 42, "face_mesh": 478}
"""The sets and how many points each has."""


@dataclasses.dataclass(frozen=True)
class PointSet:
    """Points of the body, each a joint or a point on the surface.

    Attributes:
        joint: [K] int64, the joint, or -1 for a point on the surface.
        vertices: [K, 3] int64, the corners of the triangle that a surface point lies on.
        barycentrics: [K, 3] float32, its place on that triangle; rows sum to 1.
    """

    joint: Tensor  # [K]
    vertices: Tensor  # [K, 3]
    barycentrics: Tensor  # [K, 3]

    def __len__(self) -> int:
        return len(self.joint)

    def __getitem__(self, rows) -> PointSet:
        """The points of some rows (a slice, a mask or indices)."""
        return PointSet(self.joint[rows], self.vertices[rows], self.barycentrics[rows])

    def to(self, device: torch.device | str) -> PointSet:
        """The same points on another device."""
        return PointSet(self.joint.to(device), self.vertices.to(device), self.barycentrics.to(device))

    def compact(self) -> tuple[Tensor, PointSet]:
        """The vertices that these points touch, which are all that a fit has to pose.

        Returns:
            vertex_ids: [M] int64, rows of the body's arrays, ascending.
            points: the same points over those M vertices.
        """
        on_surface = self.joint < 0
        ids, inverse = torch.unique(self.vertices[on_surface], return_inverse=True)
        vertices = torch.zeros_like(self.vertices)
        vertices[on_surface] = inverse
        return ids, dataclasses.replace(self, vertices=vertices)


@dataclasses.dataclass(frozen=True)
class Landmarks:
    """The four sets of points of one body; see the module's text for their orders."""

    whole_body: PointSet  # 133
    pose: PointSet  # 33
    hands: PointSet  # 42
    face_mesh: PointSet  # 478


def join(*sets: PointSet) -> PointSet:
    """Several sets one after the other."""
    return PointSet(*(torch.cat([getattr(s, f.name) for s in sets]) for f in dataclasses.fields(PointSet)))


def locate(points: PointSet, joints: Tensor, vertices: Tensor) -> Tensor:
    """The points' positions on a posed body.

    Args:
        points: K points.
        joints: [..., 55, 3].
        vertices: [..., V, 3]; may be [..., 0, 3] if every point is a joint.

    Returns:
        [..., K, 3] in the same frame of reference; differentiable.
    """
    at_joint = joints[..., points.joint.clamp_min(0), :]
    if vertices.shape[-2] == 0:
        return at_joint
    corners = vertices[..., points.vertices, :]  # [..., K, 3, 3]
    on_surface = (corners * points.barycentrics.to(corners.dtype)[..., None]).sum(-2)
    return torch.where((points.joint >= 0)[:, None], at_joint, on_surface)


def landmarks_file(body: BodyModel, folder: Path) -> Path:
    """The file that holds the landmarks of bodies with this topology."""
    return Path(folder) / f"landmarks_{body.topology[:12]}.npz"


def load_landmarks(body: BodyModel, folder: Path) -> Landmarks:
    """Read the landmarks of a body from a folder such as ``data/body``.

    Raises:
        UserError: there are none for this body's topology, or the file is damaged.
    """
    path = landmarks_file(body, folder)
    remedy = f"make it with: python tools/build_landmarks.py BODY.npz --face WHEEL --out {path.parent}"
    remedy += " (docs/bring.md says which wheel)"
    if not path.is_file():
        raise UserError(f"{path} is missing, so it is not known where keypoints lie on this body: {remedy}")
    try:
        with np.load(path, allow_pickle=False) as archive:
            return Landmarks(**{name: _point_set(archive, name, body) for name in SIZES})
    except Exception as error:  # a damaged archive raises nearly anything
        raise UserError(f"{path} cannot be read as landmarks ({first_line(error)}): {remedy}") from error


def _point_set(archive: np.lib.npyio.NpzFile, name: str, body: BodyModel) -> PointSet:
    joint, vertices, barycentrics = (archive[f"{name}_{f.name}"] for f in dataclasses.fields(PointSet))
    count = SIZES[name]
    if joint.shape != (count,) or vertices.shape != (count, 3) or barycentrics.shape != (count, 3):
        raise ValueError(f"{name} has not {count} points")
    if joint.max() >= len(body.parents) or vertices.min() < 0 or vertices.max() >= len(body.v_template):
        raise ValueError(f"{name} has indices that the body has not")
    if not np.allclose(barycentrics[joint < 0].sum(1), 1, atol=1e-3):
        raise ValueError(f"{name} has barycentrics that do not sum to 1")
    return PointSet(
        torch.from_numpy(joint.astype(np.int64)),
        torch.from_numpy(vertices.astype(np.int64)),
        torch.from_numpy(barycentrics.astype(np.float32)),
    )
