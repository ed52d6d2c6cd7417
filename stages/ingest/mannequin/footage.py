"""Making a mannequin's clip: in memory for tests and benchmarks, or a frame at a time for the stage."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from pipeline.body import BodyModel, Landmarks, rest_joints
from pipeline.clip.camera import Camera, project
from pipeline.clip.keypoints import Keypoints
from stages.ingest.mannequin.appearance import make_appearance
from stages.ingest.mannequin.attire import surface_offset
from stages.ingest.mannequin.detector import detect
from stages.ingest.mannequin.framing import frame_shot, unseen_camera
from stages.ingest.mannequin.motion import make_motion
from stages.ingest.mannequin.person import make_identity
from stages.ingest.mannequin.scene import Picture, Scene, film, make_background, make_scene
from stages.ingest.mannequin.spec import VIEWS, MannequinSpec
from stages.ingest.mannequin.truth import Places, Truth, find_places, states


@dataclasses.dataclass(frozen=True)
class Mannequin:
    """A clip with its truth.

    Attributes:
        frames: [T, H, W, 3] uint8 RGB.
        masks: [T, H, W] uint8.
        keypoints: what the detector says.
        cameras: frame number -> the pipeline's camera.
        truth: what is known.
        scene: what was filmed, for further cameras.
    """

    frames: np.ndarray
    masks: np.ndarray
    keypoints: Keypoints
    cameras: dict[int, Camera]
    truth: Truth
    scene: Scene


class Filming:
    """A clip while it is being filmed: pictures one at a time, then keypoints and truth.

    Attributes:
        spec: what is filmed.
        scene: bodies and cameras.
        places: where joints and landmarks are.
    """

    def __init__(self, spec: MannequinSpec, body: BodyModel, landmarks: Landmarks) -> None:
        """Decide everything that needs no picture.

        Raises:
            UserError: the motion's BVH file cannot be used.
        """
        self.spec = spec
        identity = make_identity(body, spec.identity)
        appearance = make_appearance(body, landmarks, spec.identity)
        worn = surface_offset(body, appearance.measures, appearance.style)
        clothed = dataclasses.replace(identity, face_offset=identity.face_offset + worn)
        motion = make_motion(
            spec, rest_joints(body, identity), body.parents, body.expression_directions.shape[2]
        )
        shot = frame_shot(spec, body, clothed, motion)
        self.identity = identity
        self.scene = make_scene(body, clothed, appearance, shot, spec.seed)
        self.places: Places = find_places(body, landmarks, identity, shot.poses)
        self._state = np.zeros(self.places.world.shape[:2], np.uint8)

    def pictures(self) -> Iterator[Picture]:
        """The pipeline's frames in order; what is seen of the body in each is noted on the way."""
        camera = self.scene.shot.camera
        background = make_background(camera, self.spec.seed)
        for row in range(self.spec.frames):
            picture = film(self.scene, row, camera, background)
            self._state[row] = states(camera, picture, self.places, row)
            yield picture

    @property
    def point_states(self) -> np.ndarray:
        """[T, K] uint8, of every point of ``places``; known once all the pictures have been taken."""
        return self._state

    def finish(self) -> tuple[Keypoints, Truth]:
        """Keypoints and truth, once all the pictures have been taken."""
        camera, places = self.scene.shot.camera, self.places
        keypoints = detect(self.spec, camera, places, self._state)
        joints, points = places.sets["joints"], places.sets["whole_body"]
        pixels = project_all(camera, places, "whole_body")
        truth = Truth(
            identity=self.identity,
            surface=self.scene.clothed,
            poses=self.scene.shot.poses,
            joints=places.world[:, joints].numpy(),
            joint_state=self._state[:, joints],
            keypoints=pixels,
            keypoint_state=self._state[:, points],
        )
        return keypoints, truth


def project_all(camera: Camera, places: Places, name: str) -> np.ndarray:
    """Where the points of a set really are in the pictures: [T, K, 2] float32."""
    return project(camera, places.world[:, places.sets[name]]).numpy()


def film_view(spec: MannequinSpec, scene: Scene, name: str) -> Iterator[tuple[int, Camera, Picture]]:
    """The frames of a camera that the pipeline never sees: frame number, camera, picture."""
    camera = unseen_camera(scene.shot, name)
    background = make_background(camera, spec.seed + 1 + list(VIEWS).index(name))
    for row in range(0, spec.frames, spec.view_stride):
        yield row, camera, film(scene, row, camera, background)


def make_mannequin(spec: MannequinSpec, body: BodyModel, landmarks: Landmarks) -> Mannequin:
    """Film a whole clip in memory.

    Args:
        spec: what is filmed.
        body: the body, as by ``pipeline.body.load_body``.
        landmarks: as by ``pipeline.body.load_landmarks``.

    Raises:
        UserError: the motion's BVH file cannot be used.
    """
    filming = Filming(spec, body, landmarks)
    pictures = list(filming.pictures())
    keypoints, truth = filming.finish()
    return Mannequin(
        frames=np.stack([picture.image for picture in pictures]),
        masks=np.stack([picture.mask for picture in pictures]),
        keypoints=keypoints,
        cameras=dict.fromkeys(range(spec.frames), filming.scene.shot.camera),
        truth=truth,
        scene=filming.scene,
    )
