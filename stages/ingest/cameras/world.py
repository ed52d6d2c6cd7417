"""The world that cameras without one are put into.

Y points along the cameras' mean up axis (nobody holds a camera askew for a whole clip), the first camera
stands at the origin and looks towards -Z: a clip whose camera stands still gets exactly
:func:`pipeline.clip.camera.facing_camera`.
"""

from __future__ import annotations

import numpy as np

FACING = np.diag([1.0, -1.0, -1.0])  # facing_camera's rotation


def settle(rotations: np.ndarray, translations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World-to-camera poses in the world described above, in the unit that they had.

    Args:
        rotations: [T, 3, 3] float64.
        translations: [T, 3].
    """
    if np.abs(rotations - rotations[0]).max() < 1e-9:
        old_to_new = FACING @ rotations[0]
    else:
        up = _unit(-rotations[:, 1].mean(0))
        ahead = rotations[0, 2]
        ahead = ahead - (ahead @ up) * up
        if np.linalg.norm(ahead) < 1e-6:  # the first camera looks straight up or down
            ahead = np.cross(up, rotations[0, 0])
        back = -_unit(ahead)
        old_to_new = np.stack([np.cross(up, back), up, back])
    origin = -rotations[0].T @ translations[0]
    settled = rotations @ old_to_new.T
    return settled, translations + rotations @ origin


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
