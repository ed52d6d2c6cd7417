"""The ceiling that mask noise sets: the true frame against itself under a second mask.

An avatar is scored under one mask and cannot know it at its edges; two good masks of one frame differ
there. What the truth itself scores when a second mask cuts it out is what a perfect avatar could expect.

- ``independent``: U2-Net's, which had no part in the clip's masks, in the box of the person.
- ``edge``: the same mask, one pixel smaller: what a pixel of the outline is worth. Needs nothing, and knows
  nothing of where masks go wrong.
- ``estimator``: MediaPipe's own, frame by frame. It has two segmentations, of its pose model and of its
  selfie model, and the one that agrees better with the clip's masks is taken. The clip's masks are mostly
  made of these two (``stages/ingest/masks.py``), so that this is rather kind.
- a folder: anybody's, as grey pictures whose names are the frames' numbers.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from pipeline.clip.composite import composite_frame
from pipeline.clip.frame_files import frame_files
from pipeline.clip.frames import spread_end_to_end
from pipeline.detection.mediapipe import Estimator, estimator_scale, resize
from pipeline.detection.u2net import SaliencyModel
from pipeline.errors import UserError
from stages.evaluate.evaluated_clip import EvaluatedClip
from stages.evaluate.methods import CEILING, OnBackground
from stages.evaluate.settings import EvaluateSettings

if TYPE_CHECKING:
    from pipeline.run.stage import Context

PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
SHORT_SIDE, LONG_SIDE = 400, 1920  # pixels that the estimator is shown, as by ingest's defaults
MARGIN = 0.12  # of the person's extent, around it: what the independent model is shown
_SEGMENTATIONS = ("body_mask", "selfie_mask")
_NAMES = {"body_mask": "its pose model's segmentation", "selfie_mask": "its selfie segmentation"}


@dataclasses.dataclass(frozen=True)
class SecondMask:
    """The true frames, cut out by somebody else's masks.

    Attributes:
        clip: the clip.
        masks: frame -> [H, W] uint8, soft alpha.
        source: whose they are, in a few words.
        name: ``CEILING``.
    """

    clip: EvaluatedClip
    masks: Mapping[int, np.ndarray]
    source: str
    name: str = CEILING

    @property
    def frames(self) -> Collection[int]:
        """The frames that have a second mask."""
        return self.masks.keys()

    def render(self, frame: int) -> OnBackground:
        """The true frame under its second mask."""
        return partial(composite_frame, self.clip.true_colors(frame), self.masks[frame])


def no_second_mask(clip: EvaluatedClip) -> SecondMask:
    """A ceiling that is measured on no frame."""
    return SecondMask(clip, {}, "")


def second_mask(context: Context, clip: EvaluatedClip) -> SecondMask:
    """The second masks of the held-out frames, as the settings say.

    Raises:
        UserError: the folder lacks a mask, or has one of another size.
    """
    settings: EvaluateSettings = context.settings
    held_out = clip.split.test
    frames = spread_end_to_end(held_out, settings.second_mask_frames or len(held_out))
    if settings.second_mask == "off" or not frames:
        return no_second_mask(clip)
    if settings.second_mask == "edge":
        masks = {frame: edge(clip.mask(frame)) for frame in frames}
        return SecondMask(clip, masks, "the same, 1 px smaller")
    if settings.second_mask == "estimator":
        estimator = Estimator(context.assets["mediapipe"], context.work / "mediapipe.log", still=True)
        with context.progress(len(frames), "second masks") as progress:
            return estimated(estimator, clip, frames, progress.advance)
    if settings.second_mask == "independent":
        model = SaliencyModel(context.assets["u2netp"])
        with context.progress(len(frames), "second masks") as progress:
            return independent(model, clip, frames, progress.advance)
    folder = Path(settings.second_mask)
    files = frame_files(folder, PICTURES, clip.footage.all_frames, log=context.log)
    masks = {frame: read_given(folder, files.get(frame), clip, frame) for frame in frames}
    return SecondMask(clip, masks, folder.name)


def edge(mask: np.ndarray) -> np.ndarray:
    """A mask whose outline lies one pixel further in, [H, W] uint8; the picture's border does not erode."""
    return cv2.erode(mask, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=255)


