"""The colour of every point of the mannequin, as a function of its place on the template."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from torch import Tensor

from pipeline.body import BodyModel, Landmarks, joint_index, rasterize
from pipeline.clip.camera import facing_camera, project
from stages.ingest.mannequin.attire import GarmentDepths, Measures, Style, garments, make_style, measure
from stages.ingest.mannequin.face_paint import Decal, paint_face, paint_print

_SOLE = 0.012  # metres
_MOUTH = (92.0, 30.0, 30.0)
_LEATHER, _BRASS = (78.0, 50.0, 34.0), (196.0, 184.0, 140.0)


@dataclasses.dataclass(frozen=True)
class Appearance:
    """A clothed and painted body.

    Attributes:
        measures, style: what is worn.
        face, chest, back: the pictures on it.
        sole: the height of the lowest point of the template.
        marks: [V, 2] float32, per vertex: 1 on the eyeballs, and above 0.5 inside the mouth.
    """

    measures: Measures
    style: Style
    face: Decal
    chest: Decal
    back: Decal
    sole: float
    marks: np.ndarray

    def colors(self, points: np.ndarray, marks: np.ndarray, footprint: np.ndarray) -> np.ndarray:
        """Colours without light.

        Args:
            points: [N, 3] float32, places on the template in T pose, metres.
            marks: [N, 2] float32, the vertices' marks between them.
            footprint: [N] float32, metres that a sample covers; patterns finer than it fade to their mean.

        Returns:
            [N, 3] float32, RGB in 0 to 255.
        """
        fields = garments(points, self.measures, self.style)
        colors = np.empty((len(points), 3), np.float32)
        bare = np.ones(len(points), bool)
        for where, paint in (
            (marks[:, 0] > 0.5, self._eye),
            (marks[:, 1] > 0.5, self._mouth),
            (fields.hair > 0, self._hair),
            (fields.shoes > 0, self._shoes),
            (fields.trousers > 0, self._trousers),
            (fields.shirt > 0, self._shirt),
            (np.ones(len(points), bool), self._skin),
        ):
            rows = np.flatnonzero(where & bare)
            bare[rows] = False
            if len(rows):
                colors[rows] = paint(points[rows], footprint[rows])
        self._lay_prints(colors, points, fields, float(np.median(footprint)) if len(footprint) else 1.0)
        return colors

    def _lay_prints(
        self, colors: np.ndarray, points: np.ndarray, fields: GarmentDepths, level: float
    ) -> None:
        """Paint the belt, the shirt's hems and its prints, in place."""
        trim = (fields.shirt > 0) & (fields.shirt < 0.01) & (points[:, 1] > self.measures.waist + 0.02)
        _fill(colors, trim, np.array(self.style.trim, np.float32) * 0.92)
        belt = (fields.belt > 0) & (np.abs(points[:, 0]) < 0.25)
        _fill(colors, belt, np.array(_LEATHER, np.float32))
        _fill(
            colors, belt & (np.abs(points[:, 0]) < 0.022) & (points[:, 2] > 0), np.array(_BRASS, np.float32)
        )
        cloth = (fields.shirt > 0.01) & ~trim
        self.chest.lay(colors, points, cloth & (points[:, 2] > self.measures.neck[2]), level)
        self.back.lay(colors, points, cloth & (points[:, 2] < self.measures.neck[2] - 0.02), level)

    def _skin(self, points: np.ndarray, footprint: np.ndarray) -> np.ndarray:
        tone = np.array(self.style.skin, np.float32)
        blotches = noise(points, 0.05, footprint)[:, None] * np.array([5.0, 8.0, 8.0], np.float32)
        freckles = np.maximum(noise(points, 0.007, footprint, 1) - 0.5, 0)[:, None] * 45
        colors = tone + blotches - freckles * np.array([0.7, 1.0, 1.0], np.float32)
        in_front = (points[:, 1] > self.measures.neck[1]) & (points[:, 2] > self.measures.jaw[2] + 0.01)
        self.face.lay(colors, points, in_front, float(np.median(footprint)))
        return colors

    def _mouth(self, points: np.ndarray, footprint: np.ndarray) -> np.ndarray:
        return np.broadcast_to(np.array(_MOUTH, np.float32), points.shape)

    def _shirt(self, points: np.ndarray, footprint: np.ndarray) -> np.ndarray:
        cloth, trim = (np.array(color, np.float32) for color in (self.style.cloth, self.style.trim))
        if self.style.shirt == "plaid":
            share = sum(0.22 * stripes(points[:, k], 0.045, footprint) for k in range(3))
            fine = sum(0.16 * stripes(points[:, k], 0.0085, footprint) for k in range(3))
            share = np.clip(share + fine, 0, 1)
        elif self.style.shirt == "stripes":
            # Round the trunk and round the arms, which lie along X in T pose.
            along = np.where(np.abs(points[:, 0]) > 0.19, points[:, 0], points[:, 1])
            share = 0.85 * stripes(along, 0.03, footprint) + 0.15 * stripes(
                along + points[:, 2], 0.005, footprint
            )
        else:
            share = np.clip(
                dots(points, 0.028, footprint) + 0.15 * stripes(points.sum(1), 0.006, footprint), 0, 1
            )
        weave = 1 + 0.05 * noise(points, 0.03, footprint)
        return (cloth + (trim - cloth) * share[:, None]) * weave[:, None]

    def _trousers(self, points: np.ndarray, footprint: np.ndarray) -> np.ndarray:
        twill = 0.14 * (
            stripes(points[:, 1] + 0.7 * points[:, 0] + 0.7 * points[:, 2], 0.007, footprint) - 0.5
        )
        middle = np.abs(points[:, 0]) - 0.12
        worn = 0.28 * np.exp(-((middle / 0.05) ** 2)) * np.clip(points[:, 2] / 0.06, -0.4, 1)
        shade = 1 + twill + worn + 0.06 * noise(points, 0.1, footprint)
        return np.array(self.style.trousers, np.float32) * shade[:, None]

    def _shoes(self, points: np.ndarray, footprint: np.ndarray) -> np.ndarray:
        colors = np.array(self.style.shoes, np.float32) * (1 + 0.1 * noise(points, 0.02, footprint))[:, None]
        _fill(colors, points[:, 1] < self.sole + _SOLE, np.array((225, 222, 214), np.float32))
        laces = (points[:, 2] > 0.05) & (np.abs(np.abs(points[:, 0]) - 0.16) < 0.022)
        white = (laces & (points[:, 1] > self.sole + 0.035)) * stripes(points[:, 2], 0.016, footprint)
        return colors + white[:, None] * (230 - colors)

    def _hair(self, points: np.ndarray, footprint: np.ndarray) -> np.ndarray:
        away = points - np.array([0.012, self.measures.eye[1], self.measures.jaw[2] - 0.03], np.float32)
        angle = np.arctan2(away[:, 0], away[:, 2])
        bent = angle + 0.12 * noise(points, 0.05, footprint)
        strands = (
            stripes(bent, 0.055, footprint * 9) - 0.5 + 0.6 * (stripes(bent, 0.021, footprint * 9) - 0.5)
        )
        sheen = np.exp(-(((away[:, 1] - 0.065) / 0.02) ** 2)) * 0.35
        shade = 1 + 0.45 * strands + sheen + 0.1 * noise(points, 0.02, footprint)
        return np.array(self.style.hair, np.float32) * shade[:, None] + (6 + 40 * sheen)[:, None]

    def _eye(self, points: np.ndarray, footprint: np.ndarray) -> np.ndarray:
        centre = self.measures.eye.astype(np.float32)
        away = np.stack([np.abs(points[:, 0]) - centre[0], points[:, 1] - centre[1]], axis=1)
        radius = np.linalg.norm(away, axis=1) / self.measures.eyeball
        front = points[:, 2] > centre[2]
        colors = np.full((len(points), 3), (236, 232, 226), np.float32)
        rays = 0.8 + 0.4 * stripes(np.arctan2(away[:, 1], away[:, 0]), 0.3, footprint * 100)
        iris = front & (radius < 0.46)
        colors[iris] = np.array(self.style.iris, np.float32) * rays[iris, None]
        _fill(colors, front & (radius < 0.46) & (radius > 0.40), np.array(self.style.iris, np.float32) * 0.45)
        _fill(colors, front & (radius < 0.2), np.array((12, 12, 14), np.float32))
        glint = np.linalg.norm(away - 0.16 * self.measures.eyeball, axis=1) / self.measures.eyeball
        _fill(colors, front & (glint < 0.09), np.array((250, 250, 250), np.float32))
        return colors


