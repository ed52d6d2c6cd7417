"""The mannequin that every layout is written from: filmed once, by cameras whose conventions are known."""

from __future__ import annotations

import dataclasses
import functools

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from pipeline.body import BodyModel, Identity, Poses, pose_body, rest_joints
from pipeline.clip.camera import Camera
from stages.ingest.mannequin.footage import Filming
from stages.ingest.mannequin.scene import film, make_background
from stages.ingest.mannequin.spec import Framing, MannequinSpec
from tests.made.body import open_body, open_landmarks

SIZE, COUNT, FEW = 112, 6, 3


@dataclasses.dataclass(frozen=True)
class Take:
    """The first frames of the motion by one camera, which may move.

    Attributes:
        images: [T, H, W, 3] uint8 RGB; masks: [T, H, W] uint8, 255 is the person.
        matrix: [3, 3], pixels, the first pixel's centre at (0.5, 0.5).
        rotation, translation: [T, 3, 3] and [T, 3], world-to-camera, OpenCV axes, metres.
        keypoints: [T, 133, 3], pixels and a score of 1 in the picture.
    """

    images: np.ndarray
    masks: np.ndarray
    matrix: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray
    keypoints: np.ndarray

    def rows(self, chosen: slice) -> Take:
        kept = {f.name: getattr(self, f.name)[chosen] for f in dataclasses.fields(self) if f.name != "matrix"}
        return Take(matrix=self.matrix, **kept)


@dataclasses.dataclass(frozen=True)
class Footage:
    """The person, the motion in the world (Y up), and takes of it.

    Attributes:
        still: a camera that stands still; moving: one on an arc; rig: three
            that stand still, the further ones for FEW frames.
    """

    body: BodyModel
    identity: Identity
    surface: Identity
    poses: Poses
    still: Take
    moving: Take
    rig: tuple[Take, ...]

    @property
    def root(self) -> np.ndarray:
        """The root joint at rest, [3]."""
        return rest_joints(self.body, self.identity)[0].double().numpy()

    @property
    def pelvis(self) -> np.ndarray:
        """The root joint in the world, [T, 3]: a body turns about it."""
        return self.root + self.poses.transl.double().numpy()

    @property
    def orient(self) -> np.ndarray:
        """The root's rotation in the world, [T, 3, 3]."""
        return Rotation.from_rotvec(self.poses.rotation[:, 0].double().numpy()).as_matrix()


MOTIONS: dict[Framing, str] = {"full": "turn+gesture+curl+speech", "head": "nod+speech"}


@functools.cache
def footage(framing: Framing = "full") -> Footage:
    """Film it; all tests share what comes out."""
    body = open_body()
    motion = MOTIONS[framing]
    spec = MannequinSpec(framing, motion=motion, frames=COUNT, size=SIZE, fps=8.0, noise=0.0)
    filming = Filming(spec, body, open_landmarks())
    points = filming.places.world[:, filming.places.sets["whole_body"]].double().numpy()
    first = filming.scene.shot.camera
    poses = filming.scene.shot.poses
    middle = (rest_joints(body, filming.identity)[0] + poses.transl.mean(0)).double().numpy()

    def take(azimuths: list[float]) -> Take:
        cameras = [_turned(first, middle, angle) for angle in azimuths]
        pictures = [
            film(filming.scene, row, camera, make_background(camera, spec.seed))
            for row, camera in enumerate(cameras)
        ]
        return Take(
            images=np.stack([one.image for one in pictures]),
            masks=np.stack([one.mask for one in pictures]),
            matrix=first.intrinsics.double().numpy(),
            rotation=np.stack([camera.rotation.double().numpy() for camera in cameras]),
            translation=np.stack([camera.translation.double().numpy() for camera in cameras]),
            keypoints=np.stack([_project(camera, points[row]) for row, camera in enumerate(cameras)]),
        )

    still = take([0.0] * COUNT)
    moving = take(np.linspace(-20, 25, COUNT).tolist())
    rig = (still, take([50.0] * FEW), take([-70.0] * FEW))
    return Footage(body, filming.identity, filming.scene.clothed, poses, still, moving, rig)


def _turned(camera: Camera, middle: np.ndarray, degrees: float) -> Camera:
    """The camera carried around the person about the vertical, and lifted a little."""
    turn = Rotation.from_euler("yx", [degrees, 0.1 * degrees], degrees=True).as_matrix()
    rotation = camera.rotation.double().numpy() @ turn.T
    shift = (
        camera.translation.double().numpy() + camera.rotation.double().numpy() @ middle - rotation @ middle
    )
    return dataclasses.replace(
        camera, rotation=torch.from_numpy(rotation).float(), translation=torch.from_numpy(shift).float()
    )


def _project(camera: Camera, points: np.ndarray) -> np.ndarray:
    there = points @ camera.rotation.double().numpy().T + camera.translation.double().numpy()
    pixels = (there / there[:, 2:]) @ camera.intrinsics.double().numpy().T
    within = ((pixels[:, :2] > 0) & (pixels[:, :2] < SIZE)).all(1)
    return np.concatenate([pixels[:, :2], within[:, None].astype(float)], axis=1)


def silhouette(vertices: np.ndarray, faces: np.ndarray, camera: Camera) -> np.ndarray:
    """Which pixels a mesh covers: [H, W] bool."""
    there = vertices @ camera.rotation.double().numpy().T + camera.translation.double().numpy()
    pixels = ((there / there[:, 2:]) @ camera.intrinsics.double().numpy().T)[:, :2]
    fixed = np.round((pixels - 0.5) * 16).astype(np.int32)
    picture = np.zeros((camera.height, camera.width), np.uint8)
    for triangle in fixed[faces]:
        cv2.fillConvexPoly(picture, triangle, 1, shift=4)
    return picture > 0


def joints_and_surface(shown: Footage, poses: Poses, rows: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Joints [N, 55, 3] and clothed vertices [N, V, 3] of some rows, in the world."""
    chosen = torch.tensor(rows)
    parts = (poses.rotation[chosen], poses.expression[chosen], poses.transl[chosen])
    vertices, joints = pose_body(shown.body, shown.surface, *parts)
    return joints.double().numpy(), vertices.double().numpy()
