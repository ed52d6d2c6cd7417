"""Pictures for people: truth beside render beside error, and the report's cover."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import cv2
import numpy as np
import torch
from torch import Tensor

from pipeline.metrics.regions import Box
from pipeline.splat import Gaussians, Rendering, render
from pipeline.turntable import orbit, visible_extent
from stages.evaluate.evaluated_clip import EvaluatedClip, evenly
from stages.evaluate.frame_metrics import to_bytes
from stages.evaluate.methods import AvatarMethod
from stages.evaluate.scores import ScoredFrame
from stages.evaluate.settings import EvaluateSettings

CLOSEUP = 160  # pixels
COVER_HEIGHT = 400  # pixels
GREY = 0.82
_GAP = 6  # pixels between pictures
_BAND = 26  # pixels of the caption above a column
_PAPER = 255
_INK = (40, 40, 40)


@dataclasses.dataclass(frozen=True)
class Comparison:
    """One frame as it was and as the avatar shows it.

    Attributes:
        frame: number in the source clip.
        truth: [H, W, 3] uint8 RGB, the person on what is scored.
        render: [H, W, 3] uint8 RGB.
        error: [H, W, 3] uint8 RGB, the absolute difference times the gain.
        psnr: dB, of the whole image.
    """

    frame: int
    truth: np.ndarray
    render: np.ndarray
    error: np.ndarray
    psnr: float

    @property
    def pictures(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Truth, render, error: the order in which they are shown."""
        return self.truth, self.render, self.error

    def cropped(self, box: Box) -> Comparison:
        """The same comparison inside (left, top, right, bottom)."""
        left, top, right, bottom = box
        cut = (slice(top, bottom), slice(left, right))
        truth, render, error = (picture[cut] for picture in self.pictures)
        return dataclasses.replace(self, truth=truth, render=render, error=error)


@dataclasses.dataclass(frozen=True)
class Closeup:
    """A face or a hand of one frame, enlarged.

    Attributes:
        region: ``face`` or ``hands``.
        comparison: truth, render and error of it.
    """

    region: str
    comparison: Comparison


@dataclasses.dataclass
class Comparisons:
    """The pictures that are kept of the frames while they are scored.

    Attributes:
        frames: those of ``comparison.png``; held out, or trained on where none is.
        slider_frames: those of the report's slider; ``frames`` among them.
        box: left, top, right, bottom of the person in all of these.
        error_gain: the factor of the error pictures.
        whole: frame -> its comparison, cropped to the box.
        closeups: faces and hands of ``frames``.
    """

    frames: Sequence[int]
    slider_frames: Sequence[int]
    box: Box
    error_gain: float
    whole: dict[int, Comparison] = dataclasses.field(default_factory=dict)
    closeups: list[Closeup] = dataclasses.field(default_factory=list)

    def add(self, scored: ScoredFrame) -> None:
        """Keeps the pictures of a frame, where it is to be shown."""
        truth = scored.truth
        if truth.frame not in self.slider_frames:
            return
        pair = compare(truth.frame, truth.picture.image, scored.render, self.error_gain, scored.psnr)
        self.closeups += closeups(pair, truth.boxes) if truth.frame in self.frames else []
        self.whole[truth.frame] = pair.cropped(self.box)

    @property
    def sheet(self) -> list[Comparison]:
        """The comparisons of ``comparison.png``."""
        return [self.whole[frame] for frame in self.frames]

    @property
    def slider(self) -> list[Comparison]:
        """The comparisons of the slider."""
        return [self.whole[frame] for frame in self.slider_frames]


def empty_comparisons(clip: EvaluatedClip, settings: EvaluateSettings) -> Comparisons:
    """Chooses the frames that are shown, evenly spaced, and finds the person in them."""
    scored = clip.split.test or evenly(clip.split.train, settings.training_frames)
    frames = evenly(scored, settings.comparison_frames)
    slider = sorted({*(evenly(scored, settings.slider_frames) if settings.slider_frames else []), *frames})
    box = person_box([clip.mask(frame) for frame in slider])
    return Comparisons(frames, slider, box, settings.error_gain)


