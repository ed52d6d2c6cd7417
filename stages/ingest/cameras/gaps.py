"""Cameras of frames between frames whose cameras are known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import roma
import torch

Extrinsics = tuple[np.ndarray, np.ndarray]  # rotation [3, 3] and translation [3], world-to-camera


def fill_gaps(known: Mapping[int, Extrinsics], frames: Sequence[int], longest: int) -> dict[int, Extrinsics]:
    """The known poses, and those between two of them: the turn by slerp, the camera's centre linearly.

    Args:
        known: frame number -> pose.
        frames: the frames that need one, increasing.
        longest: how far apart two known frames may be, in frames, for what lies between to be filled.

    Returns:
        Poses of the frames that are known or could be filled.
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
    turn = roma.unitquat_slerp(
        turns[0], turns[1], torch.tensor([share], dtype=turns.dtype), shortest_arc=True
    )
    rotation = roma.unitquat_to_rotmat(turn[0]).numpy()
    centres = [-pose[0].T @ pose[1] for pose in (first, second)]
    return rotation, -rotation @ ((1 - share) * centres[0] + share * centres[1])
