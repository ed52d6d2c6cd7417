"""The people in a clip, each followed through it, and the one that is kept.

Detections in some frames are linked into tracks by place, size and the colours of the torso; tracks that are
never seen at once and look the same are one person, lost and found again. The subject is whoever fills most
of the clip (size times centrality, added up) and moves: a picture on a wall does not change, and is passed
over where somebody else does. ``ingest.person`` names another.

Where others stand beside the subject, the picture is divided between the people, and the estimator is shown
the subject's part only.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from pipeline.errors import UserError
from stages.ingest.person_detector import Person

REACH = 0.6  # how far a person may move between two searches, in torso lengths
GROWTH = 2.0  # and grow or shrink
PERSISTENT = 0.2  # a track seen in a smaller part of the searches is a false alarm
LOST = 4  # searches after which a track ends
ALIKE, STRANGE = 0.78, 0.35  # overlap of colours from which two are one person, and under which they are not
STILL, LIVELY = 1.5, 3.0  # grey levels under which a picture hangs still; times that by which another moves
_PICTURE = 0.02  # weight of a picture on a wall


@dataclasses.dataclass
class Track:
    """One person's detections, frame number -> detection, in order."""

    people: dict[int, Person]

    def at(self, frame: int) -> Person:
        """The detection, interpolated between the two nearest in time; the nearest at either end."""
        frames = list(self.people)
        after = int(np.searchsorted(frames, frame))
        if after == 0 or after == len(frames) or frames[after] == frame:
            return self.people[frames[min(after, len(frames) - 1)]]
        first, second = self.people[frames[after - 1]], self.people[frames[after]]
        share = (frame - frames[after - 1]) / (frames[after] - frames[after - 1])
        between = {
            name: (1 - share) * getattr(first, name) + share * getattr(second, name)
            for name in ("hips", "shoulders", "radius")
        }
        return dataclasses.replace(first, **between)

    def away(self, frame: int) -> int:
        """How many frames lie between a frame and the nearest detection."""
        return min(abs(frame - other) for other in self.people)

    @property
    def colors(self) -> np.ndarray | None:
        """The mean colours of the detections that have them."""
        known = [one.colors for one in self.people.values() if one.colors is not None]
        return np.mean(known, axis=0) if known else None

    @property
    def change(self) -> float | None:
        """The median change of the person's part of the picture; None where nobody looked."""
        known = [one.change for one in self.people.values() if one.change is not None]
        return float(np.median(known)) if known else None


@dataclasses.dataclass(frozen=True)
class ClipPeople:
    """Everyone in a clip.

    Attributes:
        subject: the kept person's track; None where nobody was found.
        others: the tracks of the rest.
        count: how many people there are at once, at most.
        step: frames from one search to the next.
        everyone: all people by prominence, the first is number 1 of ``ingest.person``.
        peopled: the frames in which anybody was detected.
    """

    subject: Track | None
    others: tuple[Track, ...]
    count: int
    step: int = 1
    everyone: tuple[Track, ...] = ()
    peopled: frozenset[int] = frozenset()

    def absent(self, frame: int) -> bool:
        """True where somebody else than the subject is seen about a frame, in a clip of several people."""
        if self.subject is None or not self.others or self.subject.away(frame) <= 2 * self.step:
            return False
        return any(abs(frame - other) <= self.step for other in self.peopled)


def track_people(
    found: Sequence[tuple[int, list[Person]]],
    width: int,
    height: int,
    number: int = 0,
    name: str = "the clip",
    choose: Callable[[Sequence[Track]], Track] | None = None,
) -> ClipPeople:
    """The tracks of all people, and which of them is the subject's.

    Args:
        found: (frame number, the people detected in it), in order.
        width, height: the picture's size in pixels.
        number: of the person who is meant, counted from 1 by prominence; 0 for the first.
        name: of the clip, for messages.
        choose: picks the subject among the people, where no number does; the most prominent by default.

    Raises:
        UserError: there is no person of that number.
    """
    least = max(2, round(PERSISTENT * len(found))) if len(found) > 2 else 1
    tracks = [track for track in link_detections(found) if len(track.people) >= min(2, least)]
    people = [track for track in joined(tracks) if len(track.people) >= least]
    if number > len(people):
        shown = f"{len(people)} people" if len(people) != 1 else "1 person"
        raise UserError(f"{name} shows {shown}: lower ingest.person={number}, which is none of them")
    if not people:
        return ClipPeople(None, (), 0)
    everyone = by_prominence(people, width, height)
    subject = choose(everyone) if choose is not None and not number else everyone[max(number - 1, 0)]
    count = max(sum(frame in track.people for track in people) for frame, _ in found)
    others = tuple(track for track in everyone if track is not subject)
    frames = [frame for frame, _ in found]
    step = round(float(np.median(np.diff(frames)))) if len(frames) > 1 else 1
    peopled = frozenset(frame for frame, seen in found if seen)
    return ClipPeople(subject, others, max(count, 1), step, tuple(everyone), peopled)


def by_prominence(people: Sequence[Track], width: int, height: int) -> list[Track]:
    """People by size times centrality, added up over the clip; pictures on walls come last."""

    def weight(track: Track) -> float:
        total = sum(prominence(one, width, height) for one in track.people.values())
        return total * (_PICTURE if hangs_still(track, people) else 1.0)

    return sorted(people, key=weight, reverse=True)


