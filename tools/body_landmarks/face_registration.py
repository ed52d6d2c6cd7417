"""MediaPipe's canonical face mesh laid onto the head of a body."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
import trimesh
from scipy.interpolate import RBFInterpolator
from scipy.spatial import cKDTree

from body_landmarks.tables import LOWER_LIP, UPPER_LIP, mirror_of
from pipeline.body import BodyModel, joint_index, rasterize
from pipeline.clip.camera import Camera

_YAWS = (-1.2, -0.8, -0.4, 0.0, 0.4, 0.8, 1.2)  # radians, views from which a face is looked at
_PITCHES = (0.0, 0.5)  # the second from below
_ROUNDS = 4
_CANDIDATES = 48  # triangles by nearest centre among which the closest point is sought


@dataclasses.dataclass(frozen=True)
class Surface:
    """Triangles of a body on which points may be placed.

    Attributes:
        vertices: [V, 3] float64, of the whole body, metres.
        faces: [F, 3] int64, of the allowed triangles.
    """

    vertices: np.ndarray
    faces: np.ndarray

    def closest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The nearest points: [N, 3] -> triangles [N, 3], barycentrics [N, 3], positions [N, 3]."""
        corners = self.vertices[self.faces]
        count = min(_CANDIDATES, len(self.faces))
        _, near = cKDTree(corners.mean(1)).query(points, k=range(1, count + 1))
        pairs = corners[near].reshape(-1, 3, 3), np.repeat(points, count, axis=0)
        on = trimesh.triangles.closest_point(*pairs).reshape(*near.shape, 3)
        best = np.linalg.norm(on - points[:, None], axis=2).argmin(1)
        rows = np.arange(len(points))
        triangle, position = near[rows, best], on[rows, best]
        barycentrics = trimesh.triangles.points_to_barycentric(corners[triangle], position)
        barycentrics = np.clip(barycentrics, 0, None)
        barycentrics /= barycentrics.sum(1, keepdims=True)
        return self.faces[triangle], barycentrics, position

    def part(self, chosen: np.ndarray) -> Surface:
        """Some of the triangles: a mask over them."""
        return Surface(self.vertices, self.faces[chosen])


@dataclasses.dataclass(frozen=True)
class Face:
    """A head's outer skin, apart by lip.

    Attributes:
        skin: what is seen of the head from before it, without the eyeballs. A ray through the
            closed lips, or a nearest point without this, ends up inside the mouth.
        upper, lower: the skin that the jaw leaves, and takes along, when it opens.
    """

    skin: Surface
    upper: Surface
    lower: Surface


def face_of(body: BodyModel) -> Face:
    """The parts of a body's skin that face points may lie on."""
    weights = body.skinning_weights.numpy()
    eyes = weights[:, [joint_index("left_eye"), joint_index("right_eye")]].sum(1)
    jaw = weights[:, joint_index("jaw")]
    faces = body.faces.numpy()
    allowed = _seen_faces(body) & (eyes[faces] < 0.5).all(1)
    skin = Surface(body.v_template.numpy().astype(np.float64), faces[allowed])
    follows = jaw[skin.faces].mean(1)
    return Face(skin, skin.part(follows < 0.3), skin.part(follows >= 0.3))


def _seen_faces(body: BodyModel) -> np.ndarray:
    """[F] bool: the triangles of the head that at least one of the views sees."""
    joints = body.joint_regressor @ body.v_template
    head = torch.tensor([joint_index(name) for name in ("neck", "head", "jaw", "left_eye", "right_eye")])
    on_head = body.skinning_weights[:, head].sum(1) > 0.5
    kept = torch.nonzero(on_head[body.faces].all(1))[:, 0]
    centre = joints[joint_index("head")] + torch.tensor([0.0, 0.03, 0.05])
    seen = np.zeros(len(body.faces), bool)
    for yaw in _YAWS:
        for pitch in _PITCHES:
            raster = rasterize(_view(centre, yaw, pitch), body.v_template, body.faces[kept])
            seen[kept.numpy()[np.unique(raster.face[raster.covered])]] = True
    return seen


def _view(centre: torch.Tensor, yaw: float, pitch: float) -> Camera:
    """A camera 2 m away that looks at the head, from ``yaw`` to the side and ``pitch`` from below."""
    turn = trimesh.transformations.euler_matrix(pitch, yaw, 0, "rxyz")[:3, :3]
    rotation = torch.tensor(np.diag([1.0, -1.0, -1.0]) @ turn, dtype=torch.float32)
    intrinsics = torch.tensor([[4800.0, 0, 400], [0, 4800.0, 400], [0, 0, 1]])
    return Camera(800, 800, intrinsics, rotation, torch.tensor([0.0, 0, 2.0]) - rotation @ centre)


def register(
    canonical: np.ndarray,  # [468, 3]
    seeds: dict[int, np.ndarray],
    face: Face,
) -> tuple[np.ndarray, np.ndarray]:
    """Bend the canonical face onto the skin.

    A similarity and then a thin-plate spline take the seeds to their places; what follows draws all
    points to the nearest skin of their kind, each round with less smoothing. Face and head are
    taken to be symmetric, and the result is.

    Args:
        canonical: the face mesh, any units; X to the subject's left, Y up, Z to the front.
        seeds: face-mesh index -> its place on the body [3], metres.
        face: where points may lie.

    Returns:
        vertices [468, 3] int64 and barycentrics [468, 3] float64.
    """
    index, target = np.array(list(seeds)), np.array(list(seeds.values()))
    mirror = mirror_of(canonical)
    fitted, _, _ = trimesh.registration.procrustes(canonical[index], target, reflection=False)
    start = trimesh.transform_points(canonical, fitted)
    spline = RBFInterpolator(start[index], target - start[index], kernel="thin_plate_spline", smoothing=1e-9)
    points = start + spline(start)
    for smoothing in 3e-4 * np.arange(_ROUNDS, 0, -1):
        drawn = _closest(points, face)[2]
        drawn = (drawn + drawn[mirror] * [-1, 1, 1]) / 2
        spline = RBFInterpolator(
            start, drawn - start, kernel="thin_plate_spline", smoothing=smoothing, neighbors=60
        )
        points = start + spline(start)
        points[index] = (points[index] + target) / 2
    return _closest(points, face)[:2]


def _closest(points: np.ndarray, face: Face) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """As ``Surface.closest``, each lip's points on that lip."""
    triangles, barycentrics, positions = face.skin.closest(points)
    for rows, surface in ((list(UPPER_LIP), face.upper), (list(LOWER_LIP), face.lower)):
        triangles[rows], barycentrics[rows], positions[rows] = surface.closest(points[rows])
    return triangles, barycentrics, positions
