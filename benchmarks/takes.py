"""Clips of a mannequin that differ from one good take in one thing, as a person's own clips do.

The mannequin is filmed at a clock of 60 ticks a second, so that faster motion and a long shutter show
the same course of the same motion. What a camera does to pictures (noise, exposure, shake) is done to the
pixels.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping
from pathlib import Path

import cv2
import numpy as np

from pipeline.body import BodyModel, Landmarks
from pipeline.clip.camera import Camera
from pipeline.clip.frames import write_video
from stages.ingest.mannequin.footage import Filming
from stages.ingest.mannequin.framing import FOCAL
from stages.ingest.mannequin.scene import film, make_background
from stages.ingest.mannequin.spec import MannequinSpec

TICKS = 60  # a second
FPS = 10  # of the clips
FRAMING = "upper"
HANDS = "gesture+curl"
SWAY = f"sway+{HANDS}+speech"  # trunk and head turn to both sides, the hands gesture, the face speaks
OUTSIDE_SEED = 7  # of what a camera adds


@dataclasses.dataclass(frozen=True)
class Take:
    """How a clip is filmed.

    Attributes:
        motion: of the mannequin.
        seconds: the clip's length.
        seed: of motion, grain and room.
        away: times the distance of the good take.
        pace: times the speed of the motion.
        shutter: seconds that each picture is exposed.
        noise: of 255, standard deviation.
        drift: the exposure and the colour's warmth go up and down by this share.
        shake: pixels of 512 by which a held camera moves, at most.
        small_file: the clip is encoded at this share of its size and enlarged again, as messengers do.
        plain: the wall has the colour of the clothes.
    """

    motion: str = SWAY
    seconds: float = 6.0
    seed: int = 0
    away: float = 1.0
    pace: int = 1
    shutter: float = 0.0
    noise: float = 0.0
    drift: float = 0.0
    shake: float = 0.0
    small_file: float = 1.0
    plain: bool = False


GOOD = "good"
TAKES: Mapping[str, Take] = {
    GOOD: Take(),
    "again": Take(seed=3),
    "still": Take(motion=f"{HANDS}+speech"),
    "whole turn": Take(motion=f"turn+{HANDS}+speech"),
    "twice as far": Take(away=2.0),
    "four times as far": Take(away=4.0),
    "dim": Take(noise=8.0),
    "exposure drifts": Take(drift=0.2),
    "hands down": Take(motion="sway+speech"),
    "1 second": Take(seconds=1.0),
    "2 seconds": Take(seconds=2.0),
    "12 seconds": Take(seconds=12.0),
    "fast, sharp": Take(pace=3),
    "fast, blurred": Take(pace=3, shutter=1 / 30),
    "held in the hand": Take(shake=14.0),
    "wall like the clothes": Take(plain=True),
    "small file": Take(small_file=0.4),
}
"""Name -> take; ``again`` is the good one of another day, which shows how far chance goes."""


@dataclasses.dataclass(frozen=True)
class Clip:
    """A written clip.

    Attributes:
        path: the video.
        focal: the camera's focal length over the picture's side.
        picture: [H, W, 3] uint8, one of its frames.
    """

    path: Path
    focal: float
    picture: np.ndarray


def filming(take: Take, identity: int, size: int, body: BodyModel, landmarks: Landmarks) -> Filming:
    """The mannequin before the camera, a row a tick."""
    ticks = math.ceil((take.seconds + take.shutter) * TICKS * take.pace) + 1
    spec = MannequinSpec(
        framing=FRAMING, motion=take.motion, frames=max(ticks, 2), size=size, fps=float(TICKS),
        seed=take.seed, identity=identity,
    )  # fmt: skip
    return Filming(spec, body, landmarks)


def write_take(
    path: Path, take: Take, identity: int, size: int, body: BodyModel, landmarks: Landmarks
) -> Clip:
    """Films a take of a person into a video."""
    filmed = filming(take, identity, size, body, landmarks)
    focal = FOCAL[FRAMING] / take.away
    camera = seen_from(filmed.scene.shot.camera, take.away)
    room = make_background(camera, take.seed)
    first = film(filmed.scene, 0, camera, room)
    if take.plain:
        cloth = np.median(first.image[size // 2 :][first.mask[size // 2 :] > 250], axis=0)
        room = cloth.astype(np.float32) + 0.15 * (room - room.mean((0, 1)))

    def pictures() -> Iterator[np.ndarray]:
        for number in range(round(take.seconds * FPS)):
            ticks = exposed_ticks(take, number)
            exposed = [film(filmed.scene, tick, camera, room).image for tick in ticks]
            yield through_the_camera(np.mean(exposed, axis=0), take, number)

    shown = list(pictures())
    write_video(path, shown, FPS)
    return Clip(path, focal, shown[len(shown) // 2])


def exposed_ticks(take: Take, number: int) -> range:
    """The rows of the motion that one picture is exposed to."""
    start = round(number * TICKS * take.pace / FPS)
    return range(start, start + max(1, round(take.shutter * TICKS * take.pace)))


def seen_from(camera: Camera, away: float) -> Camera:
    """The camera with the person as small as at ``away`` times the distance, by a shorter lens."""
    intrinsics = camera.intrinsics.clone()
    intrinsics[:2, :2] /= away
    return dataclasses.replace(camera, intrinsics=intrinsics)


def _trembling(seconds: float) -> tuple[float, float]:
    """How far a held camera is aside and down, -1 to 1 each."""
    aside = 0.6 * math.sin(2.1 * seconds + 0.3) + 0.4 * math.sin(7.3 * seconds + 1.0)
    return aside, 0.6 * math.sin(1.7 * seconds + 2.0) + 0.4 * math.sin(6.1 * seconds + 0.2)


def through_the_camera(picture: np.ndarray, take: Take, number: int) -> np.ndarray:
    """A picture [H, W, 3] in 0 to 255 with what camera and file do to it: uint8."""
    height, width = picture.shape[:2]
    seconds = number / FPS
    rng = np.random.default_rng([OUTSIDE_SEED, take.seed, number])
    picture = picture.astype(np.float32)
    if take.shake:
        reach = take.shake * width / 512
        along, down = (reach * course for course in _trembling(seconds))
        matrix = np.array([[1, 0, along], [0, 1, down]], np.float32)
        picture = cv2.warpAffine(picture, matrix, (width, height), borderMode=cv2.BORDER_REFLECT)
    if take.drift:
        gain = 1 + take.drift * math.sin(2 * math.pi * seconds / 5)
        warmth = 0.5 * take.drift * math.sin(2 * math.pi * seconds / 3.3)
        picture = picture * gain * np.array([1 + warmth, 1, 1 - warmth], np.float32)
    if take.noise:  # phones smooth noise, which leaves it in blotches
        noise = rng.standard_normal(picture.shape, np.float32)
        picture = picture + take.noise * cv2.GaussianBlur(noise, (0, 0), 0.8) / 0.35
    if take.small_file < 1:
        small = (round(width * take.small_file), round(height * take.small_file))
        picture = cv2.resize(picture, small, interpolation=cv2.INTER_AREA)
        picture = cv2.imdecode(
            cv2.imencode(".jpg", np.clip(picture, 0, 255), [cv2.IMWRITE_JPEG_QUALITY, 30])[1], 1
        ).astype(np.float32)
        picture = cv2.resize(picture, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.clip(np.round(picture), 0, 255).astype(np.uint8)
