"""The clip of a mannequin in memory, or written as the ingest stage publishes it with its truth."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipeline.body import BodyModel, Landmarks, load_body, load_landmarks, rest_joints
from pipeline.body.eyes import shut_expressions
from pipeline.clip.camera import Camera, project
from pipeline.clip.frames import write_frame, write_mask
from pipeline.clip.keypoints import Keypoints, write_keypoints
from pipeline.clip.records import Footage, write_cameras, write_footage, write_split
from stages.ingest.foreground import write_foreground
from stages.ingest.mannequin.appearance import make_appearance
from stages.ingest.mannequin.attire import surface_offset
from stages.ingest.mannequin.framing import frame_motion, unseen_camera
from stages.ingest.mannequin.motion import make_motion
from stages.ingest.mannequin.person import make_identity
from stages.ingest.mannequin.scene import FilmedFrame, Scene, film, make_background, make_scene
from stages.ingest.mannequin.simulated_detector import simulate_detections
from stages.ingest.mannequin.spec import VIEWS, MannequinSpec, UnseenView, mannequin_spec
from stages.ingest.mannequin.truth import BodyPoints, Truth, point_states, pose_points, write_truth
from stages.ingest.preview import write_preview
from stages.ingest.split import split_frames

if TYPE_CHECKING:
    from pipeline.run.stage import Context


@dataclasses.dataclass(frozen=True)
class Mannequin:
    """A clip with its truth, and the scene that was filmed, for further cameras."""

    frames: np.ndarray  # [T, H, W, 3] uint8 RGB
    masks: np.ndarray  # [T, H, W] uint8
    keypoints: Keypoints
    cameras: dict[int, Camera]
    truth: Truth
    scene: Scene


class Filming:
    """A clip while it is being filmed: pictures one at a time, then keypoints and truth.

    Attributes:
        spec: what is filmed.
        scene: bodies and cameras.
        places: the places of joints and landmarks.
        notes: what a user should know of the motion's file, a sentence each.
        point_states: [T, K] uint8, their states, known once all the pictures have been taken.
    """

    def __init__(self, spec: MannequinSpec, body: BodyModel, landmarks: Landmarks) -> None:
        """Make everything that needs no picture.

        Raises:
            UserError: the motion's BVH file cannot be used.
        """
        self.spec = spec
        identity = make_identity(body, spec.identity)
        appearance = make_appearance(body, landmarks, spec.identity)
        worn = surface_offset(body, appearance.measures, appearance.style)
        clothed = dataclasses.replace(identity, face_offset=identity.face_offset + worn)
        shut_eyes = shut_expressions(body, landmarks.face_mesh, identity).sum(0)
        motion = make_motion(spec, rest_joints(body, identity), body.parents, shut_eyes)
        shot = frame_motion(spec, body, clothed, motion)
        self.identity, self.notes = identity, motion.notes
        self.scene = make_scene(body, clothed, appearance, shot, spec.seed)
        self.places: BodyPoints = pose_points(body, landmarks, identity, shot.poses)
        self.point_states = np.zeros(self.places.world.shape[:2], np.uint8)

    def pictures(self) -> Iterator[FilmedFrame]:
        """The pipeline's frames in order; the states of the body's points are kept on the way."""
        camera = self.scene.shot.camera
        background = make_background(camera, self.spec.seed)
        for row in range(self.spec.frames):
            picture = film(self.scene, row, camera, background)
            self.point_states[row] = point_states(camera, picture, self.places, row)
            yield picture

    def finish(self) -> tuple[Keypoints, Truth]:
        """Keypoints and truth, once all the pictures have been taken."""
        camera, places = self.scene.shot.camera, self.places
        keypoints = simulate_detections(self.spec, camera, places, self.point_states)
        joints, points = places.sets["joints"], places.sets["whole_body"]
        truth = Truth(
            self.identity, self.scene.clothed, self.scene.shot.poses,
            joints=places.world[:, joints].numpy(),
            joint_state=self.point_states[:, joints],
            keypoints=project(camera, places.world[:, points]).numpy(),
            keypoint_state=self.point_states[:, points],
        )  # fmt: skip
        return keypoints, truth


def film_view(
    spec: MannequinSpec, scene: Scene, name: UnseenView
) -> Iterator[tuple[int, Camera, FilmedFrame]]:
    """The frames of a camera that the pipeline never sees: frame number, camera, picture."""
    camera = unseen_camera(scene.shot, name)
    background = make_background(camera, spec.seed + 1 + list(VIEWS).index(name))
    for row in range(0, spec.frames, spec.view_stride):
        yield row, camera, film(scene, row, camera, background)


def make_mannequin(spec: MannequinSpec, body: BodyModel, landmarks: Landmarks) -> Mannequin:
    """A whole clip filmed in memory; UserError where the motion's BVH file cannot be used."""
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


