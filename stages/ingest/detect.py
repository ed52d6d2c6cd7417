"""The passes that look at the footage: who is in it, and what is seen of the chosen person."""

from __future__ import annotations

import dataclasses
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from pipeline.clip.frames import write_frame, write_mask
from pipeline.clip.keypoints import BODY, Keypoints, empty_keypoints
from pipeline.detection.mediapipe import Estimate, Estimator, estimator_scale, resize
from pipeline.detection.wholebody import Landmarks, inside, to_keypoints, to_pixels
from stages.ingest import people
from stages.ingest.detections import check_frames, read_foreign_mask, read_whole_body
from stages.ingest.finder import Finder
from stages.ingest.masks import write_raw
from stages.ingest.settings import IngestSettings
from stages.ingest.sources import Sources
from stages.ingest.video import Clip, Picture, read_clip

if TYPE_CHECKING:
    from pipeline.run.stage import Context

LOOKS_A_SECOND = 5  # how often the clip is searched for people
NATIVE_LOG = "mediapipe.log"
BEST_POINTS = 5  # a person is there when this many body points are


@dataclasses.dataclass(frozen=True)
class Detected:
    """What came of the clip; the frames and their raw masks are on disk by now.

    Attributes:
        keypoints: of the kept frames.
        seconds: the time of each kept frame.
        width, height: of the stored frames.
        scale: stored pixels in one source pixel.
        read: how many frames were looked at.
        dropped: reason -> frames.
        people: how many people there are at once; 0 where nobody counted.
    """

    keypoints: Keypoints
    seconds: tuple[float, ...]
    width: int
    height: int
    scale: float
    read: int
    dropped: dict[str, int]
    people: int


@dataclasses.dataclass(frozen=True)
class Seen:
    """One frame's person.

    Attributes:
        landmarks: MediaPipe's, or None where it was not asked or found nobody.
        whole_body: [133, 3] of the other source, pixels of the stored frame, or None.
        masks: [H, W] float32 in [0, 1], not refined: one that somebody else made, or the pose model's and
            the selfie segmentation.
    """

    landmarks: Landmarks | None
    whole_body: np.ndarray | None
    masks: tuple[np.ndarray, ...]


class Looker:
    """Looks at one frame after the other."""

    def __init__(self, context: Context, clip: Clip, sources: Sources, who: people.Survey) -> None:
        """Load what the sources call for."""
        self.settings, self.clip, self.sources, self.who = context.settings, clip, sources, who
        self.scale = min(1.0, self.settings.long_side / max(clip.width, clip.height))
        self.width, self.height = (max(1, round(side * self.scale)) for side in (clip.width, clip.height))
        self.estimator_scale = estimator_scale(
            clip.width, clip.height, self.settings.estimator_short_side, self.settings.estimator_long_side
        )
        self.estimator = None
        if sources.mediapipe is not None:
            self.estimator = Estimator(sources.mediapipe, context.work / NATIVE_LOG)

    def look(self, picture: Picture) -> Seen | str:
        """The person in a frame, or the reason why the frame is dropped."""
        own = people.territory(picture.index, self.who, self.clip.width, self.clip.height)
        estimate = self._estimate(picture, own)
        whole_body = None
        if self.sources.keypoints is not None:
            if picture.index not in self.sources.keypoints:
                return "no keypoint file"
            whole_body = self._whole_body(picture.index)
        elif estimate is None:
            return "no person found"
        landmarks = to_pixels(estimate, self.width, self.height) if estimate is not None else None
        points = self._body_points(landmarks, whole_body)
        if np.sort(points[:, 2])[-BEST_POINTS:].mean() < self.settings.body_score:
            return "no person found"
        masks = self._masks(picture, estimate, own)
        if isinstance(masks, str):
            return masks
        if masks[0].mean() < self.settings.mask_area:
            return "mask too small"
        return Seen(landmarks, whole_body, masks)

    def _estimate(self, picture: Picture, own: np.ndarray | None) -> Estimate | None:
        if self.estimator is None:
            return None
        return self.estimator.estimate(resize(people.spotlight(picture.image, own), self.estimator_scale))

    def _whole_body(self, index: int) -> np.ndarray:
        assert self.sources.keypoints is not None
        points = read_whole_body(self.sources.keypoints[index])
        points[:, :2] *= [self.width / self.clip.width, self.height / self.clip.height]
        points[:, 2] *= inside(points, np.array([self.width, self.height], np.float32))
        points[points[:, 2] <= 0] = 0
        return points

    def _body_points(self, landmarks: Landmarks | None, whole_body: np.ndarray | None) -> np.ndarray:
        """The body's points, [17, 3] or [33, 3], with scores that are 0 outside the picture."""
        if whole_body is not None:
            return whole_body[BODY]
        assert landmarks is not None
        points = landmarks.pose[:, [0, 1, 3]].copy()
        points[:, 2] *= inside(points, np.array([self.width, self.height], np.float32))
        return points

    def _masks(
        self, picture: Picture, estimate: Estimate | None, own: np.ndarray | None
    ) -> tuple[np.ndarray, ...] | str:
        """Somebody else's mask, or the estimator's two; or the reason why there is none."""
        size = (self.width, self.height)
        if self.sources.masks is not None:
            file = self.sources.masks.get(picture.index)
            return (
                (read_foreign_mask(file, *size, self.sources.mask_kind).astype(np.float32) / 255,)
                if file
                else "no mask file"
            )
        if estimate is None:
            return "no person found"
        both = (estimate.body_mask, estimate.selfie_mask)
        masks = [cv2.resize(mask, size, interpolation=cv2.INTER_AREA) for mask in both]
        if own is not None:
            part = cv2.resize(own.astype(np.float32), size, interpolation=cv2.INTER_AREA)
            masks = [mask * part for mask in masks]
        return tuple(masks)