def hangs_still(track: Track, people: Sequence[Track]) -> bool:
    """True for a picture on a wall: it hardly changes, and somebody else in the clip changes much more."""
    changes = [one.change for one in people if one.change is not None]
    return track.change is not None and track.change < min(STILL, max(changes) / LIVELY)


def link_detections(found: Sequence[tuple[int, list[Person]]]) -> list[Track]:
    """Tracks of detections that follow one another closely, the nearest and most alike pairs first."""
    tracks: list[Track] = []
    last_seen: list[int] = []
    for search, (frame, people) in enumerate(found):
        last = [track.people[next(reversed(track.people))] for track in tracks]
        pairs = sorted(
            (_apart(before, now), row, column)
            for row, before in enumerate(last)
            for column, now in enumerate(people)
            if search - last_seen[row] <= LOST and _follows(before, now)
        )
        free = set(range(len(people)))
        taken: set[int] = set()
        for _, row, column in pairs:
            if row not in taken and column in free:
                tracks[row].people[frame] = people[column]
                last_seen[row] = search
                taken.add(row)
                free.discard(column)
        tracks.extend(Track({frame: people[column]}) for column in sorted(free))
        last_seen.extend(search for _ in free)
    return tracks


def joined(tracks: Sequence[Track]) -> list[Track]:
    """The tracks with those made one that look alike and are never seen at once, the longest first."""
    people: list[Track] = []
    for track in sorted(tracks, key=lambda one: -len(one.people)):
        alike = [(likeness(one, track), row) for row, one in enumerate(people)]
        alike = [(value, row) for value, row in alike if value >= ALIKE and not shared(people[row], track)]
        if alike:
            row = max(alike)[1]
            people[row] = Track(dict(sorted({**people[row].people, **track.people}.items())))
        else:
            people.append(track)
    return people


def shared(first: Track, second: Track) -> bool:
    """True where two tracks have a frame in common."""
    return not first.people.keys().isdisjoint(second.people)


def likeness(first: Track, second: Track) -> float:
    """The overlap of two tracks' colours, in [0, 1]; 1 where nothing is known of one of them.

    Tracks of which one begins where the other ends are alike unless their colours are quite others.
    """
    one, other = first.colors, second.colors
    if one is None or other is None:
        return 1.0
    overlap = color_overlap(one, other)
    return max(overlap, ALIKE) if overlap >= STRANGE and _continues(first, second) else overlap


def color_overlap(first: np.ndarray, second: np.ndarray) -> float:
    """Bhattacharyya's coefficient of two histograms that add up to 1: 1 for equal ones, 0 for disjoint."""
    return float(np.sqrt(first * second).sum())


def prominence(person: Person, width: int, height: int) -> float:
    """Size times centrality: the radius, halved for a person in the picture's corner."""
    centre = np.array([width, height]) / 2
    place = np.clip(person.shoulders, 0, [width, height])
    return person.radius * (1 - 0.5 * float(np.linalg.norm(place - centre) / np.linalg.norm(centre)))


def subject_region(frame: int, people: ClipPeople, width: int, height: int) -> np.ndarray | None:
    """The subject's part of the picture, [H, W] bool; None where nobody else is about.

    A pixel belongs to the person whose axis (hips to head) is nearest, measured in that person's size.
    """
    others = [track.at(frame) for track in people.others if min(track.people) <= frame <= max(track.people)]
    if people.subject is None or not others:
        return None
    mine = _distance(people.subject.at(frame), width, height)
    return np.all([mine <= _distance(other, width, height) for other in others], axis=0)


def hide_others(image: np.ndarray, own: np.ndarray | None) -> np.ndarray:
    """``image`` with everything outside the subject's part painted in its mean colour."""
    if own is None:
        return image
    shown = image.copy()
    shown[~own] = image.reshape(-1, 3).mean(0).astype(np.uint8)
    return shown


def _continues(first: Track, second: Track) -> bool:
    """True where one track ends near in place to where the other begins."""
    early, late = sorted((first, second), key=lambda track: min(track.people))
    end, start = early.people[max(early.people)], late.people[min(late.people)]
    return max(early.people) < min(late.people) and _follows(end, start)


def _apart(before: Person, now: Person) -> float:
    """The distance of two detections in the first one's size, and of their colours where both are known."""
    away = float(np.linalg.norm(before.shoulders - now.shoulders)) / max(before.radius, 1e-6)
    if before.colors is None or now.colors is None:
        return away
    return away + 1 - color_overlap(before.colors, now.colors)


def _follows(before: Person, now: Person) -> bool:
    if before.colors is not None and now.colors is not None:
        if color_overlap(before.colors, now.colors) < STRANGE:
            return False
    growth = now.radius / max(before.radius, 1e-6)
    near = float(np.linalg.norm(before.shoulders - now.shoulders)) < REACH * before.radius
    return near and 1 / GROWTH < growth < GROWTH


def _distance(person: Person, width: int, height: int) -> np.ndarray:
    """From each pixel to the person's axis, in the person's own size, [H, W]."""
    y, x = np.mgrid[0:height, 0:width].astype(np.float32) + 0.5
    head = person.shoulders + 0.5 * (person.shoulders - person.hips)
    axis = head - person.hips
    along = ((x - person.hips[0]) * axis[0] + (y - person.hips[1]) * axis[1]) / max(float(axis @ axis), 1e-6)
    along = np.clip(along, 0, 1)
    across = np.hypot(x - person.hips[0] - along * axis[0], y - person.hips[1] - along * axis[1])
    return across / max(person.radius, 1e-6)
