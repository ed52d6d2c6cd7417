"""A clip in the folders of ingest, fit and plan, as those stages publish it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from pipeline.body import BodyModel, Identity, Poses, write_identity, write_poses
from pipeline.clip.camera import Camera
from pipeline.clip.fit_quality import write_fit_quality
from pipeline.clip.frames import write_frame, write_mask
from pipeline.clip.keypoints import Keypoints, write_keypoints
from pipeline.clip.plan import Plan, write_plan
from pipeline.clip.records import Footage, Split, write_cameras, write_footage, write_split
from tests.made.fit_quality import good_fit
from tests.made.plans import plan_of


def simple_footage(width: int, height: int, fps: float, count: int, start: float = 0.0) -> Footage:
    """The record of a clip of which every frame was kept; its clock starts at ``start`` seconds."""
    seconds = tuple(start + row / fps for row in range(count))
    return Footage("made", width, height, fps, 1.0, count, count, {}, 1, seconds, {})


def publish(
    folder: Path,
    pictures: Iterable[tuple[np.ndarray, np.ndarray]],
    cameras: Mapping[int, Camera],
    fit: tuple[BodyModel, Identity, Poses],
    footage: Footage,
    split: Split | None = None,
    keypoints: Keypoints | None = None,
    plan: Plan | None = None,
) -> dict[str, Path]:
    """Writes ``ingest``, ``fit`` and ``plan`` under ``folder``: stage -> its folder.

    Args:
        folder: is made.
        pictures: frame [H, W, 3] and mask [H, W], uint8, of each of the poses' frames.
        cameras, footage, keypoints: what ingest publishes; no keypoints, no file.
        fit: the body, the person on it, and the poses, frame by frame.
        split: the last frame is held out by default.
        plan: everything on by default.
    """
    inputs = {name: folder / name for name in ("ingest", "fit", "plan")}
    ingest = inputs["ingest"]
    for made in (ingest / "frames", ingest / "masks", inputs["fit"], inputs["plan"]):
        made.mkdir(parents=True)
    body, identity, poses = fit
    for frame, (image, mask) in zip(poses.frames, pictures, strict=True):
        write_frame(ingest / "frames", frame, image)
        write_mask(ingest / "masks", frame, mask)
    write_cameras(ingest / "cameras.parquet", dict(cameras))
    write_footage(ingest / "footage.json", footage)
    write_split(ingest / "split.json", split or Split(poses.frames[:-1], poses.frames[-1:]))
    if keypoints is not None:
        write_keypoints(ingest / "keypoints.parquet", keypoints)
    write_identity(inputs["fit"] / "identity.safetensors", identity, body)
    write_poses(inputs["fit"] / "poses.parquet", poses)
    write_fit_quality(inputs["fit"], good_fit(poses.frames))
    write_plan(inputs["plan"] / "plan.json", plan or plan_of())
    return inputs
