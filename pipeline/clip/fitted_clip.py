"""The fitted clip: what ingest and fit published, read and checked in one place.

Cameras, split, body, identity and poses are read at once. Footage and keypoints are read when they are
first asked for, because not every stage declares that it reads them; pictures are read each time.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from pipeline.body import (
    BodyModel,
    Identity,
    Pose,
    Poses,
    load_body,
    posed_vertices,
    read_identity,
    read_poses,
)
from pipeline.clip.boxes import Box, clip_box
from pipeline.clip.camera import Camera
from pipeline.clip.fit_quality import FIT_QUALITY, FitQuality, read_fit_quality
from pipeline.clip.foreground import read_person
from pipeline.clip.frames import read_frame, read_mask, spread_from_start
from pipeline.clip.keypoints import Keypoints, read_keypoints
from pipeline.clip.records import Footage, Split, read_cameras, read_footage, read_split
from pipeline.clip.views import View, ViewCache, cropped
from pipeline.errors import UserError


@dataclasses.dataclass(frozen=True)
class FittedClip:
    """A clip and the person that was fitted to it. Frames go by their numbers in the source.

    Attributes:
        folder: what ingest published.
        split: the frames to learn from and those held out that the fit accepts; each has a pose and a camera.
        cameras: of every kept frame.
        body: the body model.
        identity: who the person is to it.
        poses: the fit's, of every kept frame; in the world of the cameras.
        quality: how well the fit says that it is on the person, of every kept frame.
    """

    folder: Path
    split: Split
    cameras: Mapping[int, Camera]
    body: BodyModel
    identity: Identity
    poses: Poses
    quality: FitQuality

    @cached_property
    def footage(self) -> Footage:
        """The source and what was kept of it; UserError where its record is missing or damaged."""
        return read_footage(self.folder / "footage.json")

    @cached_property
    def keypoints(self) -> Keypoints:
        """The detections of every kept frame; UserError where their table is missing or damaged."""
        return read_keypoints(self.folder / "keypoints.parquet")

    @cached_property
    def seconds(self) -> Mapping[int, float]:
        """Frame number -> seconds from the clip's start; a frame without a clock is not in it."""
        return dict(zip(sorted(self.cameras), self.footage.seconds, strict=False))

    def frame(self, frame: int) -> np.ndarray:
        """A frame as it was filmed, [H, W, 3] uint8 RGB."""
        return read_frame(self.folder / "frames", frame)

    def colors(self, frame: int) -> np.ndarray:
        """A frame with the person's own colours in the mask's soft edge, [H, W, 3] uint8 RGB."""
        return read_person(self.folder, frame)[0]

    def mask(self, frame: int) -> np.ndarray:
        """The person's soft alpha in a frame, [H, W] uint8."""
        return read_mask(self.folder / "masks", frame)

    def camera(self, frame: int, box: Box | None = None) -> Camera:
        """The camera of a frame, or of a box of it."""
        return cropped(self.cameras[frame], box)

    def view(self, frame: int, box: Box | None = None) -> View:
        """A frame, or a box of it, as tensors with its camera."""
        return self.cached_views(box)[frame]

    def cached_views(self, box: Box | None = None) -> ViewCache:
        """All frames, or a box of each, kept in memory once they were read."""
        return ViewCache(self.folder, self.cameras, box)

    def pose(self, frame: int) -> Pose:
        """The body's pose in a frame; ValueError where the fit has none."""
        return self.poses.pose(frame)

    def vertices(self, frame: int) -> Tensor:
        """The fitted body in a frame: [V, 3], metres, in the world."""
        return posed_vertices(self.body, self.identity, self.pose(frame))

    def person_box(self, margin: int) -> Box:
        """The box that holds the person in all training frames, and a margin in pixels around it."""
        return clip_box(self.folder, self.split.train, margin)

    def spread(self, count: int, split: Literal["train", "test"] = "train") -> tuple[int, ...]:
        """At most ``count`` frame numbers, evenly spread over the training or the held-out frames."""
        return spread_from_start(getattr(self.split, split), count)


def read_fitted_clip(ingest: Path, fit: Path, body: BodyModel | Path) -> FittedClip:
    """Read what ingest and fit published of a clip.

    Args:
        ingest, fit: the folders of the two stages.
        body: the body model that the clip was fitted with, or its file.

    Raises:
        UserError: a file is missing or damaged, or the files do not go together; names the file, the frame
            and the stage to run again.
    """
    model = load_body(body) if isinstance(body, Path) else body
    quality = read_fit_quality(fit)
    clip = FittedClip(
        folder=ingest,
        split=accepted_frames(read_split(ingest / "split.json"), quality, fit),
        cameras=read_cameras(ingest / "cameras.parquet"),
        body=model,
        identity=read_identity(fit / "identity.safetensors", model),
        poses=read_poses(fit / "poses.parquet"),
        quality=quality,
    )
    _check(clip, fit / "poses.parquet")
    return clip


def accepted_frames(split: Split, quality: FitQuality, fit: Path) -> Split:
    """The split without the frames that the fit does not accept.

    Raises:
        UserError: no training frame is left.
    """
    refused = {*quality.frames[~quality.accepted].tolist()}
    train, test = (tuple(one for one in part if one not in refused) for part in (split.train, split.test))
    if not train:
        raise UserError(
            f"{fit / FIT_QUALITY}: the body is on the person in no training frame: see overlay.png there, "
            "name the person (ingest.person=), or go on regardless (fit.accept=any)"
        )
    return Split(train, test)


def _check(clip: FittedClip, path: Path) -> None:
    frames = clip.poses.frames
    if list(frames) != sorted({*frames}) or min(frames, default=0) < 0:
        raise UserError(f"{path}: its frame numbers do not increase; run the fit stage again")
    unposed = sorted({*clip.split.train, *clip.split.test} - {*frames})
    if unposed:
        raise UserError(f"{path} has no pose for frame {unposed[0]}; run the fit stage again")
    unseen, cameras = sorted({*frames} - {*clip.cameras}), clip.folder / "cameras.parquet"
    if unseen:
        raise UserError(f"{cameras} has no camera for frame {unseen[0]}; run the ingest stage again")
    for name in ("rotation", "expression", "transl"):
        if not bool(torch.isfinite(getattr(clip.poses, name)).all()):
            raise UserError(f"{path}: {name} is not finite everywhere; run the fit stage again")
