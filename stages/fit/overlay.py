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
from pipeline.pictures import contact_sheet, padded, resized, side_by_side

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
    """Every frame of the clip with the mesh over it: [H, W, 3] uint8 RGB each, all of one size.

    Cameras of one rig may differ in size: smaller pictures lie in the upper left of the largest's.

    Args:
        frames: the folder of the clip's pictures.
        opacity: of the mesh, 0 to 1.
    """
    width = max(cameras[frame].width for frame in poses.frames)
    height = max(cameras[frame].height for frame in poses.frames)
    for frame in poses.frames:
        with torch.no_grad():
            vertices = posed_vertices(body, identity, poses.pose(frame))
        drawn = draw_mesh(read_frame(frames, frame), cameras[frame], vertices, body.faces, opacity=opacity)
        yield padded(drawn, width, height)


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
        drawn: row -> overlay, of at least the frame's size.
    """
    tiles = []
    for row in sorted(drawn):
        number = poses.frames[row]
        frame = read_frame(frames, number)
        height, width = frame.shape[:2]
        tiles.append(sheet_tile(frame, read_mask(masks, number), drawn[row][:height, :width]))
    return contact_sheet(tiles, columns=2)
