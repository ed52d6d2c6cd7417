"""The painted face and prints: small pictures laid onto the template from the front or from the back."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np

from pipeline.body import BodyModel, Landmarks, locate
from pipeline.clip.keypoints import FACE
from stages.ingest.mannequin.attire import Measures, Style

_LEVELS = 6
_FACE_PIXEL, _PRINT_PIXEL = 0.0004, 0.0006  # metres
_SHIFT = 4  # cv2's sub-pixel bits


@dataclasses.dataclass(frozen=True)
class Decal:
    """A picture that is projected along Z onto the template.

    Attributes:
        levels: [H, W, 4] float32 each, RGB times alpha (0 to 255) and alpha (0 to 1); each half the size
            of the one before.
        left, top: the picture's edges in the template's x and y, metres.
        pixel: metres a pixel of the first level; negative mirrors x, as seen from behind.
    """

    levels: tuple[np.ndarray, ...]
    left: float
    top: float
    pixel: float

    def lay(self, colors: np.ndarray, points: np.ndarray, where: np.ndarray, footprint: float) -> None:
        """Paint it over colours, in place.

        Args:
            colors: [N, 3] float32.
            points: [N, 3], places on the template.
            where: [N] bool, the points that it may be laid on.
            footprint: metres that a sample of the picture to be made covers; picks the level.
        """
        rows = np.flatnonzero(where)
        if not len(rows):
            return
        level = int(np.clip(np.log2(max(footprint / abs(self.pixel), 1)), 0, len(self.levels) - 1))
        step = self.pixel * 2**level
        x = (points[rows, 0] - self.left) / step - 0.5
        y = (self.top - points[rows, 1]) / abs(step) - 0.5
        paint = _sample(self.levels[level], x, y)
        colors[rows] = colors[rows] * (1 - paint[:, 3:]) + paint[:, :3]


def paint_face(body: BodyModel, landmarks: Landmarks, measures: Measures, style: Style) -> Decal:
    """Lips, brows, lashes, nostrils and cheeks, where the body's own landmarks have them."""
    joints = body.joint_regressor @ body.v_template
    marks = locate(landmarks.whole_body[FACE], joints, body.v_template).double().numpy()  # iBUG's 68
    left, top = -0.1, float(measures.eye[1]) + 0.1
    canvas = _Canvas(left, top, 0.2, 0.24, _FACE_PIXEL)
    skin, hair = np.array(style.skin, float), np.array(style.hair, float)
    for side in (-1, 1):
        cheek = marks[30] + [side * 0.043, -0.012, 0]
        canvas.blob(cheek, 0.02, skin * [1.0, 0.72, 0.68], 0.5)
    for brow in (marks[17:22], marks[22:27]):
        canvas.line(brow, 0.0055, hair * 0.9 + 6, 0.9)
    for eye in (marks[36:42], marks[42:48]):
        canvas.line(eye, 0.0022, np.array([40, 26, 24]), 0.85, closed=True)
        canvas.line(eye[:4] + [0, 0.004, 0], 0.0015, skin * 0.6, 0.6)
    lips = skin * [0.82, 0.48, 0.48] + [12, 0, 4]
    canvas.area(marks[48:60], lips, 0.75)
    canvas.line(marks[60:68], 0.0012, lips * 0.45, 0.9, closed=True)
    for side in (32, 34):
        canvas.blob(marks[side] + [0, 0.001, 0], 0.003, skin * 0.3, 0.9)
    canvas.line(marks[27:31], 0.006, np.minimum(skin * 1.12, 255), 0.25)
    return canvas.decal()