def make_appearance(body: BodyModel, landmarks: Landmarks, seed: int) -> Appearance:
    """The look of a person; equal seeds give equal looks. ``landmarks`` place the face's features."""
    measures, style = measure(body), make_style(seed)
    chest, back = paint_print(measures, style)
    face = paint_face(body, landmarks, measures, style)
    balls = body.skinning_weights[:, [joint_index("left_eye"), joint_index("right_eye")]].sum(1)
    marks = torch.stack([balls, _inside_mouth(body, landmarks)], dim=1).numpy()
    return Appearance(measures, style, face, chest, back, float(body.v_template[:, 1].min()), marks)


def _inside_mouth(body: BodyModel, landmarks: Landmarks) -> Tensor:
    """Above 0.5 at vertices 2 mm or more behind the closed lips, seen from the front: [V] float32."""
    lip = landmarks.face_mesh[13:14]  # the middle of the upper lip's inner edge
    centre = (body.v_template[lip.vertices[0]] * lip.barycentrics[0][:, None]).sum(0)
    far = 20.0  # metres: as good as parallel
    camera = facing_camera(200, 200, far / 0.0005)
    vertices = body.v_template - centre - torch.tensor([0.0, 0.0, far])
    front = torch.from_numpy(rasterize(camera, vertices, body.faces).depth)
    x, y = project(camera, vertices).clamp(0, 199).long().unbind(1)
    away = vertices + torch.tensor([0.0, 0.0, far])
    near = (away[:, 0].abs() < 0.035) & (away[:, 1].abs() < 0.03) & (away[:, 2] > -0.13)
    behind = -vertices[:, 2] - front[y, x]
    return torch.where(near, (behind / 0.004).clamp(0, 1), torch.zeros(()))


