"""The mannequin rendered: one lamp, a still background, two samples a pixel in each direction."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import torch
from torch import Tensor

from pipeline.body import (
    PARTS,
    BodyModel,
    Identity,
    expression_offsets,
    joint_transforms,
    linear_blend_skinning,
    part_labels,
    pose_offsets,
    rasterize,
    rest_joints,
    rest_vertices,
    vertex_normals,
)
from pipeline.body.joints import BODY_POSE
from pipeline.body.parts import joint_parts
from pipeline.clip.camera import Camera
from stages.ingest.mannequin.appearance import Appearance
from stages.ingest.mannequin.framing import FramedMotion

SAMPLES = 2
AMBIENT, SKY, LAMP = 0.50, 0.10, 0.48
LAMP_FROM = (-0.45, 0.60, 0.66)  # in the world: from the left of the pipeline's camera, and above it
GRAIN = 1.2  # of 255, standard deviation
_LIMBS = {"left_arm": 1, "left_hand": 1, "right_arm": 2, "right_hand": 2, "left_leg": 3, "right_leg": 4}
_OF_PART = np.array([_LIMBS.get(part, 0) for part in PARTS], np.int8)


@dataclasses.dataclass(frozen=True)
class FilmedFrame:
    """One frame as a camera sees it.

    Attributes:
        image: [H, W, 3] uint8 RGB.
        mask: [H, W] uint8, the person's alpha.
        depth: [2H, 2W] float32, metres along the camera's Z at each sample, infinite beside the person.
        limb: [2H, 2W] int8, which limb each sample sees, as by ``limbs_of_vertices``; 0 beside the person.
    """

    image: np.ndarray
    mask: np.ndarray
    depth: np.ndarray
    limb: np.ndarray


@dataclasses.dataclass(frozen=True)
class Scene:
    """The clothed body, its motion and its looks.

    Attributes:
        clothed: the person, hair and clothes included as offsets of the template.
        seed: of background and grain.
        rest: [V, 3], the clothed surface in T pose without expression.
        transforms: [T, 55, 3, 4], of the joints.
        limbs: [V] int8, as by ``limbs_of_vertices``.
    """

    body: BodyModel
    clothed: Identity
    appearance: Appearance
    shot: FramedMotion
    seed: int
    rest: Tensor
    transforms: Tensor
    limbs: np.ndarray

    def vertices(self, row: int) -> Tensor:
        """The clothed surface in the world in one frame: [V, 3], metres."""
        poses = self.shot.poses
        rest = self.rest + expression_offsets(self.body, poses.expression[row])
        correctives = pose_offsets(self.body, poses.rotation[row])
        if correctives is not None:
            rest = rest + correctives
        return (
            linear_blend_skinning(self.transforms[row], self.body.skinning_weights, rest) + poses.transl[row]
        )


def limbs_of_vertices(body: BodyModel) -> np.ndarray:
    """The limb of each vertex: [V] int8; 0 on trunk and head, 1 to 4 on arms and legs."""
    return _OF_PART[part_labels(body).numpy()]


def limbs_of_joints(joint: Tensor) -> np.ndarray:
    """The limb of points [K] that are joints; -1 for fingers, points of the surface (-1), trunk and head."""
    limbs = _OF_PART[joint_parts().numpy()]
    limbs[limbs == 0] = -1
    limbs[BODY_POSE.stop :] = -1  # fingers do hide one another
    return np.where(joint.numpy() >= 0, limbs[joint.clamp_min(0).numpy()], -1)


def make_scene(
    body: BodyModel, clothed: Identity, appearance: Appearance, shot: FramedMotion, seed: int
) -> Scene:
    """The scene of a person with a look and a motion."""
    transforms = joint_transforms(shot.poses.rotation, rest_joints(body, clothed), body.parents)
    rest, limbs = rest_vertices(body, clothed), limbs_of_vertices(body)
    return Scene(body, clothed, appearance, shot, seed, rest, transforms, limbs)


def film(scene: Scene, row: int, camera: Camera, background: np.ndarray) -> FilmedFrame:
    """One frame of one camera before a ``background`` [H, W, 3] float32, as by :func:`make_background`."""
    size = (camera.width, camera.height)
    vertices, faces = scene.vertices(row), scene.body.faces
    fine = camera.resized(size[0] * SAMPLES, size[1] * SAMPLES)
    raster = rasterize(fine, vertices, faces)
    marks = torch.from_numpy(scene.appearance.marks)
    carried = torch.cat([scene.body.v_template, marks, vertex_normals(vertices, faces)], dim=1)
    seen = raster.covered
    surface = raster.interpolate(faces.numpy(), carried.numpy())[seen]
    footprint = raster.depth[seen] / np.float32(fine.intrinsics[0, 0])
    colors = (
        scene.appearance.colors(surface[:, :3], surface[:, 3:5], footprint) * _light(surface[:, 5:])[:, None]
    )
    samples = np.zeros((*seen.shape, 4), np.float32)
    samples[seen, :3] = np.clip(colors, 0, 255)
    samples[seen, 3] = 1
    limb = np.where(seen, scene.limbs[faces[:, 0].numpy()][raster.face], 0).astype(np.int8)
    pixels = cv2.resize(samples, size, interpolation=cv2.INTER_AREA)
    image = pixels[..., :3] + (1 - pixels[..., 3:]) * background
    grain = np.random.default_rng([scene.seed, 5, row]).standard_normal(image.shape, np.float32)
    image = np.clip(np.round(image + GRAIN * grain), 0, 255).astype(np.uint8)
    return FilmedFrame(image, np.round(pixels[..., 3] * 255).astype(np.uint8), raster.depth, limb)


def make_background(camera: Camera, seed: int) -> np.ndarray:
    """A blurred room: wall, floor and a few things, [H, W, 3] float32 in 0 to 255."""
    rng = np.random.default_rng([seed, 6])
    height, width = camera.height, camera.width
    room = np.empty((height, width, 3), np.float32)
    horizon = int(height * rng.uniform(0.66, 0.8))
    room[:horizon] = rng.uniform(140, 190) + rng.uniform(-15, 15, 3)
    room[horizon:] = rng.uniform(80, 120) + rng.uniform(-15, 15, 3)
    for _ in range(14):
        x, y = rng.uniform(0, width), rng.uniform(0, horizon)
        w, h = rng.uniform(0.04, 0.22, 2) * height
        color = tuple(float(c) for c in rng.uniform(90, 200) + rng.uniform(-25, 25, 3))
        cv2.rectangle(room, (int(x - w), int(y - h)), (int(x + w), int(y + h)), color, -1)
    room = np.asarray(cv2.GaussianBlur(room, (0, 0), 0.012 * height))
    vignette = np.linspace(1.06, 0.88, height, dtype=np.float32)[:, None, None]
    return np.clip(room * vignette, 0, 255)


def _light(normals: np.ndarray) -> np.ndarray:
    """Brightness by Lambert's law under a lamp and a sky: [N, 3] normals of any length -> [N]."""
    unit = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    lamp = np.array(LAMP_FROM, np.float32) / np.float32(np.linalg.norm(LAMP_FROM))
    return AMBIENT + SKY * (0.5 + 0.5 * unit[:, 1]) + LAMP * np.maximum(unit @ lamp, 0)