def run_mannequin(context: Context) -> None:
    """Film the mannequin that ``context.settings.mannequin...`` describes into ``context.output``.

    Besides the stage's own files there are those of :mod:`.truth`, and for each unseen camera
    ``views/<name>/`` with ``frames/``, ``masks/`` and ``cameras.parquet`` as for the clip itself. A BVH file
    given as the footage (``context.source``) is the motion.

    Raises:
        UserError: the BVH file, the body or its landmarks cannot be used, or too few frames are left to
            learn from.
    """
    settings, output = context.settings, context.output
    spec = mannequin_spec(settings)
    if context.source is not None:
        spec = dataclasses.replace(spec, motion=str(context.source))
    body = load_body(context.body_file)
    frames = tuple(range(spec.frames))
    split = split_frames(frames, settings.test_fraction, settings.test_frames)

    started = time.perf_counter()
    filming = Filming(spec, body, load_landmarks(body, context.body))
    with context.progress(spec.frames, "filming") as progress:
        for row, picture in enumerate(filming.pictures()):
            _write(output, row, picture)
            progress.advance()
    keypoints, truth = filming.finish()
    context.timing("film_seconds", round(time.perf_counter() - started, 2))

    write_foreground(output, frames)
    write_cameras(output / "cameras.parquet", dict.fromkeys(frames, filming.scene.shot.camera))
    write_keypoints(output / "keypoints.parquet", keypoints)
    write_split(output / "split.json", split)
    write_footage(output / "footage.json", describe(spec))
    write_preview(output, keypoints)
    write_truth(output, truth, body)
    for name in spec.views:
        cameras = {}
        for row, camera, picture in film_view(spec, filming.scene, name):
            _write(output / "views" / name, row, picture)
            cameras[row] = camera
        write_foreground(output / "views" / name, sorted(cameras), learn=False)
        write_cameras(output / "views" / name / "cameras.parquet", cameras)
    for note in filming.notes:
        context.log(note)
    context.log(
        f"{spec.frames} frames of a mannequin, {spec.framing} framing, {len(split.test)} of them held out"
    )


def describe(spec: MannequinSpec) -> Footage:
    """The content of ``footage.json``."""
    motion = Path(spec.motion).name if spec.is_bvh else "+".join(spec.layers)
    return Footage(
        name=f"mannequin {spec.framing} {motion}",
        width=spec.size,
        height=spec.size,
        fps=spec.fps,
        scale=1.0,
        read=spec.frames,
        kept=spec.frames,
        dropped={},
        people=1,
        seconds=tuple(round(frame / spec.fps, 6) for frame in range(spec.frames)),
        sources={"keypoints": "mannequin", "masks": "mannequin"},
    )


def _write(folder: Path, row: int, picture: FilmedFrame) -> None:
    for kind in ("frames", "masks"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    write_frame(folder / "frames", row, picture.image)
    write_mask(folder / "masks", row, picture.mask)
