"""Cameras that filmed what no training frame shows: a mannequin's, where the truth is known.

Ingest publishes them beside a mannequin's clip (``views/<name>/``). The avatar is rendered in the pose that
it has in that frame and scored as in any other; and apart from it, on the surface that training frames
show and on the surface that they never show. Which is which is told by the surface that was really filmed
(``truth_surface``), not by the fit.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pipeline.body import BodyModel, Identity, Poses, edges, rasterize, read_identity, read_poses
from pipeline.camera import Camera
from pipeline.frames import read_frame, read_mask
from pipeline.metrics.image import psnr, ssim
from pipeline.metrics.protocol import BACKGROUNDS, BLACK, composite, interior, person
from pipeline.records import read_cameras
from pipeline.splat import render
from stages.evaluate.evidence import Evidence, evenly
from stages.evaluate.judging import On
from stages.evaluate.mesh import TexturedMesh, posed
from stages.evaluate.rendering import Animate, scored_picture
from stages.evaluate.scoring import AVATAR, MESH, VIEWS, Score

FRAMES = 3  # of each camera
LEAST = 50  # pixels of seen or never-seen surface, under which a PSNR says nothing
LOOKED_AT = 24  # training frames that say what was seen


@dataclasses.dataclass(frozen=True)
class Filmed:
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
    seen: np.ndarray

    def unseen_pixels(self, camera: Camera, frame: int) -> Tensor:
        """[H, W] bool: pixels that show surface of which no training frame shows a corner."""
        raster = self.raster(camera, frame)
        corners = self.seen[self.body.faces.numpy()[raster.face]].any(-1)
        return torch.from_numpy(raster.covered & ~corners)

    def raster(self, camera: Camera, frame: int):
        """Which face each pixel of a true frame shows."""
        row = self.poses.index(frame)
        pose = (self.poses.rotation[row], self.poses.expression[row], self.poses.transl[row])
        return rasterize(camera, posed(self.body, self.surface, pose), self.body.faces)


def read_filmed(evidence: Evidence, body: BodyModel) -> Filmed | None:
    """What was really filmed, and what of it the training frames show; None where that is not known."""
    if not (evidence.folder / "truth_surface.safetensors").is_file():
        return None
    surface = read_identity(evidence.folder / "truth_surface.safetensors", body)
    poses = read_poses(evidence.folder / "truth_poses.parquet")
    filmed = Filmed(body, surface, poses, np.zeros(len(body.v_template), bool))
    faces = body.faces.numpy()
    for frame in evenly(evidence.split.train, LOOKED_AT):
        shown = filmed.raster(evidence.cameras[frame], frame).face
        filmed.seen[faces[np.unique(shown[shown >= 0])]] = True
    # A face smaller than a pixel may be missed: what touches seen surface counts as seen.
    pairs = edges(body.faces).numpy()
    touched = filmed.seen.copy()
    for one, other in (pairs.T, pairs[:, ::-1].T):
        touched[one[filmed.seen[other]]] = True
    return dataclasses.replace(filmed, seen=touched)


def view_folders(evidence: Evidence) -> list[Path]:
    """The folders of the other cameras, sorted by name."""
    folder = evidence.folder / "views"
    return sorted(path for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []


def score_views(
    evidence: Evidence, animate: Animate, mesh: TexturedMesh | None, filmed: Filmed | None, background: str
) -> list[Score]:
    """The avatar and the textured mesh in the other cameras, a few frames each."""
    scores: list[Score] = []
    for folder in view_folders(evidence):
        cameras = read_cameras(folder / "cameras.parquet")
        frames = evenly([frame for frame in sorted(cameras) if frame in evidence.cameras], FRAMES)
        for frame, camera in ((frame, cameras[frame]) for frame in frames):
            unseen = filmed.unseen_pixels(camera, frame) if filmed is not None else None
            image, mask = read_frame(folder / "frames", frame), read_mask(folder / "masks", frame)
            truth = partial(composite, image, mask)
            for method, on in _shown(evidence, animate, mesh, camera, frame):
                values = _values(on, truth, mask, unseen, background)
                scores += [Score(frame, VIEWS, method, *value, folder.name) for value in values.items()]
    return scores


def _shown(
    evidence: Evidence, animate: Animate, mesh: TexturedMesh | None, camera: Camera, frame: int
) -> Iterator[tuple[str, On]]:
    pose = evidence.pose(frame)
    with torch.no_grad():
        yield AVATAR, partial(scored_picture, render(animate(*pose, evidence.seconds(frame)), camera))
    if mesh is not None:
        yield MESH, mesh.on(pose, camera)


def _values(
    on: On, truth: Callable[[str], Tensor], mask: np.ndarray, unseen: Tensor | None, background: str
) -> dict[str, float]:
    image, true, black, true_black = on(background), truth(background), on(BLACK), truth(BLACK)
    values = {
        "psnr": psnr(image, true),
        "psnr_interior": psnr(black, true_black, interior(mask)),
        "psnr_person": psnr(black, true_black, person(mask)),
        "ssim": ssim(image, true, BACKGROUNDS[background]),
    }
    if unseen is not None:
        inside = person(mask)
        values["unseen_share"] = float((inside & unseen).sum() / inside.sum().clamp_min(1))
        for name, pixels in (("psnr_unseen", inside & unseen), ("psnr_seen", inside & ~unseen)):
            values[name] = psnr(black, true_black, pixels) if int(pixels.sum()) >= LEAST else math.nan
    return values
