"""The keypoints detected in each frame, and their table.

``keypoints.parquet`` has one row a kept frame, sorted by frame number:

============  =====================  =============================================================
column        type                   meaning
============  =====================  =============================================================
frame         int32                  the frame's number in the source clip
keypoints     float32 [133 x 3]      x, y, score; COCO-WholeBody order
face_mesh     float32 [478 x 4]      x, y, z, score; MediaPipe's face mesh with irises
pose_image    float32 [33 x 4]       x, y, z, visibility; MediaPipe's pose
pose_world    float32 [33 x 4]       the same points in metres about the hips, and visibility
hands         float32 [2 x 21 x 4]   x, y, z, score; left hand, then right hand
============  =====================  =============================================================

Image coordinates are pixels of the stored frame, the centre of the first pixel being (0.5, 0.5); z is
in the same pixels, relative, smaller nearer to the camera. World coordinates: x to the image's right,
y down, z away from the camera. Left and right are the subject's own. A point that was not found is
all zero, and a score of 0 means that nothing is known of the point. Scores lie in [0, 1].
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa

from pipeline.errors import UserError
from pipeline.files.tables import read_table, vectors, write_table

BODY = slice(0, 17)
FEET = slice(17, 23)
FACE = slice(23, 91)
LEFT_HAND = slice(91, 112)
RIGHT_HAND = slice(112, 133)
COUNT = 133

_BODY_NAMES = (
    "nose", "left_eye", "right_eye", "left_ear", "right_ear", "left_shoulder", "right_shoulder",
    "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_hip", "right_hip", "left_knee",
    "right_knee", "left_ankle", "right_ankle",
)  # fmt: skip
_FEET_NAMES = (
    "left_big_toe", "left_small_toe", "left_heel", "right_big_toe", "right_small_toe", "right_heel",
)  # fmt: skip
_HAND_NAMES = ("root",) + tuple(
    f"{finger}{joint}" for finger in ("thumb", "forefinger", "middle_finger", "ring_finger", "pinky_finger")
    for joint in (1, 2, 3, 4)
)  # fmt: skip

#: The 133 COCO-WholeBody names. ``face_0`` to ``face_67`` are the 68 iBUG points in their own order.
NAMES: tuple[str, ...] = (
    _BODY_NAMES
    + _FEET_NAMES
    + tuple(f"face_{point}" for point in range(68))
    + tuple(f"{side}_hand_{point}" for side in ("left", "right") for point in _HAND_NAMES)
)

#: The vertex of MediaPipe's face mesh that lies nearest to each of the 68 iBUG points. The table is
#: symmetric: exchanging left and right exchanges mirrored vertices.
FACE_MESH_TO_IBUG68: tuple[int, ...] = (
    127, 234, 93, 58, 172, 136, 150, 176, 152, 400, 379, 365, 397, 288, 323, 454, 356,  # contour
    70, 63, 105, 66, 107, 336, 296, 334, 293, 300,  # brows: right, left
    168, 197, 5, 4, 75, 97, 2, 326, 305,  # nose: bridge, underside
    33, 160, 158, 133, 153, 144, 362, 385, 387, 263, 373, 380,  # eyes: right, left
    61, 39, 37, 0, 267, 269, 291, 321, 314, 17, 84, 91,  # outer lip
    78, 82, 13, 312, 308, 317, 14, 87,  # inner lip
)  # fmt: skip

#: The centres of the irises in the face mesh.
FACE_MESH_LEFT_IRIS, FACE_MESH_RIGHT_IRIS = 473, 468

_SHAPES = {
    "keypoints": (COUNT, 3),
    "face_mesh": (478, 4),
    "pose_image": (33, 4),
    "pose_world": (33, 4),
    "hands": (2, 21, 4),
}
SCHEMA = pa.schema(
    [pa.field("frame", pa.int32())]
    + [pa.field(name, vectors(int(np.prod(shape)))) for name, shape in _SHAPES.items()]
)
_REMEDY = "run the ingest stage again"


@dataclasses.dataclass(frozen=True)
class Keypoints:
    """The detections of a clip, T kept frames, float32. See the module's docstring for the units.

    Attributes:
        frames: [T], int64, increasing frame numbers of the source clip.
        whole_body: [T, 133, 3], x, y, score.
        face_mesh: [T, 478, 4], x, y, z, score.
        pose_image: [T, 33, 4], x, y, z, visibility.
        pose_world: [T, 33, 4], metres, and visibility.
        hands: [T, 2, 21, 4], left then right; x, y, z, score.
    """

    frames: np.ndarray
    whole_body: np.ndarray
    face_mesh: np.ndarray
    pose_image: np.ndarray
    pose_world: np.ndarray
    hands: np.ndarray

    def __post_init__(self) -> None:
        """Check that shapes agree; ValueError otherwise."""
        count = len(self.frames)
        for column, shape in _SHAPES.items():
            found = self._array(column).shape
            if found != (count, *shape):
                raise ValueError(f"{column} is {found}, not {(count, *shape)}")

    def _array(self, column: str) -> np.ndarray:
        return getattr(self, "whole_body" if column == "keypoints" else column)

    def select(self, rows: np.ndarray) -> Keypoints:
        """The keypoints of some rows, [N] int."""
        return Keypoints(*(getattr(self, field.name)[rows] for field in dataclasses.fields(self)))

    @staticmethod
    def concatenate(parts: Sequence[Keypoints]) -> Keypoints:
        """The keypoints of clips whose frame numbers follow one another."""
        names = [field.name for field in dataclasses.fields(Keypoints)]
        return Keypoints(*(np.concatenate([getattr(one, name) for one in parts]) for name in names))

    def index(self, frame: int) -> int:
        """The row of a frame number; KeyError if the frame was not kept."""
        row = int(np.searchsorted(self.frames, frame))
        if row == len(self.frames) or self.frames[row] != frame:
            raise KeyError(frame)
        return row


def empty_keypoints(frames: np.ndarray) -> Keypoints:
    """Keypoints for ``frames`` [T] in which nothing was found: all zero."""
    arrays = {name: np.zeros((len(frames), *shape), np.float32) for name, shape in _SHAPES.items()}
    return Keypoints(np.asarray(frames, np.int64), arrays.pop("keypoints"), **arrays)


def write_keypoints(path: Path, keypoints: Keypoints) -> None:
    """Write ``keypoints.parquet``; ValueError when frames do not increase or a number is not finite."""
    if (np.diff(keypoints.frames) <= 0).any():
        raise ValueError("frame numbers must increase")
    columns = {name: np.asarray(keypoints._array(name), np.float32) for name in _SHAPES}
    write_table(path, SCHEMA, {"frame": keypoints.frames.astype(np.int32), **columns})


def read_keypoints(path: Path) -> Keypoints:
    """Read ``keypoints.parquet``.

    Raises:
        UserError: the file is missing or malformed, a number is not finite, frame numbers do not
            increase, or a score is outside [0, 1].
    """
    columns = read_table(path, SCHEMA, _REMEDY)
    frames = columns.pop("frame").astype(np.int64)
    if (np.diff(frames) <= 0).any() or (frames < 0).any():
        raise UserError(f"{path}: its frame numbers do not increase: {_REMEDY}")
    arrays = {name: columns[name].reshape(len(frames), *shape) for name, shape in _SHAPES.items()}
    for name, array in arrays.items():
        if array.size and (array[..., -1].min() < 0 or array[..., -1].max() > 1):
            raise UserError(f"{path}: column {name!r} has scores outside [0, 1]: {_REMEDY}")
    return Keypoints(frames, arrays.pop("keypoints"), **arrays)