def stripes(along: np.ndarray, period: float, footprint: np.ndarray) -> np.ndarray:
    """A smooth wave of mean 0.5, [N]; it fades as the period nears two samples."""
    contrast = _contrast(period, footprint)
    if not contrast.any():
        return contrast + np.float32(0.5)
    return 0.5 + 0.5 * contrast * np.sin(along * np.float32(2 * np.pi / period))


def dots(points: np.ndarray, period: float, footprint: np.ndarray) -> np.ndarray:
    """Balls on a lattice, cut by the surface: 1 inside, [N]."""
    cell = points / np.float32(period)
    cell = cell - np.round(cell)
    in_picture = (cell * cell).sum(1) < 0.36**2
    contrast = _contrast(0.7 * period, footprint)
    return in_picture * contrast + (1 - contrast) * 0.2


def noise(points: np.ndarray, period: float, footprint: np.ndarray, seed: int = 0) -> np.ndarray:
    """A smooth irregular pattern of mean 0 that seldom leaves [-1, 1], [N]; ``period`` in metres."""
    contrast = _contrast(period, footprint)
    if not contrast.any():
        return contrast
    rng = np.random.default_rng([seed, 4])
    waves = rng.normal(0, 1, (3, 5))
    waves *= 2 * np.pi / (period * rng.uniform(0.7, 1.4, 5)) / np.linalg.norm(waves, axis=0)
    phases = rng.uniform(0, 2 * np.pi, 5).astype(np.float32)
    return np.sin(points @ waves.astype(np.float32) + phases).mean(1) * (1.5 * contrast)


def _contrast(period: float, footprint: np.ndarray) -> np.ndarray:
    return np.clip(period / np.maximum(footprint, 1e-9) / 2 - 1, 0, 1).astype(np.float32)


def _fill(colors: np.ndarray, where: np.ndarray, color: np.ndarray) -> None:
    colors[where] = color
