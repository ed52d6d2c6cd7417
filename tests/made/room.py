"""A room of textured boards filmed by a known camera, with a person-sized blob that moves by itself."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.clip.frames import write_frame, write_mask
from pipeline.clip.keypoints import Keypoints, empty_keypoints

WIDTH, HEIGHT, FOCAL = 320, 240, 384.0
MATRIX = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1.0]])
# Boards: corner, right and down edges in metres, OpenCV axes of a camera at the origin.
BOARDS = (
    ((-6.0, -4.0, 8.0), (12.0, 0.0, 0.0), (0.0, 8.0, 0.0)),
    ((-6.0, 1.6, 2.0), (12.0, 0.0, 0.0), (0.0, 0.0, 6.0)),
    ((-3.2, -1.6, 4.5), (1.6, 0.0, 0.5), (0.0, 2.6, 0.0)),
    ((1.2, -1.2, 5.0), (1.8, 0.0, -0.6), (0.0, 2.4, 0.0)),
)
PERSON = np.array([0.0, 0.2, 3.0])
POINTS = {11: (0.2, -0.45, 0), 12: (-0.2, -0.45, 0.05), 23: (0.15, 0.05, 0.02), 24: (-0.15, 0.05, 0)}


@dataclasses.dataclass(frozen=True)
class Path3D:
    """World-to-camera poses and where the person stands in the world, metres."""

    rotations: np.ndarray  # [T, 3, 3]
    translations: np.ndarray  # [T, 3]
    person: np.ndarray  # [T, 3]


def camera_path(count: int, sideways: float = 1.2, degrees: float = 10.0, person: float = 0.15) -> Path3D:
    """A camera that goes sideways and turns back towards the scene; with 0, 0 it stands still."""
    share = np.linspace(-0.5, 0.5, count)
    centres = np.stack([sideways * share, 0.08 * sideways * np.sin(6 * share), 0 * share], axis=1)
    turns = np.stack([2 * share * (degrees > 0), -degrees * share, 0 * share], axis=1)
    rotations = Rotation.from_euler("xyz", turns, degrees=True).as_matrix().transpose(0, 2, 1)
    places = PERSON + np.stack([person * np.sin(4 * np.pi * share), 0 * share, 0 * share], axis=1)
    return Path3D(rotations, -np.einsum("tij,tj->ti", rotations, centres), places)


def film(folder: Path, path: Path3D) -> None:
    """Write ``frames`` and ``masks`` into a folder."""
    textures = [_texture(seed) for seed in range(len(BOARDS))]
    for kind in ("frames", "masks"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    for row in range(len(path.rotations)):
        image = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
        for board, texture in zip(BOARDS, textures, strict=True):
            _draw(image, board, texture, path.rotations[row], path.translations[row])
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        place = path.rotations[row] @ path.person[row] + path.translations[row]
        middle = (MATRIX @ place)[:2] / place[2]
        size = (int(0.28 * FOCAL / place[2]), int(0.8 * FOCAL / place[2]))
        cv2.ellipse(mask, tuple(int(v) for v in middle), size, 0, 0, 360, 255, -1)
        stripes = 60 + 120 * ((np.arange(HEIGHT)[:, None] - int(3 * row)) // 6 % 2)
        image[mask > 0] = np.repeat(np.broadcast_to(stripes, mask.shape)[mask > 0][:, None], 3, axis=1)
        write_frame(folder / "frames", row, image)
        write_mask(folder / "masks", row, mask)


def person_keypoints(path: Path3D, noise: float = 0.0, seed: int = 0) -> Keypoints:
    """The trunk's points as the estimator gives them: in metres along the camera's axes, and in pixels."""
    rng = np.random.default_rng(seed)
    keypoints = empty_keypoints(np.arange(len(path.rotations)))
    for row, (rotation, translation) in enumerate(zip(path.rotations, path.translations, strict=True)):
        for point, offset in POINTS.items():
            there = rotation @ (path.person[row] + offset) + translation
            pixel = (MATRIX @ there)[:2] / there[2] + rng.normal(0, noise, 2)
            keypoints.pose_image[row, point] = (*pixel, 0, 1)
            keypoints.pose_world[row, point] = (*(rotation @ offset), 1)
    return keypoints


def rotation_error(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Degrees between camera rotations relative to the first frame's, [T]."""
    relative = [r @ r[0].T for r in (found, truth)]
    return np.degrees(Rotation.from_matrix(relative[0] @ relative[1].transpose(0, 2, 1)).magnitude())


def centres_in_first(rotations: np.ndarray, translations: np.ndarray) -> np.ndarray:
    """Camera centres in the first camera's axes, [T, 3]."""
    centres = -np.einsum("tji,tj->ti", rotations, translations)
    return (centres - centres[0]) @ rotations[0].T


def _texture(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    layers = [
        cv2.resize(rng.integers(0, 255, (side, side, 3)).astype(np.float32), (512, 512), interpolation=how)
        for side, how in ((24, cv2.INTER_NEAREST), (96, cv2.INTER_NEAREST), (12, cv2.INTER_LINEAR))
    ]
    return np.clip(0.5 * layers[0] + 0.3 * layers[1] + 0.3 * layers[2], 0, 255).astype(np.uint8)


def _draw(
    image: np.ndarray, board: tuple, texture: np.ndarray, rotation: np.ndarray, shift: np.ndarray
) -> None:
    corner, right, down = (np.array(part) for part in board)
    side = texture.shape[0]
    plane = np.stack([right / side, down / side, corner], axis=1)  # texture pixels -> world
    homography = MATRIX @ (rotation @ plane + np.outer(shift, [0, 0, 1]))
    # Only what lies before the camera; boards are cut there by their depth.
    drawn = cv2.warpPerspective(texture, homography, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR)
    covered = cv2.warpPerspective(np.full((side, side), 255, np.uint8), homography, (WIDTH, HEIGHT))
    image[covered > 127] = drawn[covered > 127]
