"""Masks smoothed over time along the optical flow."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import cv2
import numpy as np

AGREEMENT = 8.0  # grey levels; where pictures differ by more, their masks have little to say to each other


def smooth_masks(pairs: Iterable[tuple[np.ndarray, np.ndarray]], reach: int) -> Iterator[np.ndarray]:
    """Masks averaged with their neighbours in time, moved along the optical flow.

    Args:
        pairs: (image [H, W, 3] uint8, mask [H, W] in [0, 1]) of consecutive kept frames.
        reach: how many frames on either side take part; memory is 2 * reach + 1 frames.

    Yields:
        One mask a frame, [H, W] float32.
    """
    window: list[tuple[np.ndarray, np.ndarray]] = []
    done = 0  # frames at the window's start that have been given out
    for image, alpha in pairs:
        window.append((cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), alpha))
        if len(window) - done > reach:
            yield _average(window, done, reach)
            done += 1
        if done > reach:
            window.pop(0)
            done -= 1
    for row in range(done, len(window)):
        yield _average(window, row, reach)


def _average(window: list[tuple[np.ndarray, np.ndarray]], row: int, reach: int) -> np.ndarray:
    grey, alpha = window[row]
    total, weights = alpha.copy(), np.ones_like(alpha)
    for other in range(max(0, row - reach), min(len(window), row + reach + 1)):
        if other == row:
            continue
        moved, trust = _warp(grey, *window[other])
        weight = trust / (1 + abs(other - row))
        total += weight * moved
        weights += weight
    return total / weights


def _warp(grey: np.ndarray, other_grey: np.ndarray, other_alpha: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Another frame's mask warped to this one, and how well the pictures agree there, both [H, W]."""
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST).calc(grey, other_grey, None)  # type: ignore[call-overload]
    y, x = np.mgrid[0 : grey.shape[0], 0 : grey.shape[1]].astype(np.float32)
    where = (x + flow[..., 0], y + flow[..., 1])
    moved = cv2.remap(other_alpha, *where, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    seen = cv2.remap(other_grey, *where, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    difference = cv2.blur(cv2.absdiff(seen, grey).astype(np.float32), (5, 5))
    return moved, np.exp(-np.square(difference / AGREEMENT))