def closeups(whole: Comparison, boxes: Mapping[str, Sequence[Box]]) -> list[Closeup]:
    """The crops of a comparison of whole pictures, each ``CLOSEUP`` pixels high or more.

    Enlarged so that each pixel stays a square: what is blurred is the render, not the page.
    """
    found = []
    for region, each in boxes.items():
        for box in each:
            part = whole.cropped(box)
            factor = max(1, -(-CLOSEUP // part.truth.shape[0]))
            truth, render, error = (
                np.kron(one, np.ones((factor, factor, 1), np.uint8)) for one in part.pictures
            )
            found.append(Closeup(region, dataclasses.replace(part, truth=truth, render=render, error=error)))
    return found


def compare(frame: int, truth: Tensor, render: Tensor, gain: float, psnr: float) -> Comparison:
    """Sets a render beside the truth; both [H, W, 3] float in [0, 1]."""
    error = ((render - truth).abs() * gain).clamp(0, 1)
    return Comparison(frame, to_bytes(truth), to_bytes(render), to_bytes(error), psnr)


def person_box(masks: Sequence[np.ndarray], margin: int = 16) -> Box:
    """The box (left, top, right, bottom) around the person in all of the masks, [H, W] uint8.

    The whole image where no mask shows anyone.
    """
    seen = np.maximum.reduce(masks) > 127
    height, width = seen.shape
    if not seen.any():
        return 0, 0, width, height
    rows, columns = np.flatnonzero(seen.any(1)), np.flatnonzero(seen.any(0))
    return (
        max(0, int(columns[0]) - margin),
        max(0, int(rows[0]) - margin),
        min(width, int(columns[-1]) + 1 + margin),
        min(height, int(rows[-1]) + 1 + margin),
    )


def comparison_sheet(comparisons: Sequence[Comparison], gain: float) -> np.ndarray:
    """``comparison.png``: a row a frame; ground truth, render, error. [H, W, 3] uint8 RGB."""
    width = comparisons[0].truth.shape[1]
    sheet = [beside([caption(title, width) for title in ("ground truth", "render", f"error x{gain:g}")])]
    for one in comparisons:
        row = beside(one.pictures)
        sheet += [row, caption(f"frame {one.frame}, {one.psnr:.2f} dB", row.shape[1])]
    return np.concatenate(sheet)


def resized(picture: np.ndarray, height: int) -> np.ndarray:
    """The picture at another height, its proportions kept."""
    width = max(1, round(picture.shape[1] * height / picture.shape[0]))
    shrinks = height < picture.shape[0]
    return cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)


def beside(pictures: Sequence[np.ndarray]) -> np.ndarray:
    """Pictures of one height side by side, with a gap of paper between them."""
    gap = np.full((pictures[0].shape[0], _GAP, 3), _PAPER, np.uint8)
    parts = [part for picture in pictures for part in (picture, gap)]
    return np.concatenate(parts[:-1], axis=1)


def caption(text: str, width: int) -> np.ndarray:
    """A band of paper with the text on it, made smaller where it would not fit."""
    band = np.full((_BAND, width, 3), _PAPER, np.uint8)
    scale = 0.5
    (length, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
    scale *= min(1.0, max(width - 8, 1) / length)
    cv2.putText(band, text, (4, _BAND - 9), cv2.FONT_HERSHEY_SIMPLEX, scale, _INK, 1, cv2.LINE_AA)
    return band


def cover_pictures(avatar: AvatarMethod, frame: int, relaxed: Gaussians) -> list[np.ndarray]:
    """The report's cover: as filmed, the avatar in that pose, the avatar turned to either side.

    Args:
        avatar: shows the frame.
        frame: the one that is shown.
        relaxed: the avatar in the pose of the turntable.

    Returns:
        Four pictures [H, W, 3] uint8 RGB of one height, the first and the last two of one width.
    """
    left, top, right, bottom = person_box([avatar.clip.mask(frame)])
    pair = (avatar.clip.frame(frame), on_grey(avatar.rendering(frame)))
    cut = [picture[top:bottom, left:right] for picture in pair]
    return [resized(one, COVER_HEIGHT) for one in (*cut, *both_sides(relaxed))]


@torch.no_grad()
def both_sides(gaussians: Gaussians) -> list[np.ndarray]:
    """The avatar from its right and from its left, 40 degrees off the front, cut to what is seen."""
    cameras = orbit(visible_extent(gaussians), 480, 640, 9)
    renderings = [render(gaussians, camera) for camera in (cameras[-1], cameras[1])]
    masks = [(rendering.alpha.clamp(0, 1) * 255).byte().numpy() for rendering in renderings]
    left, top, right, bottom = person_box(masks)
    return [on_grey(rendering)[top:bottom, left:right] for rendering in renderings]


def on_grey(rendering: Rendering) -> np.ndarray:
    """The picture for people: dark hair and a white shirt both stand out; [H, W, 3] uint8 RGB."""
    image = rendering.color + (1 - rendering.alpha[..., None]) * GREY
    return to_bytes(image)
