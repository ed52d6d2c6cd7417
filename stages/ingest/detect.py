"""The second pass over the footage: landmarks and masks of the chosen person."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from pipeline.clip.boxes import Box
from pipeline.clip.frames import write_frame, write_mask
from pipeline.clip.keypoints import BODY, Keypoints, empty_keypoints
from pipeline.detection.mediapipe import Estimate, Estimator, estimator_scale, resize
from pipeline.detection.wholebody import PixelLandmarks, inside_picture, to_keypoints, to_pixels
from stages.ingest.external_detections import DetectionSources, check_frames
from stages.ingest.keypoint_check import OFF_FRAME, Agreement, check_agreement, choose_person
from stages.ingest.mask_files import read_given_mask
from stages.ingest.mask_polarity import with_mask_form
from stages.ingest.masks import write_segmentations
from stages.ingest.people import ClipPeople, Track, hide_others, subject_region
from stages.ingest.people_search import NATIVE_LOG, expected_frames, search_people
from stages.ingest.person_detector import Person
from stages.ingest.stills import are_stills, detects_singly
from stages.ingest.video import Clip, SourceFrame, missing_frames, read_clip

if TYPE_CHECKING:
    from pipeline.run.stage import Context

BEST_POINTS = 5  # a person is there when this many body points are
OFF_MASK = "keypoints off the mask"
NO_BODY = "keypoints without five of the body, among which nose, eyes and ears are"
OTHER_SHOT, ABSENT = "another shot", "another person"
NEIGHBOURHOOD = 1.5  # of a person's radius about the hips: what the estimator is shown where others are about
MOST_COMPARED = 32  # frames whose masks are kept, to tell how given keypoints fail


@dataclasses.dataclass(frozen=True)
class DetectedClip:
    """The kept frames of a clip, whose pictures and raw masks are on disk.

    Attributes:
        keypoints: of the kept frames.
        seconds: the time of each kept frame.
        width, height: of the stored frames.
        scale: stored pixels in one source pixel.
        read: how many frames were looked at.
        dropped: reason -> frames.
        people: how many people there are at once; 0 where nobody counted.
        stills: whether the frames are single pictures, see ``stills.py``.
        subject: the person who was followed; None where nobody searched.
    """

    keypoints: Keypoints
    seconds: tuple[float, ...]
    width: int
    height: int
    scale: float
    read: int
    dropped: dict[str, int]
    people: int
    stills: bool = False
    subject: Track | None = None


@dataclasses.dataclass(frozen=True)
class FrameDetections:
    """The person in one frame.

    Attributes:
        landmarks: MediaPipe's, or None where it was not asked or found nobody.
        whole_body: [133, 3] of another program, pixels of the stored frame, or None.
        masks: [H, W] float32 in [0, 1], not refined: another program's, or the pose model's and the selfie
            segmentation.
    """

    landmarks: PixelLandmarks | None
    whole_body: np.ndarray | None
    masks: tuple[np.ndarray, ...]


class FrameDetector:
    """Detects the chosen person in one frame after the other."""

    def __init__(
        self,
        context: Context,
        clip: Clip,
        sources: DetectionSources,
        found: ClipPeople,
        singly: bool = False,
    ) -> None:
        """Load the estimator if the sources need it; ``singly``: it looks at each frame by itself."""
        self.settings, self.clip, self.sources, self.people = context.settings, clip, sources, found
        singly = singly or bool(found.others)  # a crop that moves cannot be followed
        self.scale = min(1.0, self.settings.long_side / max(clip.width, clip.height))
        self.width, self.height = (max(1, round(side * self.scale)) for side in (clip.width, clip.height))
        self.size = np.array([self.width, self.height], np.float32)
        self.estimator_scale = estimator_scale(
            clip.width, clip.height, self.settings.estimator_short_side, self.settings.estimator_long_side
        )
        self.estimator = None
        if sources.mediapipe is not None:
            self.estimator = Estimator(sources.mediapipe, context.work / NATIVE_LOG, singly)
        self.agreements: list[Agreement] = []

    def detect_frame(self, picture: SourceFrame) -> FrameDetections | str:
        """The person in a frame, or the reason why the frame is dropped."""
        if self.people.absent(picture.index):
            return ABSENT
        own = subject_region(picture.index, self.people, self.clip.width, self.clip.height)
        estimate = self._estimate(picture, own)
        if self.sources.keypoints is not None:
            return self._given_person(picture, estimate, own)
        if estimate is None:
            return "no person found"
        landmarks = to_pixels(estimate, self.width, self.height)
        points = landmarks.pose[:, [0, 1, 3]].copy()
        points[:, 2] *= inside_picture(points, self.size)
        if not self._is_somebody(points):
            return "no person found"
        masks = self._masks(picture, estimate, own)
        return masks if isinstance(masks, str) else FrameDetections(landmarks, None, masks)

    def _given_person(
        self, picture: SourceFrame, estimate: Estimate | None, own: np.ndarray | None
    ) -> FrameDetections | str:
        """The person whose given keypoints lie on the mask, without MediaPipe's; or why there is none."""
        given = self.sources.keypoints
        assert given is not None
        if picture.index not in given.files:
            return "no keypoint file"
        people = given.people(picture.index, (self.clip.width, self.clip.height))
        people[..., :2] *= [self.width / self.clip.width, self.height / self.clip.height]
        if not any(self._is_somebody(points[BODY]) for points in people):
            return NO_BODY if any(map(self._is_somebody, people)) else "no person found"
        people = people[[self._is_somebody(points[BODY]) for points in people]]
        masks = self._masks(picture, estimate, own)
        if isinstance(masks, str):
            return masks
        found = choose_person(people, masks[0], given.files[picture.index])
        self.agreements.append(found if len(self.agreements) < MOST_COMPARED else found.without_pictures())
        if found.share < OFF_FRAME:
            return OFF_MASK
        points = found.points
        points[:, 2] *= inside_picture(points, self.size)
        points[points[:, 2] <= 0] = 0
        if not self._is_somebody(points[BODY]):
            return "no person found"
        return FrameDetections(None, points, masks)

    def _is_somebody(self, points: np.ndarray) -> bool:
        """Whether the best of some points [N, 3] are scored well enough."""
        return float(np.sort(points[:, 2])[-BEST_POINTS:].mean()) >= self.settings.body_score

    def _estimate(self, picture: SourceFrame, own: np.ndarray | None) -> Estimate | None:
        if self.estimator is None:
            return None
        shown = hide_others(picture.image, own)
        if self.people.subject is None or not self.people.others:
            return self.estimator.estimate(resize(shown, self.estimator_scale))
        box = self._neighbourhood(self.people.subject.at(picture.index))
        part = np.ascontiguousarray(shown[box.top : box.bottom, box.left : box.right])
        scale = estimator_scale(
            box.width, box.height, self.settings.estimator_short_side, self.settings.estimator_long_side
        )
        estimate = self.estimator.estimate(resize(part, scale))
        return None if estimate is None else estimate.placed(box, self.clip.width, self.clip.height)

    def _neighbourhood(self, subject: Person) -> Box:
        """The square about the subject that the estimator is shown; inside the picture."""
        size = np.array([self.clip.width, self.clip.height])
        reach = NEIGHBOURHOOD * subject.radius
        low = np.clip(np.floor(subject.hips - reach), 0, size - 16).astype(int)
        high = np.clip(np.ceil(subject.hips + reach), low + 16, size).astype(int)
        return Box(int(low[0]), int(low[1]), int(high[0]), int(high[1]))

    def _masks(
        self, picture: SourceFrame, estimate: Estimate | None, own: np.ndarray | None
    ) -> tuple[np.ndarray, ...] | str:
        """The masks of somebody; or the reason why there are none."""
        masks = self._any_masks(picture, estimate, own)
        if not isinstance(masks, str) and masks[0].mean() < self.settings.mask_area:
            return "mask too small"
        return masks

    def _any_masks(
        self, picture: SourceFrame, estimate: Estimate | None, own: np.ndarray | None
    ) -> tuple[np.ndarray, ...] | str:
        """Another program's mask, or the estimator's two; or the reason why there is none."""
        size = (self.width, self.height)
        if self.sources.masks is not None:
            file = self.sources.masks.get(picture.index)
            if file is None:
                return "no mask file"
            return (read_given_mask(file, *size, self.sources.mask_form).astype(np.float32) / 255,)
        if estimate is None:
            return "no person found"
        both = (estimate.body_mask, estimate.selfie_mask)
        masks = [cv2.resize(mask, size, interpolation=cv2.INTER_AREA) for mask in both]
        if own is not None:
            part = cv2.resize(own.astype(np.float32), size, interpolation=cv2.INTER_AREA)
            masks = [mask * part for mask in masks]
        return tuple(masks)