def paint_print(measures: Measures, style: Style) -> tuple[Decal, Decal]:
    """A badge on the left of the chest and a number on the back."""
    chest = _Canvas(0.03, measures.neck[1] - 0.1, 0.08, 0.08, _PRINT_PIXEL)
    height, width = chest.shape
    middle = (width // 2, height // 2)
    trim, dark = tuple(float(c) for c in style.trim), (30.0, 30.0, 36.0)
    for radius, color in ((0.46, dark), (0.40, trim), (0.30, dark)):
        chest.stamp(lambda p, r=radius: cv2.circle(p, middle, int(width * r), 255, -1, cv2.LINE_AA), color)
    chest.stamp(lambda p: _text(p, "F", 0.022, _PRINT_PIXEL), trim)
    # From behind, x runs the other way.
    back = _Canvas(0.12, measures.neck[1] - 0.12, 0.24, 0.16, _PRINT_PIXEL, mirrored=True)
    back.stamp(lambda p: _text(p, str(style.number), 0.11, _PRINT_PIXEL, 16), dark)
    back.stamp(lambda p: _text(p, str(style.number), 0.11, _PRINT_PIXEL, 7), trim)
    return chest.decal(), back.decal()


class _Canvas:
    """A transparent picture in the template's x and y that one paints on in metres."""

    def __init__(
        self, left: float, top: float, width: float, height: float, pixel: float, mirrored: bool = False
    ) -> None:
        self.left, self.top, self.pixel, self.mirrored = left, top, pixel, mirrored
        self.shape = (round(height / pixel), round(width / pixel))
        self.picture = np.zeros((*self.shape, 4), np.float32)

    def _pixels(self, points: np.ndarray) -> np.ndarray:
        """[N, 3] metres -> [N, 2] int32 in cv2's sub-pixels."""
        place = np.stack([points[:, 0] - self.left, self.top - points[:, 1]], axis=1) / self.pixel - 0.5
        return np.round(place * 2**_SHIFT).astype(np.int32)

    def stamp(self, draw, color, opacity: float = 1.0, soft: float = 0.0) -> None:
        """Lay a colour over what is there where ``draw`` paints 255 into a [H, W] uint8 picture."""
        drawn = np.zeros(self.shape, np.uint8)
        draw(drawn)
        alpha = drawn.astype(np.float32) / 255
        if soft:
            alpha = np.asarray(cv2.GaussianBlur(alpha, (0, 0), soft / self.pixel))
        self.cover(alpha * opacity, color)

    def cover(self, alpha: np.ndarray, color) -> None:
        """Lay a colour over what is there, by an alpha [H, W]."""
        alpha = alpha[..., None].astype(np.float32)
        paint = np.concatenate([np.asarray(color, np.float32), np.ones(1, np.float32)])
        self.picture = self.picture * (1 - alpha) + paint * alpha

    def line(self, points: np.ndarray, width: float, color, opacity: float, closed: bool = False) -> None:
        thick = max(1, round(width / self.pixel))
        curve = self._pixels(points)[:, None]
        self.stamp(
            lambda p: cv2.polylines(p, [curve], closed, 255, thick, cv2.LINE_AA, _SHIFT),
            color,
            opacity,
            0.0006,
        )

    def area(self, points: np.ndarray, color, opacity: float) -> None:
        outline = self._pixels(points)[:, None]
        self.stamp(lambda p: cv2.fillPoly(p, [outline], 255, cv2.LINE_AA, _SHIFT), color, opacity, 0.0006)

    def blob(self, centre: np.ndarray, radius: float, color, opacity: float) -> None:
        rows, columns = np.mgrid[: self.shape[0], : self.shape[1]] + 0.5
        x, y = self.left + columns * self.pixel - centre[0], self.top - rows * self.pixel - centre[1]
        self.cover(np.exp(-(x * x + y * y) / (radius * radius)) * opacity, color)

    def decal(self) -> Decal:
        """The finished picture."""
        levels: list[np.ndarray] = [self.picture]
        while len(levels) < _LEVELS:
            levels.append(cv2.pyrDown(levels[-1]))
        return Decal(tuple(levels), self.left, self.top, -self.pixel if self.mirrored else self.pixel)


def _text(picture: np.ndarray, text: str, height: float, pixel: float, thick: int = 5) -> None:
    """Write in the middle of a picture, ``height`` metres tall."""
    font = cv2.FONT_HERSHEY_SIMPLEX
    size = cv2.getFontScaleFromHeight(font, round(height / pixel), thick)
    (width, tall), _ = cv2.getTextSize(text, font, size, thick)
    place = ((picture.shape[1] - width) // 2, (picture.shape[0] + tall) // 2)
    cv2.putText(picture, text, place, font, size, 255, thick, cv2.LINE_AA)


def _sample(picture: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Bilinear samples at N pixels, transparent outside: [N, 4]."""
    # cv2.remap takes no side longer than 32767, so the list of points is folded.
    side = 256
    padded = -(-len(x) // side) * side
    columns, rows = (np.full(padded, -10, np.float32) for _ in range(2))
    columns[: len(x)], rows[: len(y)] = x, y
    found = cv2.remap(
        picture, columns.reshape(-1, side), rows.reshape(-1, side), cv2.INTER_LINEAR, borderValue=(0,) * 4
    )
    return found.reshape(-1, 4)[: len(x)]
