"""Temporal smoothing of fitted poses: Savitzky-Golay for frames that need not be evenly spaced.

Around every frame a polynomial in time is fitted to its neighbours by least squares, and the frame takes
its value there (Savitzky and Golay, 1964). Where frames follow one another evenly this is the classical
filter, its ends included: there the window stays inside the clip, and the polynomial is read off its
centre. Where frames were dropped the polynomial is fitted to those that are left, at their true times.

Rotations are filtered as unit quaternions, component by component, and normalised afterwards.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import roma
import torch
from torch import Tensor

from pipeline.body import Poses
from pipeline.clip.clock import RATE, usual_step


def window_of(seconds: float, times: np.ndarray) -> int:
    """The odd number of a clip's usual frames that is nearest to some seconds; 0 for fewer than two.

    Args:
        seconds: the window's length.
        times: [T], of the frames, in the units of :mod:`pipeline.clip.clock`.
    """
    half = math.ceil((seconds * RATE / usual_step(times) - 1) / 2 - 0.5 - 1e-6)
    return 2 * half + 1 if half > 0 else 0


def smooth(poses: Poses, window: int, order: int = 2, times: np.ndarray | None = None) -> Poses:
    """The poses with rotation, expression and translation smoothed over time.

    Only frames that were measured (``poses.valid``) are fitted to. Between them the others take the
    polynomial's value; where there is no measured frame near, in gaps longer than half a window and
    beyond the first and the last, they move along with the nearest that are.

    A turn at constant speed comes out as it is, except where the window lies to one side, at the clip's
    ends and beside long gaps: there by 0.011 a^3 at most, a being the angle turned in half a window. That
    is 1e-4 rad at 0.05 rad a frame and window 9.

    Args:
        poses: T frames.
        window: how many frames the polynomial sees, odd; 0 leaves the poses as they are.
        order: the polynomial's degree.
        times: [T], of the frames, increasing, see :mod:`pipeline.clip.clock`; by default their numbers.

    Returns:
        Poses of the same frames. Rotation vectors are on the branch nearest to those given.

    Raises:
        ValueError: an even window, or one that does not exceed the order.
    """
    if window == 0:
        return poses
    if window % 2 == 0 or window <= order or order < 0:
        raise ValueError(f"a window of {window} frames is not odd, or not more than the order {order}")
    measured = poses.valid.cpu().numpy()
    if not measured.any():
        return poses
    times = np.array(poses.frames, np.float64) if times is None else times
    local = _Filter(times, measured, window, order)
    quaternions = _same_sign(roma.rotvec_to_unitquat(poses.rotation.double()), poses.valid)
    turned = roma.quat_normalize(local.applied(quaternions))
    return dataclasses.replace(
        poses,
        rotation=nearest_branch(roma.unitquat_to_rotvec(turned).to(poses.rotation), poses.rotation),
        expression=local.applied(poses.expression),
        transl=local.applied(poses.transl),
    )


def nearest_branch(rotation: Tensor, reference: Tensor) -> Tensor:
    """The same rotations with each vector as near to its reference as whole turns allow: [..., 3] twice.

    A rotation by an angle a about an axis is also one by a + 2 pi about it.
    """
    length = rotation.norm(dim=-1, keepdim=True)
    along = torch.where(length > 1e-6, rotation, reference)  # no rotation has no axis: any will do
    axis = along / along.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    turns = torch.round(((reference * axis).sum(-1, keepdim=True) - length) / (2 * math.pi))
    return torch.where(turns != 0, rotation + 2 * math.pi * turns * axis, rotation)


class _Filter:
    """Local polynomials at the frames of a clip, as weights on the frames around each.

    A run is a stretch of measured frames without a gap longer than half a window. Every frame within
    a run has a window of its own there.
    """

    def __init__(self, times: np.ndarray, measured: np.ndarray, window: int, order: int) -> None:
        """Prepare the weights.

        Args:
            times: [T], increasing.
            measured: [T] bool, at least one of them.
            order: the polynomials' degree.
        """
        self.rows = np.flatnonzero(measured)
        known = times[self.rows]
        # Half a window; a clip of which every other frame was kept is seen as evenly spaced.
        reach = (window // 2) * usual_step(known) if len(known) > 1 else 1.0
        first, last = _runs(known, reach)
        before = np.searchsorted(known, times, side="right") - 1
        after = np.searchsorted(known, times, side="left")
        inside = (before >= 0) & (after < len(known))
        inside &= first[before] == first[np.minimum(after, len(known) - 1)]
        self.inside = np.flatnonzero(inside)
        run = before[self.inside]
        start, end = known[first[run]], known[last[run]]
        now = times[self.inside]
        centre = np.clip(now, start + reach, np.maximum(end - reach, start + reach))
        slack = 1e-6 * reach
        begin = np.maximum(np.searchsorted(known, centre - reach - slack), first[run])
        stop = np.minimum(np.searchsorted(known, centre + reach + slack), last[run] + 1)
        places = begin[:, None] + np.arange((stop - begin).max())
        self.places = np.minimum(places, len(known) - 1)  # [I, K], into ``rows``
        there = places < stop[:, None]
        self.weights = _weights((known[self.places] - now[:, None]) / reach, there, order)
        self.times = times

    def applied(self, values: Tensor) -> Tensor:
        """The smoothed values: [T, ...] -> [T, ...], of the same dtype; computed in float64."""
        raw = values.detach().cpu().double().reshape(len(values), -1).numpy()
        known = raw[self.rows]
        fitted = np.zeros((len(self.inside), raw.shape[1]))
        for place, weight in zip(self.places.T, self.weights.T, strict=True):  # T x K values need no memory
            fitted += weight[:, None] * known[place]
        change = fitted - raw[self.inside]
        smoothed = raw + self._spread(change)
        smoothed[self.inside] = fitted
        return torch.from_numpy(smoothed).reshape(values.shape).to(values)

    def _spread(self, change: np.ndarray) -> np.ndarray:
        """The change of every frame from that of the frames inside runs: [I, D] -> [T, D]."""
        right = np.clip(np.searchsorted(self.inside, np.arange(len(self.times))), 0, len(self.inside) - 1)
        left = np.maximum(right - 1, 0)
        low, high = self.times[self.inside[left]], self.times[self.inside[right]]
        share = np.clip((self.times - low) / np.where(high > low, high - low, 1.0), 0, 1)[:, None]
        return (1 - share) * change[left] + share * change[right]


def _runs(times: np.ndarray, longest: float) -> tuple[np.ndarray, np.ndarray]:
    """For each of [N] increasing times, the first and the last index of its run: [N] twice."""
    breaks = np.flatnonzero(np.diff(times) > longest * (1 + 1e-6)) + 1
    starts, ends = np.r_[0, breaks], np.r_[breaks, len(times)] - 1
    counts = ends - starts + 1
    return np.repeat(starts, counts), np.repeat(ends, counts)


def _weights(offsets: np.ndarray, there: np.ndarray, order: int) -> np.ndarray:
    """The share of each neighbour in a least-squares polynomial's value at offset 0.

    Args:
        offsets: [I, K], times relative to where the polynomial is read off.
        there: [I, K] bool, which neighbours there are.
        order: the degree; lower where there are too few neighbours.

    Returns:
        [I, K], rows sum to 1.
    """
    powers = np.arange(order + 1)
    used = there[:, :, None] & (powers < there.sum(1)[:, None, None])
    design = np.where(used, offsets[:, :, None] ** powers, 0.0)
    return np.linalg.pinv(design)[:, 0]


def _same_sign(quaternions: Tensor, valid: Tensor) -> Tensor:
    """Unit quaternions with signs chosen so that they do not jump: [T, J, 4] -> [T, J, 4].

    The measured frames follow one another; any other frame follows the measured one before it.
    """
    rows = torch.nonzero(valid)[:, 0]
    known = quaternions[rows]
    flips = torch.where((known[1:] * known[:-1]).sum(-1) < 0, -1.0, 1.0).to(known)
    signs = torch.cat([torch.ones_like(known[:1, :, 0]), flips]).cumprod(0)
    known = known * signs[..., None]
    leader = known[(valid.long().cumsum(0) - 1).clamp_min(0)]
    return torch.where((quaternions * leader).sum(-1, keepdim=True) < 0, -quaternions, quaternions)
