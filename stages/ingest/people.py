"""The people in a clip, and the one that is kept: the largest and most central person.

Detections in some frames are linked into tracks; the track with the greatest sum of size times centrality
is the subject's. Where others stand beside the subject, the picture is divided between the people, and the
estimator is shown the subject's part only. The detector overlooks people who are small in the picture; the
estimator does not mistake them for the subject either.
"""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeline.detection.mediapipe import BLANK, load_mediapipe, native_errors_to

_GRAPH = """
input_stream: "image"
output_stream: "detections"
node { calculator: "PoseDetectionCpu" input_stream: "IMAGE:image" output_stream: "DETECTIONS:detections" }
"""
REACH = 0.6  # how far a person may move between two searches, in torso lengths
GROWTH = 2.0  # and grow or shrink
PERSISTENT = 0.2  # a track seen in a smaller part of the searches is a false alarm


@dataclasses.dataclass(frozen=True)
class Person:
    """One detection, in pixels.

    Attributes:
        hips: [2], the middle of the hips; may lie outside the picture.
        shoulders: [2], the middle of the shoulders.
        radius: of the circle about the hips that holds the whole body.
        score: in [0, 1].
    """

    hips: np.ndarray
    shoulders: np.ndarray
    radius: float
    score: float


class PersonDetector:
    """MediaPipe's person detector, which finds every person in a picture and follows nobody."""

    def __init__(self, asset: Path, native_log: Path) -> None:
        """Load it; arguments and errors as those of :class:`pipeline.detection.mediapipe.Estimator`."""
        load_mediapipe(asset)
        self._native_log = native_log
        from google.protobuf import text_format

        base = importlib.import_module("mediapipe.python.solution_base")
        messages = importlib.import_module("mediapipe.framework.calculator_pb2")
        graph = text_format.Parse(_GRAPH, messages.CalculatorGraphConfig())
        with native_errors_to(native_log):
            self._graph = base.SolutionBase(graph_config=graph, outputs=["detections"])
            self._graph.process(BLANK)

    def detect(self, image: np.ndarray) -> list[Person]:
        """The people in ``image`` [H, W, 3] uint8 RGB; coordinates in its pixels."""
        height, width = image.shape[:2]
        with native_errors_to(self._native_log):
            found = self._graph.process(image).detections or []
        people = []
        for detection in found:
            points = [(p.x * width, p.y * height) for p in detection.location_data.relative_keypoints]
            hips, rim, shoulders = (np.array(point) for point in points[:3])
            radius = float(np.linalg.norm(rim - hips))
            people.append(Person(hips, shoulders, radius, float(detection.score[0])))
        return people


@dataclasses.dataclass
class Track:
    """One person's detections, frame number -> detection, in order."""

    people: dict[int, Person]

    def at(self, frame: int) -> Person:
        """The detection nearest in time."""
        return self.people[min(self.people, key=lambda other: (abs(other - frame), other))]


@dataclasses.dataclass(frozen=True)
class ClipPeople:
    """Everyone in a clip.

    Attributes:
        subject: the kept person's track; None where nobody was found.
        others: the tracks of the rest.
        count: how many people there are at once, at most.
    """

    subject: Track | None
    others: tuple[Track, ...]
    count: int


def track_people(found: Sequence[tuple[int, list[Person]]], width: int, height: int) -> ClipPeople:
    """The tracks of all people, and which of them is the subject's.

    Args:
        found: (frame number, the people detected in it), in order.
        width, height: the picture's size in pixels.
    """
    tracks = link_detections(found)
    least = max(2, round(PERSISTENT * len(found))) if len(found) > 2 else 1
    tracks = [track for track in tracks if len(track.people) >= least]
    if not tracks:
        return ClipPeople(None, (), 0)

    def weight(track: Track) -> float:
        return sum(prominence(one, width, height) for one in track.people.values())

    subject = max(tracks, key=weight)
    count = max(sum(frame in track.people for track in tracks) for frame, _ in found)
    # A track that never coincides with the subject's is the subject, lost and found again.
    others = [track for track in tracks if track is not subject and set(track.people) & set(subject.people)]
    return ClipPeople(subject, tuple(others), max(count, 1))


def link_detections(found: Sequence[tuple[int, list[Person]]]) -> list[Track]:
    """Tracks of detections that follow one another closely, the nearest pairs first."""
    tracks: list[Track] = []
    for frame, people in found:
        last = [track.people[next(reversed(track.people))] for track in tracks]
        pairs = sorted(
            (float(np.linalg.norm(before.shoulders - now.shoulders)), row, column)
            for row, before in enumerate(last)
            for column, now in enumerate(people)
            if _follows(before, now)
        )
        free = set(range(len(people)))
        taken: set[int] = set()
        for _, row, column in pairs:
            if row not in taken and column in free:
                tracks[row].people[frame] = people[column]
                taken.add(row)
                free.discard(column)
        tracks.extend(Track({frame: people[column]}) for column in sorted(free))
    return tracks


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


def _follows(before: Person, now: Person) -> bool:
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
