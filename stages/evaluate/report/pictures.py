"""Pictures for people: truth beside render beside error, and the report's cover."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from pipeline.clip.boxes import Box, person_box
from pipeline.clip.composite import to_bytes
from pipeline.clip.frames import spread_end_to_end
from pipeline.orbit_cameras import orbit, visible_extent
from pipeline.pictures import PAPER, caption, padded, resized, side_by_side
from pipeline.splat import Gaussians, Rendering, render
from stages.evaluate.evaluated_clip import EvaluatedClip
from stages.evaluate.methods import AvatarMethod
from stages.evaluate.scores import ScoredFrame
from stages.evaluate.settings import EvaluateSettings

CLOSEUP = 160  # pixels
COVER_HEIGHT = 400  # pixels
GREY = 0.82
GAP = 6  # pixels between pictures


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
        """The same comparison inside a box."""
        truth, render, error = (picture[box.slices] for picture in self.pictures)
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
        box: of the person in all of these.
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
    scored = clip.split.test or spread_end_to_end(clip.split.train, settings.training_frames)
    frames = spread_end_to_end(scored, settings.comparison_frames)
    slider = sorted(
        {*(spread_end_to_end(scored, settings.slider_frames) if settings.slider_frames else []), *frames}
    )
    masks = [clip.mask(frame) for frame in slider]
    box = person_box(masks) or Box.whole(masks[0])
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


def comparison_sheet(comparisons: Sequence[Comparison], gain: float) -> np.ndarray:
    """``comparison.png``: a row a frame; ground truth, render, error. [H, W, 3] uint8 RGB."""
    width = max(one.truth.shape[1] for one in comparisons)  # cameras of one rig may differ in size
    titles = ("ground truth", "render", f"error x{gain:g}")
    sheet = [side_by_side([caption(title, width) for title in titles], GAP)]
    for one in comparisons:
        row = side_by_side([padded(picture, width, 0, PAPER) for picture in one.pictures], GAP)
        sheet += [row, caption(f"frame {one.frame}, {one.psnr:.2f} dB", row.shape[1])]
    return np.concatenate(sheet)


def cover_pictures(avatar: AvatarMethod, frame: int, relaxed: Gaussians) -> list[np.ndarray]:
    """The report's cover: as filmed, the avatar in that pose, the avatar turned to either side.

    Args:
        avatar: shows the frame.
        frame: the one that is shown.
        relaxed: the avatar in the pose of the turntable.

    Returns:
        Four pictures [H, W, 3] uint8 RGB of one height, the first and the last two of one width.
    """
    mask = avatar.clip.mask(frame)
    box = person_box([mask]) or Box.whole(mask)
    pair = (avatar.clip.frame(frame), on_grey(avatar.rendering(frame)))
    cut = [picture[box.slices] for picture in pair]
    return [resized(one, COVER_HEIGHT) for one in (*cut, *both_sides(relaxed))]


@torch.no_grad()
def both_sides(gaussians: Gaussians) -> list[np.ndarray]:
    """The avatar from its right and from its left, 40 degrees off the front, cut to what is seen."""
    cameras = orbit(visible_extent(gaussians), 480, 640, 9)
    renderings = [render(gaussians, camera) for camera in (cameras[-1], cameras[1])]
    masks = [(rendering.alpha.clamp(0, 1) * 255).byte().numpy() for rendering in renderings]
    box = person_box(masks) or Box.whole(masks[0])
    return [on_grey(rendering)[box.slices] for rendering in renderings]


def on_grey(rendering: Rendering) -> np.ndarray:
    """The picture for people: dark hair and a white shirt both stand out; [H, W, 3] uint8 RGB."""
    image = rendering.color + (1 - rendering.alpha[..., None]) * GREY
    return to_bytes(image)
