"""The first pass over the footage: its cuts, and everybody in the shot that is taken."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np

from stages.ingest import people
from stages.ingest.cuts import FilmShot, choose_shot, film_shots, find_cuts
from stages.ingest.external_detections import DetectionSources
from stages.ingest.person_detector import Person, PersonDetector, change_since
from stages.ingest.settings import IngestSettings
from stages.ingest.stills import thumbnail
from stages.ingest.video import Clip, read_clip

if TYPE_CHECKING:
    from pipeline.run.stage import Context

SEARCHES_A_SECOND = 5
NATIVE_LOG = "mediapipe.log"


@dataclasses.dataclass(frozen=True)
class FoundPeople:
    """What the first pass over a clip found.

    Attributes:
        everyone: the people of the shot that is taken.
        shot: that shot; None where the clip has no cut.
        total: how many frames were looked at; 0: unknown.
    """

    everyone: people.ClipPeople
    shot: FilmShot | None
    total: int


def search_people(
    context: Context,
    clip: Clip,
    sources: DetectionSources,
    stills: bool,
    choose: Callable[[Sequence[people.Track]], people.Track] | None = None,
) -> FoundPeople:
    """The first pass over a clip: its cuts, and the people in some frames of the shot that is taken.

    Args:
        choose: finds the subject of a rig's first camera among the people of this one.

    Raises:
        UserError: there is no person or no shot of the number that a setting names.
    """
    settings = context.settings
    if sources.mediapipe is None:
        return FoundPeople(people.ClipPeople(None, (), 0), None, 0)
    detector = PersonDetector(sources.mediapipe, context.work / NATIVE_LOG)
    every = max(1, round((clip.fps or SEARCHES_A_SECOND) / settings.stride / SEARCHES_A_SECOND))
    found: list[tuple[int, list[Person]]] = []
    frames: list[int] = []
    small: list[np.ndarray] = []
    before = None
    with context.progress(expected_frames(clip, settings), "people") as progress:
        for picture in read_clip(clip, settings.stride, settings.max_frames, settings.damaged):
            if len(frames) % every == 0 and not picture.damaged:
                grey = cv2.cvtColor(picture.image, cv2.COLOR_RGB2GRAY)
                seen = detector.detect(picture.image)
                if before is not None:
                    seen = [dataclasses.replace(one, change=change_since(before, grey, one)) for one in seen]
                found.append((picture.index, seen))
                before = grey
            frames.append(picture.index)
            small.append(small[-1] if picture.damaged and small else thumbnail(picture.image))
            progress.advance()
    shots = film_shots(frames, [] if stills else find_cuts(small))
    taken = _take_shot(context, clip, shots, found) if frames else None
    inside = [(frame, seen) for frame, seen in found if taken is None or frame in taken]
    name = clip.path.name
    number = settings.person if choose is None else 0
    everyone = people.track_people(inside, clip.width, clip.height, number, name, choose)
    if len(everyone.everyone) > 1:
        why = "ingest.person asked for it" if number else "who fills most of the clip and moves"
        why = why if choose is None else "the person of the first camera"
        context.log(describe_people(everyone, why, clip))
    return FoundPeople(everyone, taken, len(frames))


def _take_shot(
    context: Context, clip: Clip, shots: list[FilmShot], found: list[tuple[int, list[Person]]]
) -> FilmShot | None:
    """The shot that is taken, which the log names; None where the clip has no cut."""
    number, name = context.settings.shot, clip.path.name
    taken = choose_shot(shots, [(frame, len(seen)) for frame, seen in found], number, name)
    if len(shots) == 1:
        return None
    listed = ", ".join(str(shot.first) for shot in shots[1:])
    which = f"shot {shots.index(taken) + 1}" + ("" if number else ", the longest with a person")
    context.log(
        f"{name}: cut at frame {listed}: {which}, frames {taken.first} to {taken.last}, is taken; "
        f"ingest.shot=1 to {len(shots)} chooses"
    )
    return taken


def describe_people(everyone: people.ClipPeople, why: str, clip: Clip) -> str:
    """The log's line on several people: where each is, and who is kept."""
    kept = everyone.everyone.index(everyone.subject) + 1  # type: ignore[arg-type]
    listed = []
    for place, track in enumerate(everyone.everyone, 1):
        frames = list(track.people)
        across = np.median([one.shoulders[0] for one in track.people.values()]) / clip.width
        side = "left" if across < 1 / 3 else "middle" if across < 2 / 3 else "right"
        hung = ", hangs still" if people.hangs_still(track, everyone.everyone) else ""
        listed.append(f"{place} ({side}, frames {frames[0]} to {frames[-1]}{hung})")
    return (
        f"{clip.path.name}: {everyone.count} people at once: {', '.join(listed)}: number {kept} is kept, "
        f"{why}; ingest.person=NUMBER chooses another"
    )


def expected_frames(clip: Clip, settings: IngestSettings) -> int:
    """How many frames will be looked at; 0 where the source does not say."""
    stride, limit = settings.stride, settings.max_frames
    total = -(-clip.expected // stride)
    return min(total, limit) if limit else total
