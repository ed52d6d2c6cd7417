"""The fitted mesh drawn over the frames, to be judged by eye."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import cv2
import numpy as np
import torch

from pipeline.body import BodyModel, Identity, Poses, draw_mesh, posed_vertices
from pipeline.camera import Camera
from pipeline.frames import read_frame, read_mask

_EDGE = (255, 210, 0)  # RGB of the mask's outline


def overlays(
    body: BodyModel,
    identity: Identity,
    poses: Poses,
    cameras: Mapping[int, Camera],
    frames: Path,
    opacity: float,
) -> Iterator[np.ndarray]:
    """Every frame of the clip with the mesh over it: [H, W, 3] uint8 RGB each.

    Args:
        body: the body.
        identity: who.
        poses: the T poses.
        cameras: frame number -> camera.
        frames: the folder of the clip's pictures.
        opacity: of the mesh, 0 to 1.
    """
    for frame in poses.frames:
        with torch.no_grad():
            vertices = posed_vertices(body, identity, poses.pose(frame))
        yield draw_mesh(read_frame(frames, frame), cameras[frame], vertices, body.faces, opacity=opacity)


def sheet_rows(count: int, wanted: int = 6) -> list[int]:
    """Rows spread evenly over ``count``, the first and the last among them."""
    return sorted({round(k * (count - 1) / max(wanted - 1, 1)) for k in range(wanted)})


def sheet_tile(frame: np.ndarray, mask: np.ndarray, drawn: np.ndarray, height: int = 360) -> np.ndarray:
    """A frame beside its overlay, the mask's outline on both: [height, W, 3] uint8.

    Args:
        frame, drawn: [H, W, 3] uint8 RGB.
        mask: [H, W] uint8.
        height: pixels.
    """
    contours, _ = cv2.findContours((mask > 127).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    pair = [cv2.drawContours(picture.copy(), contours, -1, _EDGE, 1) for picture in (frame, drawn)]
    both = np.concatenate(pair, axis=1)
    width = round(both.shape[1] * height / both.shape[0])
    method = cv2.INTER_AREA if height < both.shape[0] else cv2.INTER_LINEAR
    return cv2.resize(both, (width, height), interpolation=method)


def contact_sheet(tiles: list[np.ndarray], columns: int = 2) -> np.ndarray:
    """Tiles of one height in a grid, the last row filled with black."""
    blank = np.zeros_like(tiles[0])
    width = tiles[0].shape[1]
    padded = [cv2.resize(tile, (width, len(tile))) if tile.shape[1] != width else tile for tile in tiles]
    padded += [blank] * (-len(tiles) % columns)
    rows = [np.concatenate(padded[k : k + columns], axis=1) for k in range(0, len(padded), columns)]
    return np.concatenate(rows, axis=0)


def sheet(frames: Path, masks: Path, poses: Poses, drawn: Mapping[int, np.ndarray]) -> np.ndarray:
    """The contact sheet of some overlays.

    Args:
        frames, masks: folders of the clip's pictures.
        poses: the T poses.
        drawn: row -> overlay.
    """
    tiles = []
    for row in sorted(drawn):
        number = poses.frames[row]
        tiles.append(sheet_tile(read_frame(frames, number), read_mask(masks, number), drawn[row]))
    return contact_sheet(tiles)
