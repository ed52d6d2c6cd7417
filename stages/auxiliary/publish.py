"""Publishing the frames for training: cropped, with masks, trust, cameras, poses, and the counts."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch

from pipeline.body import posed_vertices, write_poses
from pipeline.clip.camera import Camera
from pipeline.clip.composite import composite
from pipeline.clip.fitted_clip import FittedClip
from pipeline.clip.frames import read_frame, read_mask, spread_from_start, write_frame, write_mask, write_png
from pipeline.clip.keypoints import empty_keypoints, write_keypoints
from pipeline.clip.records import write_cameras
from pipeline.files.json_files import write_json
from pipeline.pictures import side_by_side
from pipeline.texture import FineSurface
from stages.auxiliary.crop import Framing, crop, pixel_map
from stages.auxiliary.filter_frames import FilteredFrames
from stages.auxiliary.turntable_motion import ID_OFFSET

if TYPE_CHECKING:
    from pipeline.run.stage import Context

NOTHING_NEW = "shows nothing that the clip does not"
OUT_OF_FRAME = "shows nothing of what the clip frames"
LEAST_NEWS = 0.05  # of the person's pixels; a frame with less teaches nothing
_SHEET, _TILE = 8, 256  # frames of the contact sheet, and pixels of their height


def publish(
    context: Context,
    clip: FittedClip,
    accepted: FilteredFrames,
    framing: Framing,
    surface: FineSurface,
    known: np.ndarray,  # [N]
) -> None:
    """Crop the accepted frames to the clip's framing and write them.

    Args:
        known: of its vertices, whether the clip shows it.
    """
    settings, output = context.settings, context.output
    for kind in ("frames", "masks", "trust"):
        (output / kind).mkdir()
    carried = torch.cat(
        [torch.from_numpy(1 - known.astype(np.float32))[:, None], surface.refine(framing.shown[:, None])],
        dim=1,
    )
    cameras: dict[int, Camera] = {}
    refused, sheet = dict(accepted.refused), []
    with context.progress(len(accepted.poses), "crops") as progress:
        for frame in accepted.poses.frames:
            image = read_frame(accepted.folder / "frames", frame)
            mask = read_mask(accepted.folder / "masks", frame)
            vertices = posed_vertices(clip.body, clip.identity, accepted.poses.pose(frame))
            made = crop(image, mask, accepted.cameras[frame], vertices, surface, carried, framing)
            reason = OUT_OF_FRAME if made is None else NOTHING_NEW if made.news < LEAST_NEWS else None
            if reason == NOTHING_NEW and not settings.unseen_only:
                reason = None
            if made is None or reason is not None:
                refused[str(reason)] = refused.get(str(reason), 0) + 1
            else:
                trust = made.trust if settings.unseen_only else np.full_like(made.trust, 255)
                write_frame(output / "frames", ID_OFFSET + frame, made.image)
                write_mask(output / "masks", ID_OFFSET + frame, made.mask)
                write_mask(output / "trust", ID_OFFSET + frame, trust)
                cameras[frame] = made.camera
                sheet.append(tile(made.image, made.mask, trust))
            progress.advance()
    write_records(context, accepted, cameras, refused)
    if sheet:
        write_png(output / "preview.png", side_by_side(spread_from_start(sheet, _SHEET)))


def write_records(
    context: Context, accepted: FilteredFrames, cameras: dict[int, Camera], refused: dict[str, int]
) -> None:
    """Write cameras, poses, keypoints and ``auxiliary.json`` of the frames that have a camera."""
    output, frames = context.output, sorted(cameras)
    numbers = tuple(ID_OFFSET + frame for frame in frames)
    poses = dataclasses.replace(accepted.poses.select(frames), frames=numbers)
    write_poses(output / "poses.parquet", poses)
    write_cameras(output / "cameras.parquet", {ID_OFFSET + frame: cameras[frame] for frame in frames})
    table = empty_keypoints(np.array(numbers, np.int64))
    for row, frame in enumerate(frames):
        points = accepted.keypoints[accepted.poses.index(frame)]
        table.whole_body[row] = moved(points, accepted.cameras[frame], cameras[frame])
    write_keypoints(output / "keypoints.parquet", table)
    distances = [value for frame in frames if (value := accepted.identity.get(frame)) is not None]
    write_json(
        output / "auxiliary.json",
        {
            "generator": context.settings.generator,
            "offered": accepted.offered,
            "kept": len(frames),
            "refused": dict(sorted(refused.items())),
            "identity_distance": round(float(np.median(distances)), 4) if distances else None,
            "notes": list(accepted.notes),
        },
    )
    counted = ", ".join(f"{count} {reason}" for reason, count in sorted(refused.items()))
    context.log(
        f"{len(frames)} of {accepted.offered} frames kept" + (f"; refused: {counted}" if counted else "")
    )
    if not frames:
        context.log("no generated view is learnt from; auxiliary.check=false takes them without these checks")


def moved(points: np.ndarray, source: Camera, target: Camera) -> np.ndarray:
    """Keypoints [133, 3] of a picture in a crop of it, those outside with score 0."""
    scale, shift = pixel_map(source, target)
    placed = points.copy()
    placed[:, :2] = points[:, :2] * scale + shift
    inside = (placed[:, :2] >= 0).all(1) & (placed[:, 0] < target.width) & (placed[:, 1] < target.height)
    placed[:, 2] *= inside
    placed[placed[:, 2] <= 0] = 0
    return placed


def tile(image: np.ndarray, mask: np.ndarray, trust: np.ndarray) -> np.ndarray:
    """A frame for the contact sheet: the person on grey, and below it what is learnt from it."""
    person = composite(image, mask / np.float32(255), 208.0)
    learnt = person * (0.25 + 0.75 * trust[..., None] / np.float32(255))
    both = np.concatenate([person, learnt]).astype(np.uint8)
    scale = 2 * _TILE / both.shape[0]
    return cv2.resize(both, (max(1, round(both.shape[1] * scale)), 2 * _TILE), interpolation=cv2.INTER_AREA)
