"""The mannequin's hair and clothes: their outlines, and their distance from the skin.

Everything is a function of a place on the template in T pose, in which no two parts of the body touch.
So the same clothes fit any body of the schema, and their seams and patterns do not depend on the mesh.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from torch import Tensor

from pipeline.body import BodyModel, joint_index, vertex_normals

HAIR, SHIRT, TROUSERS = 0.022, 0.006, 0.008
"""How far they stand off the skin at most, metres."""

SHIRTS = ("plaid", "stripes", "dots")
SHOE_TOP = 0.035  # metres above the ankle
_SKIN = ((233, 190, 160), (205, 155, 120), (150, 104, 78), (104, 70, 52))
_HAIR = ((52, 36, 26), (24, 20, 20), (122, 82, 44), (168, 132, 80), (96, 92, 90))
_CLOTH = ((176, 46, 48), (38, 96, 128), (52, 112, 74), (196, 150, 48), (108, 62, 124))
_TRIM = ((238, 232, 218), (34, 40, 60), (226, 210, 150))
_LEATHER = ((60, 40, 34), (46, 46, 50), (150, 60, 50))
_IRIS = ((70, 110, 140), (90, 62, 36), (76, 110, 70))
_DENIM = ((62, 82, 120), (72, 70, 66), (128, 112, 88))


@dataclasses.dataclass(frozen=True)
class Measures:
    """Places on the template that clothes are cut by, metres in the body's axes.

    Attributes:
        eye: [3], the subject's left eye's centre.
        eyeball: its radius.
        jaw, neck: [3].
        elbow, wrist: how far out they are.
        waist, crotch, ankle: heights.
    """

    eye: np.ndarray
    eyeball: float
    jaw: np.ndarray
    neck: np.ndarray
    elbow: float
    wrist: float
    waist: float
    crotch: float
    ankle: float


@dataclasses.dataclass(frozen=True)
class Style:
    """Colours (RGB, 0 to 255) and cuts.

    Attributes:
        skin, hair, cloth, trim, trousers, shoes, iris: colours; ``trim`` is the shirt's second one.
        shirt: one of ``SHIRTS``.
        sleeve: where the sleeves end, 0 at the shoulder, 1 at the elbow, 2 at the wrist.
        number: printed on the back.
    """

    skin: tuple[int, int, int]
    hair: tuple[int, int, int]
    cloth: tuple[int, int, int]
    trim: tuple[int, int, int]
    trousers: tuple[int, int, int]
    shoes: tuple[int, int, int]
    iris: tuple[int, int, int]
    shirt: str
    sleeve: float
    number: int


@dataclasses.dataclass(frozen=True)
class GarmentDepths:
    """The depth of points inside each garment, [N] each, metres, negative outside."""

    hair: np.ndarray
    shirt: np.ndarray
    trousers: np.ndarray
    shoes: np.ndarray
    belt: np.ndarray


def make_style(seed: int) -> Style:
    """The look of a person; equal seeds give equal looks."""
    rng = np.random.default_rng([seed, 3])

    def pick(options):
        return options[int(rng.integers(len(options)))]

    return Style(
        skin=pick(_SKIN), hair=pick(_HAIR), cloth=pick(_CLOTH), trim=pick(_TRIM), trousers=pick(_DENIM),
        shoes=pick(_LEATHER), iris=pick(_IRIS), shirt=pick(SHIRTS), sleeve=pick((0.75, 1.85)),
        number=int(rng.integers(10, 100)),
    )  # fmt: skip


def measure(body: BodyModel) -> Measures:
    """The measures of a body's template."""
    joints = (body.joint_regressor @ body.v_template).double().numpy()

    def joint(name: str) -> np.ndarray:
        return joints[joint_index(name)]

    balls = (body.skinning_weights[:, joint_index("left_eye")] > 0.5).numpy()
    radius = np.linalg.norm(body.v_template.numpy()[balls] - joint("left_eye"), axis=1)
    return Measures(
        eye=joint("left_eye"),
        eyeball=float(np.median(radius)),
        jaw=joint("jaw"),
        neck=joint("neck"),
        elbow=float(joint("left_elbow")[0]),
        wrist=float(joint("left_wrist")[0]),
        waist=float(joint("spine1")[1]) + 0.01,
        crotch=float(joint("left_hip")[1]) - 0.08,
        ankle=float(joint("left_ankle")[1]),
    )


def garments(points: np.ndarray, measures: Measures, style: Style) -> GarmentDepths:
    """The depth of the template's points [N, 3] inside each garment."""
    x, y, z = np.abs(points[:, 0]), points[:, 1], points[:, 2]
    m = measures
    above_eyes, behind_eyes = y - m.eye[1], m.eye[2] - z
    # From the forehead down to the nape, but behind and over the ears.
    hairline = (
        above_eyes
        - 0.073
        + 1.05 * behind_eyes
        + 0.002 * (np.sin(points[:, 0] * 700) + np.sin(points[:, 0] * 1130 + 1))
    )
    hair = np.minimum(hairline, np.maximum(above_eyes - 0.024, m.jaw[2] - 0.058 - z))
    if style.sleeve <= 1:
        sleeve = m.elbow * (0.4 + 0.6 * style.sleeve)
    else:
        sleeve = m.elbow + (m.wrist - m.elbow) * (style.sleeve - 1)
    collar = m.neck[1] + 0.005 - 0.55 * np.maximum(z - m.neck[2] - 0.01, 0)
    collar = np.where(x > 0.11, m.neck[1] + 0.2, collar)  # the shoulders are no neck
    shirt = np.minimum(np.minimum(sleeve - x, collar - y), y - m.waist)
    trousers = np.minimum(m.waist - y, y - m.ankle - SHOE_TOP)
    return GarmentDepths(hair, shirt, trousers, m.ankle + SHOE_TOP - y, 0.016 - np.abs(y - m.waist + 0.014))


def surface_offset(body: BodyModel, measures: Measures, style: Style) -> Tensor:
    """The offset of the template's vertices by hair and clothes: [V, 3] float32, metres."""
    fields = garments(body.v_template.double().numpy(), measures, style)
    height = (
        HAIR * _rise(fields.hair, 0.03)
        + SHIRT * _rise(fields.shirt, 0.03)
        + TROUSERS * _rise(fields.trousers, 0.04)
    )
    return vertex_normals(body.v_template, body.faces) * torch.from_numpy(height).float()[:, None]


def _rise(field: np.ndarray, over: float) -> np.ndarray:
    t = np.clip(field / over, 0, 1)
    return t * t * (3 - 2 * t)
