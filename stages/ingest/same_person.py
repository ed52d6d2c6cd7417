"""The same person in another camera of a rig: by where lines of sight meet, else by the clothes' colours."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from stages.ingest.cameras.calibration import EVERY_FRAME, CalibratedCamera, Calibration
from stages.ingest.people import Track, color_overlap
from stages.ingest.person_detector import Person

LEAST_COMMON = 2  # frames in which both cameras see somebody
SIZE = 0.2  # weight of the logarithm of two sizes of one person
CLEARLY = 0.5  # of the next best person's miss: closer than that decides by lines of sight alone


@dataclasses.dataclass(frozen=True)
class KnownPerson:
    """The subject as the first camera of a rig sees them.

    Attributes:
        track: in that camera.
        camera: which stands still; None where it is not known beforehand.
        first: the number of that camera's first frame; the cameras are synchronised.
    """

    track: Track
    camera: CalibratedCamera | None
    first: int

    def among(self, people: Sequence[Track], camera: CalibratedCamera | None, first: int) -> Track:
        """The one of some people in another camera, of which there is one at least.

        Args:
            people: their tracks.
            camera: the other camera, where it is known.
            first: the number of its first frame.
        """
        if self.camera is not None and camera is not None:
            misses = [self.miss(track, camera, first) for track in people]
            order = np.argsort(misses)
            if len(people) == 1 or misses[order[0]] < CLEARLY * misses[order[1]]:
                return people[int(order[0])]
        return max(people, key=self.likeness)

    def miss(self, track: Track, camera: CalibratedCamera, first: int) -> float:
        """The median of ``sight_miss`` over the frames of both cameras; infinite where there are too few."""
        assert self.camera is not None
        shared = {frame - first for frame in track.people} & {one - self.first for one in self.track.people}
        if len(shared) < LEAST_COMMON:
            return float("inf")
        pairs = [(self.track.people[self.first + one], track.people[first + one]) for one in sorted(shared)]
        return float(np.median([sight_miss(self.camera, mine, camera, theirs) for mine, theirs in pairs]))

    def likeness(self, track: Track) -> float:
        """The overlap of the clothes' colours; 0 where they are not known."""
        mine, theirs = self.track.colors, track.colors
        return 0.0 if mine is None or theirs is None else color_overlap(mine, theirs)


def still_camera(calibration: Calibration | None) -> CalibratedCamera | None:
    """The camera of a calibration that stands still; None for any other."""
    return None if calibration is None else calibration.views.get(EVERY_FRAME)


def sight_miss(
    first: CalibratedCamera, first_person: Person, second: CalibratedCamera, second_person: Person
) -> float:
    """How far two detections are from being one person's, 0 for one person.

    Lines of sight to the shoulders miss each other; and where they meet all the same, as those of cameras at
    one height do, the person would be of two sizes.
    """
    lengths, miss = rays_meet(first, first_person.shoulders, second, second_person.shoulders)
    if not np.isfinite(miss):
        return miss
    focal = (first.lens.mean_focal_length(), second.lens.mean_focal_length())
    people = (first_person, second_person)
    sizes = [one.radius * length / f for one, length, f in zip(people, lengths, focal, strict=True)]
    return miss + SIZE * abs(float(np.log(max(sizes[0], 1e-6) / max(sizes[1], 1e-6))))


def rays_meet(
    first: CalibratedCamera, first_pixel: np.ndarray, second: CalibratedCamera, second_pixel: np.ndarray
) -> tuple[tuple[float, float], float]:
    """Where two lines of sight pass each other.

    Args:
        first, second: cameras in one world.
        first_pixel, second_pixel: [2], pixels.

    Returns:
        How far from either camera that is, and the distance at which they pass over their mean: 0 where
        they meet; infinite where they do so behind a camera, or hardly cross.
    """
    centres, rays = [], []
    for camera, pixel in ((first, first_pixel), (second, second_pixel)):
        flat = np.asarray(camera.lens.cam_from_img(np.asarray(pixel, np.float64))).reshape(2)
        ray = camera.rotation.T @ np.array([*flat, 1.0])
        centres.append(-camera.rotation.T @ camera.translation)
        rays.append(ray / np.linalg.norm(ray))
    between, cosine = centres[1] - centres[0], float(rays[0] @ rays[1])
    if 1 - cosine**2 < 1e-6:
        return (0.0, 0.0), float("inf")
    along = np.linalg.solve([[1, -cosine], [cosine, -1]], [rays[0] @ between, rays[1] @ between])
    if min(along) <= 0:
        return (0.0, 0.0), float("inf")
    ends = [centre + length * ray for centre, length, ray in zip(centres, along, rays, strict=True)]
    return (float(along[0]), float(along[1])), float(np.linalg.norm(ends[1] - ends[0]) / np.mean(along))
