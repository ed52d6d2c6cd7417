"""One soft mask of the person from two segmentations.

The pose model's segmentation knows which body is meant and has limbs and feet, but is blurred; the
selfie segmentation is sharp about heads and shoulders, but takes in furniture and other people. How
far the two agree over the clip says how far the second can be trusted. What is known of a background
that stands still is then taken out, the edge is moved to the picture's edges, hands and feet that the
detector saw are completed where that is asked for (``mask_parts.py``), and the masks are averaged along
the motion: an avatar cannot score higher than the masks agree with one another.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from pipeline.clip.background import learn_background, log_odds, subtract_background
from pipeline.clip.frames import read_frame, read_mask, write_frame, write_mask
from pipeline.clip.keypoints import BODY, Keypoints
from stages.ingest.mask_edges import follow_edges
from stages.ingest.mask_parts import complete_parts
from stages.ingest.mask_smoothing import smooth_masks

if TYPE_CHECKING:
    from pipeline.run.stage import Context

TRUSTED = 0.5  # the selfie mask's share where it agrees with the pose mask
STRANGE, AGREEING = 0.78, 0.90  # median overlap of the two: share 0, full share
SHARPEN = 1.5  # contrast of the final mask about one half
SEED_SCORE = 0.5  # of a body point that surely lies on the person
HOLE = 0.004  # smaller ones, of the person's area, are a mistake; the gap under an arm is larger


def write_segmentations(folder: Path, index: int, body: np.ndarray, selfie: np.ndarray) -> None:
    """Keep a frame's two segmentations, each [H, W] in [0, 1], as the channels of one picture."""
    channels = np.stack([body, selfie, np.zeros_like(body)], axis=-1)
    write_frame(folder, index, np.round(np.clip(channels, 0, 1) * 255).astype(np.uint8))


def read_segmentations(folder: Path, index: int) -> tuple[np.ndarray, np.ndarray]:
    """The pose model's and the selfie segmentation that were kept of a frame, each [H, W] float32."""
    channels = read_frame(folder, index).astype(np.float32) / 255
    return channels[..., 0], channels[..., 1]


def refine_masks(context: Context, keypoints: Keypoints, raw: Path) -> None:
    """Write one mask of each kept frame, made of its two segmentations, to ``output/masks``.

    Args:
        context: the stage's.
        keypoints: of the kept frames; its points show which part of a mask is the person.
        raw: the folder that :func:`write_segmentations` filled.
    """
    settings, output = context.settings, context.output
    frames = keypoints.frames.tolist()
    share = selfie_share([overlap(*read_segmentations(raw, frame)) for frame in frames])
    context.log(f"masks: pose {1 - share:.2f}, selfie {share:.2f}")

    def fused() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for frame in frames:
            yield read_frame(output / "frames", frame), fuse(*read_segmentations(raw, frame), share)

    background = learn_background(fused()) if settings.background else None

    def cut() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for row, (image, alpha) in enumerate(fused()):
            if background is not None:
                alpha = subtract_background(alpha, image, background)
            points = keypoints.whole_body[row, BODY]
            seeds = points[points[:, 2] >= SEED_SCORE, :2]
            alpha = fill_holes(main_component(alpha, seeds))
            alpha = follow_edges(alpha, image, settings.mask_edge)
            if settings.mask_parts:
                alpha = complete_parts(alpha, image, keypoints.whole_body[row])
            yield image, alpha

    with context.progress(len(frames), "masks") as progress:
        for frame, alpha in zip(frames, smooth_masks(cut(), settings.mask_steadiness), strict=True):
            sharp = np.clip((alpha - 0.5) * SHARPEN + 0.5, 0, 1)
            write_mask(output / "masks", frame, np.round(sharp * 255).astype(np.uint8))
            progress.advance()


def publish_given_masks(context: Context, frames: Sequence[int], raw: Path) -> None:
    """Copy masks that came with the footage to ``output/masks`` as they are."""
    for frame in frames:
        write_mask(context.output / "masks", frame, read_mask(raw, frame))


def overlap(first: np.ndarray, second: np.ndarray) -> float:
    """Intersection over union of two masks cut at one half; 0 where both are empty."""
    union = int(((first > 0.5) | (second > 0.5)).sum())
    return int(((first > 0.5) & (second > 0.5)).sum()) / union if union else 0.0


def selfie_share(overlaps: Sequence[float]) -> float:
    """The selfie segmentation's share in the clip's masks, from its overlap with the pose model's."""
    return TRUSTED * float(np.clip((np.median(overlaps) - STRANGE) / (AGREEING - STRANGE), 0, 1))


def fuse(body: np.ndarray, selfie: np.ndarray, share: float) -> np.ndarray:
    """The weighted mean of the two segmentations' log-odds as a mask, [H, W] float32 in [0, 1].

    In log-odds the one that is sure outweighs the one that hesitates.
    """
    odds = (1 - share) * log_odds(body) + share * log_odds(selfie)
    return (1 / (1 + np.exp(-odds))).astype(np.float32)


def main_component(alpha: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """The mask without components that are not the person's, [H, W] float32.

    Args:
        alpha: [H, W] in [0, 1].
        seeds: [N, 2], points on the person, pixels. The component that holds most of them is kept, and all
            at least a tenth as large that hold one; without a seed the largest; without a component all.
    """
    count, labels, stats, _ = cv2.connectedComponentsWithStats((alpha > 0.5).astype(np.uint8), connectivity=8)
    if count <= 1:
        return alpha
    areas = stats[:, cv2.CC_STAT_AREA].astype(float)
    areas[0] = 0
    votes = np.zeros(count)
    if len(seeds):
        pixels = np.floor(seeds).astype(int)
        within = ((pixels >= 0) & (pixels < alpha.shape[::-1])).all(1)
        votes = np.bincount(labels[pixels[within, 1], pixels[within, 0]], minlength=count).astype(float)
        votes[0] = 0
    main = int(np.argmax(votes * areas)) if votes.any() else int(np.argmax(areas))
    keep = np.flatnonzero((votes > 0) & (areas >= 0.1 * areas[main]))
    solid = np.isin(labels, [main, *keep]).astype(np.uint8)
    soft = 2 * max(1, round(0.006 * max(alpha.shape))) + 1
    wide = cv2.dilate(solid, np.ones((soft, soft), np.uint8)).astype(np.float32)
    return (alpha * cv2.GaussianBlur(wide, (0, 0), soft / 4)).astype(np.float32)


def fill_holes(alpha: np.ndarray) -> np.ndarray:
    """The mask [H, W] in [0, 1] with small holes filled from what surrounds them."""
    solid = (alpha > 0.5).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(1 - solid, connectivity=4)
    small = stats[:, cv2.CC_STAT_AREA] < HOLE * solid.sum()
    edge = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    small[0] = False  # the person
    small[edge] = False
    if not small.any():
        return alpha
    reach = 2 * int(np.sqrt(stats[small, cv2.CC_STAT_AREA].max())) + 3
    closed = cv2.morphologyEx(alpha, cv2.MORPH_CLOSE, np.ones((reach, reach), np.uint8))
    return np.where(small[labels], np.maximum(alpha, closed), alpha)
