"""The encoding of given masks, and whether white or black is the person in them."""

from __future__ import annotations

import dataclasses
import itertools
from typing import TYPE_CHECKING

import numpy as np

from pipeline.detection.mediapipe import Estimator, estimator_scale, resize
from pipeline.detection.wholebody import to_pixels
from stages.ingest.external_detections import DetectionSources
from stages.ingest.keypoint_check import share_on
from stages.ingest.mask_files import MaskForm, find_form, read_given_mask, rim_is_white, sampled
from stages.ingest.video import Clip, SourceFrame, read_clip

if TYPE_CHECKING:
    from pipeline.run.stage import Context

ASKED = 8  # frames whose points tell black from white
_LOOKED_THROUGH = 200  # frames among which they are looked for


def with_mask_form(context: Context, clip: Clip, sources: DetectionSources) -> DetectionSources:
    """The sources with the masks' encoding found, and logged where the files are not of the usual one.

    Masks whose rim is mostly white are inverted unless the person's points lie on the white: somebody who
    fills the picture has a white rim, too.

    Raises:
        UserError: a mask is damaged, or they are no masks.
    """
    if not sources.masks:
        return sources
    files = list(sources.masks.values())
    form = find_form(files, sources.mask_kind)
    if form.kind == "white" and np.mean([rim_is_white(file, form) for file in sampled(files)]) > 0.5:
        white = _white_is_the_person(context, clip, sources, form)
        form = form if white else dataclasses.replace(form, kind="inverted")
    if form != MaskForm(sources.mask_kind):
        context.log(f"masks: {form}")
    return dataclasses.replace(sources, mask_form=form)


def _white_is_the_person(context: Context, clip: Clip, sources: DetectionSources, form: MaskForm) -> bool:
    """Whether most points of the person lie on the white; False where there are none."""
    masks, settings = sources.masks or {}, context.settings
    pictures = read_clip(clip, settings.stride, settings.max_frames)
    looked_at = (one for one in itertools.islice(pictures, _LOOKED_THROUGH) if one.index in masks)
    shares = []
    estimator, sides = None, (settings.estimator_short_side, settings.estimator_long_side)
    scale = estimator_scale(clip.width, clip.height, *sides)
    if sources.keypoints is None and sources.mediapipe is not None:
        estimator = Estimator(sources.mediapipe, context.work / "mediapipe.log", still=True)
    for picture in looked_at:
        points = _points(clip, sources, estimator, scale, picture)
        if points is not None:
            mask = read_given_mask(masks[picture.index], clip.width, clip.height, form)
            shares.append(share_on(points, mask > 127))
        if len(shares) == ASKED:
            break
    known = [share for share in shares if np.isfinite(share)]
    return bool(known) and float(np.median(known)) > 0.5


def _points(
    clip: Clip, sources: DetectionSources, estimator: Estimator | None, scale: float, picture: SourceFrame
) -> np.ndarray | None:
    """The points of the person with the best score [N, 3], pixels of the source; None without any."""
    if sources.keypoints is not None:
        if picture.index not in sources.keypoints.files:
            return None
        people = sources.keypoints.people(picture.index, (clip.width, clip.height))
        return people[int(np.argmax(people[..., 2].mean(1)))] if len(people) else None
    if estimator is None:
        return None
    estimate = estimator.estimate(resize(picture.image, scale))
    return None if estimate is None else to_pixels(estimate, clip.width, clip.height).pose[:, [0, 1, 3]]