def detect(
    context: Context,
    clip: Clip,
    sources: DetectionSources,
    raw_masks: Path,
    choose: Callable[[Sequence[Track]], Track] | None = None,
) -> DetectedClip:
    """Detect the person in every frame; write kept frames to ``output/frames``, raw masks to ``raw_masks``.

    Args:
        choose: finds the subject of a rig's first camera among the people of this one.

    Raises:
        UserError: a damaged frame, or a keypoint or mask file that is damaged or of no frame.
    """
    settings = context.settings
    stills = are_stills(clip, settings)
    search = search_people(context, clip, sources, stills, choose)
    everyone, total = search.everyone, search.total
    sources = with_mask_form(context, clip, sources)
    singly = detects_singly(clip, settings, stills)
    if singly and sources.mediapipe is not None:
        kind = "pictures do not follow one another" if stills else "frames lie far apart in time"
        context.log(f"{clip.path.name}: its {kind}: each is detected by itself")
    detector = FrameDetector(context, clip, sources, everyone, singly)
    kept: list[tuple[int, float, FrameDetections]] = []
    dropped: Counter[str] = Counter()
    numbers: set[int] = set()
    with context.progress(total or expected_frames(clip, settings), "frames") as progress:
        for picture in read_clip(clip, settings.stride, settings.max_frames, settings.damaged):
            numbers.add(picture.index)
            if search.shot is not None and picture.index not in search.shot:
                seen: FrameDetections | str = OTHER_SHOT
            else:
                seen = "damaged" if picture.damaged else detector.detect_frame(picture)
            if isinstance(seen, str):
                dropped[seen] += 1
                if seen == OFF_MASK:
                    context.log(f"{detector.agreements[-1].path} lies off the person's mask: frame left out")
            else:
                image = cv2.resize(
                    picture.image, (detector.width, detector.height), interpolation=cv2.INTER_AREA
                )
                write_frame(context.output / "frames", picture.index, image)
                if len(seen.masks) == 1:
                    write_mask(raw_masks, picture.index, np.round(seen.masks[0] * 255).astype(np.uint8))
                else:
                    write_segmentations(raw_masks, picture.index, *seen.masks)
                kept.append((picture.index, picture.seconds, dataclasses.replace(seen, masks=())))
            progress.advance()
    if not settings.max_frames:
        lacking = missing_frames(clip, settings.stride)
        numbers |= lacking
        dropped += Counter({"cut off": len(lacking)})
    if settings.stride == 1 and not settings.max_frames:
        check_frames(sources, numbers)
    check_agreement(detector.agreements)
    seconds, dropped_for = tuple(seconds for _, seconds, _ in kept), dict(sorted(dropped.items()))
    return DetectedClip(
        keypoints=_stack(kept, detector),
        seconds=seconds,
        width=detector.width,
        height=detector.height,
        scale=detector.scale,
        read=len(numbers),
        dropped=dropped_for,
        people=everyone.count,
        stills=stills,
        subject=everyone.subject,
    )


def _stack(kept: list[tuple[int, float, FrameDetections]], detector: FrameDetector) -> Keypoints:
    frames = np.array([index for index, _, _ in kept], np.int64)
    blank = empty_keypoints(np.zeros(1, np.int64))
    nothing = PixelLandmarks(blank.pose_image[0], blank.pose_world[0], blank.face_mesh[0], blank.hands[0])
    landmarks = [seen.landmarks or nothing for _, _, seen in kept]
    magnification = detector.estimator_scale / detector.scale
    keypoints = to_keypoints(frames, landmarks, detector.width, detector.height, magnification)
    for row, (_, _, seen) in enumerate(kept):
        if seen.whole_body is not None:
            keypoints.whole_body[row] = seen.whole_body
    return keypoints
