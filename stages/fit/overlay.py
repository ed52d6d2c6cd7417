"""The fitted mesh drawn over the frames, to be judged by eye."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import cv2
import numpy as np
import torch

from pipeline.body import BodyModel, Identity, Poses, draw_mesh, posed_vertices
from pipeline.clip.camera import Camera
from pipeline.clip.frames import read_frame, read_mask
from pipeline.pictures import contact_sheet, resized, side_by_side

SHEET_FRAMES = 6
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
        frames: the folder of the clip's pictures.
        opacity: of the mesh, 0 to 1.
    """
    for frame in poses.frames:
        with torch.no_grad():
            vertices = posed_vertices(body, identity, poses.pose(frame))
        yield draw_mesh(read_frame(frames, frame), cameras[frame], vertices, body.faces, opacity=opacity)


def sheet_tile(frame: np.ndarray, mask: np.ndarray, drawn: np.ndarray, height: int = 360) -> np.ndarray:
    """A frame beside its overlay, the mask's outline on both: [height, W, 3] uint8.

    Args:
        frame, drawn: [H, W, 3] uint8 RGB.
        mask: [H, W] uint8.
        height: pixels.
    """
    contours, _ = cv2.findContours((mask > 127).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    pair = [cv2.drawContours(picture.copy(), contours, -1, _EDGE, 1) for picture in (frame, drawn)]
    return resized(side_by_side(pair), height, cv2.INTER_LINEAR)


def sheet(frames: Path, masks: Path, poses: Poses, drawn: Mapping[int, np.ndarray]) -> np.ndarray:
    """The contact sheet of some overlays, two in a row, each beside its frame.

    Args:
        frames, masks: folders of the clip's pictures.
        drawn: row -> overlay.
    """
    tiles = []
    for row in sorted(drawn):
        number = poses.frames[row]
        tiles.append(sheet_tile(read_frame(frames, number), read_mask(masks, number), drawn[row]))
    width = tiles[0].shape[1]  # cameras of one rig may differ in size
    tiles = [cv2.resize(one, (width, len(one))) if one.shape[1] != width else one for one in tiles]
    return contact_sheet(tiles, columns=2)
