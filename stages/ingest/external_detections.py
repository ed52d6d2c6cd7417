"""Where a shot's keypoints and masks come from: MediaPipe, or files that another program has made.

What those files hold is in ``keypoint_files`` and ``mask_files``, which frame a file means in
``pipeline.clip.frame_files``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from pipeline.clip.frame_files import ClipFrames, Match, describe_match, match_files, numbers_in
from pipeline.errors import UserError
from stages.ingest.datasets.recording import Shot
from stages.ingest.keypoint_files import GivenKeypoints, open_keypoints
from stages.ingest.mask_files import MaskForm, has_own_alpha
from stages.ingest.video import PICTURES, Clip, clip_frames, read_clip

if TYPE_CHECKING:
    from pipeline.run.stage import Context

Found = TypeVar("Found")
MEDIAPIPE, AUTO, OWN_ALPHA = "mediapipe", "auto", "the pictures' own alpha"


@dataclasses.dataclass(frozen=True)
class DetectionSources:
    """The files and models that give a shot's keypoints and masks.

    Attributes:
        mediapipe: the asset's folder; None where nothing is asked of it.
        keypoints: another program's; None where MediaPipe gives the keypoints.
        masks: frame number -> picture; None where MediaPipe gives the masks.
        mask_kind: the person is ``white``, ``inverted`` (black) or ``nonzero`` in them, as the dataset says.
        names: for ``footage.json``: what ``keypoints`` and ``masks`` came from.
        mask_form: how the masks are encoded, once they were looked at.
    """

    mediapipe: Path | None
    keypoints: GivenKeypoints | None
    masks: Mapping[int, Path] | None
    mask_kind: str = "white"
    names: Mapping[str, str] = dataclasses.field(default_factory=dict)
    mask_form: MaskForm = MaskForm()


def open_sources(context: Context, shot: Shot, layout: str, span: range | None = None) -> DetectionSources:
    """The sources that the settings and the dataset name.

    Args:
        context: the stage's.
        shot: the footage and what the dataset brings.
        layout: the dataset's name.
        span: the frame numbers of this shot, where there are several; files that the settings name are then
            numbered as the frames are.

    Raises:
        UserError: a folder is missing, empty or ambiguous, a file is of no frame, or MediaPipe is needed and
            not there.
    """
    keypoints, points_of = _keypoints(context, shot, layout, span)
    masks, kind, masks_of = _masks(context, shot, layout, span)
    mediapipe = None
    if keypoints is None or masks is None:
        if MEDIAPIPE not in context.assets:
            raise UserError("MediaPipe is not in data/assets: fetch it with doit run assets:mediapipe")
        mediapipe = context.assets[MEDIAPIPE]
    if keypoints is not None and mediapipe is not None:
        context.log("keypoints: as given; MediaPipe gives the masks alone")
    elif mediapipe is not None:
        found = "keypoints and masks" if masks is None else "keypoints"
        context.log(f"{found}: MediaPipe's; ingest.keypoints and ingest.masks name another program's")
    return DetectionSources(mediapipe, keypoints, masks, kind, {"keypoints": points_of, "masks": masks_of})


def _keypoints(
    context: Context, shot: Shot, layout: str, span: range | None
) -> tuple[GivenKeypoints | None, str]:
    setting = context.settings.keypoints
    if setting == AUTO and shot.keypoints is not None:
        return GivenKeypoints(shot.keypoints), layout
    if setting in (AUTO, MEDIAPIPE):
        return None, MEDIAPIPE
    path = Path(setting)
    if not path.exists():
        raise UserError(
            f"{path} is not a folder: ingest.keypoints must be 'mediapipe', a folder of files or a file"
        )
    if span is not None:
        given, _ = open_keypoints(path, ClipFrames(range(span.stop)), 0)
        files = {frame: file for frame, file in given.files.items() if frame in span}
        return dataclasses.replace(given, files=files), setting

    def match(frames: ClipFrames) -> tuple[GivenKeypoints, Match]:
        return open_keypoints(path, frames, context.settings.first_number)

    return _matched(context, "keypoints", path, shot.clip, match), setting


def _masks(
    context: Context, shot: Shot, layout: str, span: range | None
) -> tuple[Mapping[int, Path] | None, str, str]:
    setting = context.settings.masks
    if setting == AUTO and shot.masks is not None:
        return shot.masks, shot.mask_kind, layout
    if setting == AUTO and has_own_alpha(shot.clip.pictures):
        return shot.clip.pictures, "white", OWN_ALPHA
    if setting in (AUTO, MEDIAPIPE):
        return None, "white", MEDIAPIPE
    folder = Path(setting)
    if not folder.is_dir():
        raise UserError(f"{folder} is not a folder: ingest.masks must be 'mediapipe' or a folder of files")
    if span is not None:
        files, _ = match_files(folder, PICTURES, ClipFrames(range(span.stop)), 0)
        return {frame: file for frame, file in files.items() if frame in span}, "white", setting

    def match(frames: ClipFrames) -> tuple[dict[int, Path], Match]:
        files, match = match_files(folder, PICTURES, frames, context.settings.first_number)
        if not files and not match.strangers:
            raise UserError(f"{folder} holds no numbered {'/'.join(PICTURES)} file: check ingest.masks")
        return files, match

    return _matched(context, "masks", folder, shot.clip, match), "white", setting


def _matched(
    context: Context, what: str, path: Path, clip: Clip, match: Callable[[ClipFrames], tuple[Found, Match]]
) -> Found:
    """What ``match`` finds for the frames of a clip, logged; UserError where a file is of no frame."""
    frames = clip_frames(clip)
    found, how = match(frames)
    if not clip.pictures and (how.strangers or not frames.numbers):
        # Containers may be wrong about how many frames they have, or say nothing.
        context.log(f"{what}: counting the frames of {clip.path.name}")
        frames = ClipFrames(range(clip.first, clip.first + sum(1 for _ in read_clip(clip))))
        found, how = match(frames)
    if how.strangers:
        raise _stranger(path, how.strangers, frames, clip)
    context.log(f"{what}: {describe_match(how, frames)}")
    return found


def _stranger(path: Path, strangers: Sequence[str], frames: ClipFrames, clip: Clip) -> UserError:
    numbers = list(numbers_in(strangers).values())
    place = path / strangers[0] if path.is_dir() else f"{path}, '{strangers[0]}'"
    meant = f"is for frame {numbers[0]}, which the clip does not have" if numbers else "is of no frame"
    return UserError(
        f"{place} {meant} ({len(strangers)} such; {clip.path.name} has {len(frames.numbers)} frames): "
        "name the files as the frames, say ingest.numbered_from (the first frame's number), or take them out"
    )


def check_frames(sources: DetectionSources, frames: set[int]) -> None:
    """Refuse files of which one is of no frame that was read; UserError names it."""
    for files in (sources.keypoints.files if sources.keypoints else {}, sources.masks or {}):
        strangers = sorted(set(files) - frames)
        if strangers:
            raise UserError(
                f"{files[strangers[0]]} is for frame {strangers[0]}, which the clip does not have "
                f"({len(strangers)} such files): number the files as the frames, or take them out"
            )
