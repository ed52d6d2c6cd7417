"""What is known by heart about the estimators' point sets, and a few points picked by hand."""

from __future__ import annotations

import numpy as np

# The iBUG 68 face points as indices into MediaPipe's face mesh, in the correspondence that is in
# common use: contour from the subject's right, brows, nose ridge and base, eyes, outer and inner lips.
IBUG_OF_FACE_MESH: tuple[int, ...] = (
    162, 234, 93, 58, 172, 136, 149, 148, 152, 377, 378, 365, 397, 288, 323, 454, 389,
    71, 63, 105, 66, 107, 336, 296, 334, 293, 301,
    168, 197, 5, 4, 75, 97, 2, 326, 305,
    33, 160, 158, 133, 153, 144, 362, 385, 387, 263, 373, 380,
    61, 39, 37, 0, 267, 269, 291, 405, 314, 17, 84, 181,
    78, 82, 13, 312, 308, 317, 14, 87,
)  # fmt: skip
CONTOUR = 17  # the first 17 have no fixed place on the body in SMPL-X files: ``lmk_*`` holds the other 51

# Points of the face mesh on the upper and on the lower lip. The lips touch, so the nearest surface of
# one is often the other's: each set may only be matched with its own.
UPPER_LIP: tuple[int, ...] = (
    78, 191, 80, 81, 82, 13, 312, 311, 310, 415, 308, 61, 185, 40, 39, 37, 0, 267, 269, 270, 409, 291,
    73, 74, 72, 11, 302, 303, 304, 38, 41, 42, 12, 268, 271, 272, 184, 183, 408, 407, 62, 292, 76, 306,
)  # fmt: skip
LOWER_LIP: tuple[int, ...] = (
    95, 88, 178, 87, 14, 317, 402, 318, 324, 146, 91, 181, 84, 17, 314, 405, 321, 375, 77, 90, 180, 85,
    16, 315, 404, 320, 307, 96, 89, 179, 86, 15, 316, 403, 319, 325,
)  # fmt: skip

# On the open body, looked up in a frontal view of its mean face: millimetres to the subject's right
# and up from the point between the eyes' centres, for the face-mesh points of the right half; the
# surface gives the third coordinate, and the left half is the mirror image.
PICKED: dict[int, tuple[float, float]] = {
    33: (43.8, -2.3), 133: (18.0, -4.1), 159: (31.5, 2.2), 145: (31.5, -5.6),
    61: (23.7, -71.6), 78: (21.6, -71.3), 13: (0.0, -70.4), 14: (0.0, -71.3), 0: (0.0, -61.1),
    17: (0.0, -83.9), 2: (0.0, -53.0), 4: (0.0, -39.5), 129: (17.7, -42.5), 152: (0.0, -112.7),
    168: (0.0, 1.3),
}  # fmt: skip

IRIS_RADIUS = 0.0059  # metres; the iris is 11.7 mm wide in nearly everybody
IRIS_CENTRES = {468: "right_eye", 473: "left_eye"}
IRIS_DIRECTIONS = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])  # of the four after each: +X, up, ...


def mirror_of(points: np.ndarray) -> np.ndarray:
    """For each of a symmetric set of points [K, 3], the index of its mirror image in X: [K]."""
    distances = np.linalg.norm(points[:, None] - points[None] * [-1, 1, 1], axis=2)
    return distances.argmin(1)
