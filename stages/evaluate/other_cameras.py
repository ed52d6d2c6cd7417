"""Scores in cameras that filmed what no training frame shows: a mannequin's, where the truth is known.

Ingest publishes them beside a mannequin's clip (``views/<name>/``). The avatar is rendered in the pose that
it has in that frame and scored as in any other; and apart from it, on the surface that training frames
show and on the surface that they never show. Which is which is told by the surface that was really filmed
(``truth_surface``), not by the fit.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pipeline.body import (
    BodyModel,
    Identity,
    Poses,
    edges,
    posed_vertices,
    rasterize,
    read_identity,
    read_poses,
)
from pipeline.body.rasterize import Raster
from pipeline.clip.camera import Camera
from pipeline.clip.composite import BACKGROUNDS, BLACK, composite_frame
from pipeline.clip.foreground import read_person
from pipeline.clip.frames import read_frame, spread_end_to_end
from pipeline.clip.records import read_cameras
from pipeline.metrics.psnr import psnr
from pipeline.metrics.regions import interior, person
from pipeline.metrics.ssim import ssim
from stages.evaluate.evaluated_clip import EvaluatedClip
from stages.evaluate.methods import AvatarMethod, OnBackground
from stages.evaluate.scores import VIEWS, TableRow
from stages.evaluate.textured_mesh import TexturedMesh

FRAMES = 3  # of each camera
LEAST = 50  # pixels of seen or never-seen surface, under which a PSNR says nothing
LOOKED_AT = 24  # training frames that say what was seen


@dataclasses.dataclass(frozen=True)
class TrueSurface:
    """The surface that was really filmed.

    Attributes:
        body: the body.
        surface: its identity with hair and clothes.
        poses: the true ones.
        seen: [V] bool, the vertices that training frames show.
    """

    body: BodyModel
    surface: Identity
    poses: Poses
    seen: np.ndarray  # [V]

    def unseen_pixels(self, camera: Camera, frame: int) -> Tensor:
        """[H, W] bool: pixels that show surface of which no training frame shows a corner."""
        raster = self.raster(camera, frame)
        corners = self.seen[self.body.faces.numpy()[raster.face]].any(-1)
        return torch.from_numpy(raster.covered & ~corners)

    def raster(self, camera: Camera, frame: int) -> Raster:
        """The face that each pixel of a true frame shows."""
        vertices = posed_vertices(self.body, self.surface, self.poses.pose(frame))
        return rasterize(camera, vertices, self.body.faces)


def read_true_surface(clip: EvaluatedClip) -> TrueSurface | None:
    """The surface that was really filmed, and what of it the training frames show; None where not known."""
    if not (clip.folder / "truth_surface.safetensors").is_file():
        return None
    body, faces = clip.body, clip.body.faces.numpy()
    surface = read_identity(clip.folder / "truth_surface.safetensors", body)
    poses = read_poses(clip.folder / "truth_poses.parquet")
    true = TrueSurface(body, surface, poses, np.zeros(len(body.v_template), bool))
    for frame in spread_end_to_end(clip.split.train, LOOKED_AT):
        shown = true.raster(clip.camera(frame), frame).face
        true.seen[faces[np.unique(shown[shown >= 0])]] = True
    # A face smaller than a pixel may be missed: what touches seen surface counts as seen.
    pairs = edges(body.faces).numpy()
    touched = true.seen.copy()
    for one, other in (pairs.T, pairs[:, ::-1].T):
        touched[one[true.seen[other]]] = True
    return dataclasses.replace(true, seen=touched)


def camera_folders(clip: EvaluatedClip) -> list[Path]:
    """The folders of the other cameras, sorted by name."""
    folder = clip.folder / "views"
    return sorted(path for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []


def score_other_cameras(
    clip: EvaluatedClip,
    methods: Sequence[AvatarMethod | TexturedMesh],
    true: TrueSurface | None,
    background: str,
) -> Iterator[TableRow]:
    """The scores of a few frames of each of the other cameras.

    Args:
        clip: the clip.
        methods: what is scored; each must be able to show a frame in another camera.
        true: tells seen surface from never-seen; they are not told apart if None.
        background: what pictures are composited on.
    """
    for folder in camera_folders(clip):
        cameras = read_cameras(folder / "cameras.parquet")
        for frame in spread_end_to_end([frame for frame in sorted(cameras) if frame in clip.cameras], FRAMES):
            camera = cameras[frame]
            unseen = true.unseen_pixels(camera, frame) if true is not None else None
            colors, mask = read_person(folder, frame)
            if clip.photographed:
                colors = read_frame(folder / "frames", frame)
            truth = partial(composite_frame, colors, mask)
            for method in methods:
                values = camera_metrics(method.render(frame, camera), truth, mask, unseen, background)
                for metric, value in values.items():
                    yield TableRow(frame, VIEWS, method.name, metric, value, folder.name)


def camera_metrics(
    picture: OnBackground, truth: OnBackground, mask: np.ndarray, unseen: Tensor | None, background: str
) -> dict[str, float]:
    """The metrics of a picture in another camera.

    Args:
        picture, truth: before they are composited.
        mask: [H, W] uint8, soft alpha of the truth.
        unseen: [H, W] bool, pixels of never-seen surface; without metrics of them if None.
        background: what whole pictures are compared on.
    """
    black, true_black = picture(BLACK), truth(BLACK)
    image, true, inside = picture(background), truth(background), person(mask)
    values = {
        "psnr": psnr(image, true),
        "psnr_interior": psnr(black, true_black, interior(mask)),
        "psnr_person": psnr(black, true_black, inside),
        "ssim": ssim(image, true, BACKGROUNDS[background]),
    }
    if unseen is not None:
        values["unseen_share"] = float((inside & unseen).sum() / inside.sum().clamp_min(1))
        for name, pixels in (("psnr_unseen", inside & unseen), ("psnr_seen", inside & ~unseen)):
            values[name] = psnr(black, true_black, pixels) if int(pixels.sum()) >= LEAST else math.nan
    return values
