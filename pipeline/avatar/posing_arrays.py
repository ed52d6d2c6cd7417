"""The arrays that posing in one pass reads and writes, in the groups in which its kernels take them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Still(NamedTuple):
    """The arrays of a posing that no frame changes; N points, float32 where nothing else is said.

    Attributes:
        points: [N, 3] at rest, metres.
        initial: [N, 3], standard deviations that a log scale of 0 stands for, metres.
        movable: [N], metres that a pose-dependent offset of 1 stands for.
        joints, weights: [N, J], as ``joints_of_points`` gives them.
        frames: [N, 3, 3], the Gaussians' axes at rest.
        places: [N] int32, the row of ``Frame.moved`` that moves the point; -1 for none.
        limits: [3], least and greatest log scale, and the largest scale, metres.
    """

    points: np.ndarray
    initial: np.ndarray
    movable: np.ndarray
    joints: np.ndarray
    weights: np.ndarray
    frames: np.ndarray
    places: np.ndarray
    limits: np.ndarray


class Learnt(NamedTuple):
    """The arrays that are learnt, float32.

    Attributes:
        offset: [N, 3], metres; [0, 3] for none.
        log_scale, color_logit: [N, 3].
        bases: [M, 6 K].
        rows: [N] int64, the row of ``bases`` that is the point's; [0] where it is the point's own number.
    """

    offset: np.ndarray
    log_scale: np.ndarray
    color_logit: np.ndarray
    bases: np.ndarray
    rows: np.ndarray


class Frame(NamedTuple):
    """The arrays of one frame, float32.

    Attributes:
        signal: [K].
        transforms: [55, 12], each joint's [3, 4] matrix row by row.
        transl: [3], metres.
        moved: [P, 3], how far the expression moves points, metres.
    """

    signal: np.ndarray
    transforms: np.ndarray
    transl: np.ndarray
    moved: np.ndarray


class Pushed(NamedTuple):
    """The loss's gradients of what ``pose_forward`` gave, [N, 3] float32; [0, 3] for none."""

    means: np.ndarray
    scales: np.ndarray
    colors: np.ndarray
    color_logit: np.ndarray
    moves: np.ndarray
