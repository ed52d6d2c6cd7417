"""The cameras' way through the world: an upright world of their own, and gaps between known frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import roma
import torch

Extrinsics = tuple[np.ndarray, np.ndarray]
"""Rotation [3, 3] and translation [3], world-to-camera, OpenCV axes."""

FACING = np.diag([1.0, -1.0, -1.0])  # facing_camera's rotation


def to_upright_world(rotations: np.ndarray, translations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World-to-camera poses in a world whose Y axis is the cameras' mean up axis, in the unit that they had.

    The first camera stands at the origin and looks towards -Z, so a camera that stands still gets exactly
    :func:`pipeline.clip.camera.facing_camera`.

    Args:
        rotations: [T, 3, 3] float64.
        translations: [T, 3].
    """
    if np.abs(rotations - rotations[0]).max() < 1e-9:
        old_to_new = FACING @ rotations[0]
    else:
        up = _unit(-rotations[:, 1].mean(0))  # nobody holds a camera askew for a whole clip
        ahead = rotations[0, 2]
        ahead = ahead - (ahead @ up) * up
        if np.linalg.norm(ahead) < 1e-6:  # the first camera looks straight up or down
            ahead = np.cross(up, rotations[0, 0])
        back = -_unit(ahead)
        old_to_new = np.stack([np.cross(up, back), up, back])
    origin = -rotations[0].T @ translations[0]
    return rotations @ old_to_new.T, translations + rotations @ origin


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def interpolate_gaps(
    known: Mapping[int, Extrinsics], frames: Sequence[int], longest: int
) -> dict[int, Extrinsics]:
    """The known poses, and those between two of them: rotations by slerp, the camera's centre linearly.

    Args:
        known: frame number -> pose.
        frames: the frames that need one, increasing; those that can get none are missing in the result.
        longest: how far apart two known frames may be, in frames, for what lies between to be filled.
    """
    order = np.array(sorted(known))
    poses = {}
    for frame in frames:
        after = int(np.searchsorted(order, frame))
        if frame in known:
            poses[frame] = known[frame]
        elif 0 < after < len(order) and order[after] - order[after - 1] <= longest:
            start, end = int(order[after - 1]), int(order[after])
            poses[frame] = _between(known[start], known[end], (frame - start) / (end - start))
    return poses


def _between(first: Extrinsics, second: Extrinsics, share: float) -> Extrinsics:
    turns = roma.rotmat_to_unitquat(torch.from_numpy(np.stack([first[0], second[0]])))
    at = torch.tensor([share], dtype=turns.dtype)
    turn = roma.unitquat_slerp(turns[0], turns[1], at, shortest_arc=True)
    rotation = roma.unitquat_to_rotmat(turn[0]).numpy()
    centres = [-pose[0].T @ pose[1] for pose in (first, second)]
    return rotation, -rotation @ ((1 - share) * centres[0] + share * centres[1])