def count_people(context: Context, clip: Clip, sources: Sources) -> tuple[people.Survey, int]:
    """Search some frames for people; who is in the clip, and how many frames it has (0: unknown)."""
    settings = context.settings
    if sources.mediapipe is None:
        return people.Survey(None, (), 0), 0
    finder = Finder(sources.mediapipe, context.work / NATIVE_LOG)
    every = max(1, round((clip.fps or LOOKS_A_SECOND) / settings.stride / LOOKS_A_SECOND))
    looks, total = [], 0
    with context.progress(_expected(clip, settings), "people") as progress:
        for picture in read_clip(clip, settings.stride, settings.max_frames):
            if total % every == 0:
                looks.append((picture.index, finder.find(picture.image)))
            total += 1
            progress.advance()
    who = people.survey(looks, clip.width, clip.height)
    if who.count > 1:
        context.log(f"{who.count} people at once: the largest and most central one is kept")
    return who, total


def detect(context: Context, clip: Clip, sources: Sources, raw_masks: Path) -> Detected:
    """Look at every frame, write the kept ones to ``output/frames`` and their raw masks to ``raw_masks``.

    Raises:
        UserError: a damaged frame, or a keypoint or mask file that is damaged or of no frame.
    """
    settings = context.settings
    who, total = count_people(context, clip, sources)
    looker = Looker(context, clip, sources, who)
    kept: list[tuple[int, float, Seen]] = []
    dropped: Counter[str] = Counter()
    numbers: set[int] = set()
    with context.progress(total or _expected(clip, settings), "frames") as progress:
        for picture in read_clip(clip, settings.stride, settings.max_frames):
            numbers.add(picture.index)
            seen = looker.look(picture)
            if isinstance(seen, str):
                dropped[seen] += 1
            else:
                image = cv2.resize(picture.image, (looker.width, looker.height), interpolation=cv2.INTER_AREA)
                write_frame(context.output / "frames", picture.index, image)
                if len(seen.masks) == 1:
                    write_mask(raw_masks, picture.index, np.round(seen.masks[0] * 255).astype(np.uint8))
                else:
                    write_raw(raw_masks, picture.index, *seen.masks)
                kept.append((picture.index, picture.seconds, dataclasses.replace(seen, masks=())))
            progress.advance()
    for files in (sources.keypoints, sources.masks):
        check_frames(files or {}, numbers, complete=settings.stride == 1 and not settings.max_frames)
    return Detected(
        keypoints=_stack(kept, looker),
        seconds=tuple(seconds for _, seconds, _ in kept),
        width=looker.width,
        height=looker.height,
        scale=looker.scale,
        read=len(numbers),
        dropped=dict(sorted(dropped.items())),
        people=who.count,
    )


def _stack(kept: list[tuple[int, float, Seen]], looker: Looker) -> Keypoints:
    frames = np.array([index for index, _, _ in kept], np.int64)
    blank = empty_keypoints(np.zeros(1, np.int64))
    nothing = Landmarks(blank.pose_image[0], blank.pose_world[0], blank.face_mesh[0], blank.hands[0])
    landmarks = [seen.landmarks or nothing for _, _, seen in kept]
    magnification = looker.estimator_scale / looker.scale
    keypoints = to_keypoints(frames, landmarks, looker.width, looker.height, magnification)
    for row, (_, _, seen) in enumerate(kept):
        if seen.whole_body is not None:
            keypoints.whole_body[row] = seen.whole_body
    return keypoints


def _expected(clip: Clip, settings: IngestSettings) -> int:
    stride, limit = settings.stride, settings.max_frames
    total = -(-clip.expected // stride)
    return min(total, limit) if limit else total