def estimated(
    estimator: Estimator, clip: EvaluatedClip, frames: Sequence[int], advance: Callable[[], object]
) -> SecondMask:
    """MediaPipe's masks of some frames; a frame in which it sees nobody has none."""
    found: dict[str, dict[int, np.ndarray]] = {name: {} for name in _SEGMENTATIONS}
    for frame in frames:
        image = clip.frame(frame)
        height, width = image.shape[:2]
        estimate = estimator.estimate(resize(image, estimator_scale(width, height, SHORT_SIDE, LONG_SIDE)))
        for name in _SEGMENTATIONS if estimate is not None else ():
            alpha = cv2.resize(getattr(estimate, name), (width, height), interpolation=cv2.INTER_AREA)
            found[name][frame] = np.round(np.clip(alpha, 0, 1) * 255).astype(np.uint8)
        advance()
    agreement = {name: mean_overlap(clip, masks) for name, masks in found.items()}
    best = max(_SEGMENTATIONS, key=lambda name: agreement[name])
    if not found[best]:
        return no_second_mask(clip)
    return SecondMask(clip, found[best], f"MediaPipe's, {_NAMES[best]}, overlap {agreement[best]:.3f}")


def independent(
    model: Callable[[np.ndarray], np.ndarray],
    clip: EvaluatedClip,
    frames: Sequence[int],
    advance: Callable[[], object],
) -> SecondMask:
    """A model's masks of some frames, in the box of the clip's mask; a frame without a person has none.

    Args:
        model: from a picture [H, W, 3] uint8 to a mask [H, W] in [0, 1].
        clip, frames: what is masked.
        advance: called after every frame.
    """
    masks = {}
    for frame in frames:
        mask = clip.mask(frame)
        box = person_box(mask > 127, MARGIN)
        if box is not None:
            alpha = np.zeros(mask.shape, np.float32)
            alpha[box] = model(np.ascontiguousarray(clip.frame(frame)[box]))
            masks[frame] = np.round(np.clip(alpha, 0, 1) * 255).astype(np.uint8)
        advance()
    if not masks:
        return no_second_mask(clip)
    return SecondMask(clip, masks, f"U2-Net's, overlap {mean_overlap(clip, masks):.3f}")


def person_box(inside: np.ndarray, margin: float) -> tuple[slice, slice] | None:
    """Rows and columns of the True pixels [H, W] and a margin, a share of their extent; None without any."""
    box = []
    for axis, length in ((1, inside.shape[0]), (0, inside.shape[1])):
        places = np.flatnonzero(inside.any(axis))
        if not len(places):
            return None
        more = round(margin * (places[-1] + 1 - places[0]))
        box.append(slice(max(0, int(places[0]) - more), min(length, int(places[-1]) + 1 + more)))
    return box[0], box[1]


def mean_overlap(clip: EvaluatedClip, masks: Mapping[int, np.ndarray]) -> float:
    """The mean intersection over union with the clip's masks, cut at one half; 0 without any."""
    return float(np.mean([overlap(clip.mask(frame), mask) for frame, mask in masks.items()] or [0.0]))


def overlap(first: np.ndarray, second: np.ndarray) -> float:
    """Intersection over union of two masks [H, W] uint8, cut at one half; 0 where both are empty."""
    union = int(((first > 127) | (second > 127)).sum())
    return int(((first > 127) & (second > 127)).sum()) / union if union else 0.0


def read_given(folder: Path, path: Path | None, clip: EvaluatedClip, frame: int) -> np.ndarray:
    """A mask that somebody else made, [H, W] uint8; ``path`` is its file in ``folder``.

    Raises:
        UserError: there is none, or it has another size than the frame.
    """
    if path is None:
        names = f"{frame:06d}.png or {frame}.png"
        raise UserError(f"evaluate.second_mask={folder}: there is no {names} in it, or what stands for it")
    mask = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_GRAYSCALE) if path.stat().st_size else None
    expected = clip.mask(frame).shape
    if mask is None or mask.shape != expected:
        raise UserError(
            f"{path}: not a grey picture of {expected[1]} x {expected[0]} pixels, as the frame is"
        )
    return mask
