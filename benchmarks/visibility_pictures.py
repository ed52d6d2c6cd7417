"""The pictures and numbers of ``benchmarks.visibility`` that look beside the held-out frames."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import matplotlib.pyplot as plt
import numpy as np
import torch
from torch import Tensor

from pipeline.avatar import Architecture, Avatar
from pipeline.avatar.visibility import body_in_frame
from pipeline.body import joint_transforms
from pipeline.clip.camera import Camera, facing_camera, project
from pipeline.clip.composite import composite_frame
from pipeline.clip.frames import read_frame, read_mask, write_png
from pipeline.clip.records import read_cameras
from pipeline.splat import Rendering, render
from stages.train.loop import Trainer
from stages.train.settings import TrainSettings

VIEW = "above"  # of the mannequin's unseen cameras, the one that shows most of what no frame did
BACK = 2.2  # metres that the wide camera stands behind the filming one
STEPS = 24  # whose gradients are added up
REACH = 6  # pixels about a seen vertex that count as the seen region


def unseen_error(subject: Any, trainer: Trainer, folder: Path | None) -> dict[str, float]:
    """What a camera that never was sees outside of what the clip showed.

    Returns:
        ``outside``: the mean absolute difference from the truth there, person on black, of a mannequin's
        unseen camera. ``ghost``: pixels that a camera farther back finds covered by what no training frame
        showed, for any subject.
    """
    found = {"ghost": ghost(subject, trainer, folder)}
    views = subject.folders["ingest"] / "views" / VIEW
    if not views.is_dir():
        return found
    total, pixels = 0.0, 0
    for frame, camera in read_cameras(views / "cameras.parquet").items():
        rendering, seen = _rendered(subject, trainer, frame, camera)
        truth = composite_frame(read_frame(views / "frames", frame), read_mask(views / "masks", frame))
        total += float((rendering.color.clamp(0, 1) - truth).abs().mean(-1)[~seen].sum())
        pixels += int((~seen).sum())
    return found | {"outside": total / max(1, pixels)}


def ghost(subject: Any, trainer: Trainer, folder: Path | None) -> float:
    """Alpha outside the seen region, summed over the pixels of one wide view."""
    frame = subject.data.clip.split.test[0]
    camera = facing_camera(256, 256, 1.2 * 256)
    wide = dataclasses.replace(camera, translation=camera.translation + torch.tensor([0.0, 0.0, BACK]))
    rendering, seen = _rendered(subject, trainer, frame, wide)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        image = rendering.color + (1 - rendering.alpha[..., None]) * 0.82
        name = f"ghost_{subject.name}_{'on' if 'gate' in trainer.hooks else 'off'}.png"
        write_png(folder / name, (image.clamp(0, 1) * 255).byte().numpy())
    return float(rendering.alpha[~seen].sum())


@torch.no_grad()
def _rendered(subject: Any, trainer: Trainer, frame: int, camera: Camera) -> tuple[Rendering, Tensor]:
    """The avatar from a camera, and the pixels near a vertex that some training frame had in its picture."""
    pose, avatar = subject.data.clip.pose(frame), trainer.avatar.eval()
    rendering = render(avatar.gaussians(pose), camera)
    avatar.train()
    seen = _seen_vertices(subject)
    vertices = seen["surface"].skinning_tables.place(*seen["pose"](pose.rotation), pose.transl)[0][
        seen["often"]
    ]
    marks = np.zeros((camera.height, camera.width), np.uint8)
    for column, line in project(camera, vertices).round().int().tolist():
        if 0 <= column < camera.width and 0 <= line < camera.height:
            marks[line, column] = 1
    size = 2 * REACH + 1
    return rendering, torch.from_numpy(cv2.dilate(marks, np.ones((size, size), np.uint8)) > 0)


def _seen_vertices(subject: Any) -> dict[str, Any]:
    """The body's surface, and which of its vertices at least a tenth of the training frames show."""
    clip = subject.data.clip
    bare = Architecture(plane_resolution=2, plane_channels=1, subdivisions=0)
    everything = torch.arange(len(clip.body.v_template))
    surface = Avatar(clip.body, clip.identity, everything, bare).surfaces[0]
    hits = torch.zeros(len(surface.canonical))
    for frame in clip.split.train:
        hits += body_in_frame(surface, clip.pose(frame), subject.data.crops.camera(frame))

    def pose(rotation: Tensor) -> tuple[Tensor, Tensor]:
        canonical = surface.canonical
        return joint_transforms(rotation[None], canonical.joints, canonical.parents)[0], canonical.vertices

    return {"surface": surface, "pose": pose, "often": hits >= 0.1 * len(clip.split.train)}


def gradient_picture(
    subject: Any, folder: Path | None, trainer_of: Callable[[Any, TrainSettings], Trainer]
) -> dict[str, float]:
    """The triplane's gradient magnitude with and without the gate, as in the paper's figure.

    Both avatars have every body vertex and the same planes; one is gated from the first step. The number
    is the share of the gradient's mass in cells that only gated Gaussians read.
    """
    masses, pictures = {}, {}
    settings = dataclasses.replace(
        TrainSettings(), early_gate=False, subdivisions=0, iterations=1000, gate_from=0.0, gate_every=STEPS,
        residual_from=1.0,
    )  # fmt: skip
    gated = trainer_of(subject, settings)
    for _ in range(STEPS):
        gated.step()
    only = _only_gated(gated)
    for name, changes in (("with", {}), ("without", {"gate": False})):
        trainer = trainer_of(subject, dataclasses.replace(settings, **changes))
        if name == "with":
            trainer.avatar.gate(gated.avatar.active)
            del trainer.hooks["gate"]
        total = torch.zeros(len(only))
        for _ in range(STEPS):
            trainer.step()
            total += trainer.avatar.representation.triplane.planes.grad.square().sum(-1).sqrt().flatten()
        masses[name] = float(total[only].sum() / total.sum())
        resolution = settings.plane_resolution
        pictures[name] = total.view(-1, 3, resolution, resolution)[0, 0].flip(0).numpy()
    print(f"{subject.name}: gradient in cells that only gated Gaussians read: {masses}")
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        _draw(folder / f"gradient_{subject.name}.png", pictures)
    return masses | {"cells": float(only.float().mean())}


def _only_gated(trainer: Trainer) -> Tensor:
    """Texels that gated Gaussians read and active ones do not, [T] bool."""
    full, part = trainer.avatar.surfaces[0].samples, trainer.avatar.surface(0).samples
    read = torch.zeros(2, full.matrix.shape[1], dtype=torch.bool)
    read[0, full.matrix.col_indices().long()] = True
    read[1, part.matrix.col_indices().long()] = True
    return read[0] & ~read[1]


def _draw(path: Path, pictures: dict[str, np.ndarray]) -> None:
    highest = float(np.log10(max(picture.max() for picture in pictures.values()) + 1e-12))
    figure, axes = plt.subplots(1, 2, figsize=(7, 3.6), layout="constrained")
    for axis, name in zip(axes, ("without", "with"), strict=True):
        shown = axis.imshow(np.log10(pictures[name] + 1e-12), vmin=highest - 5, vmax=highest, cmap="inferno")
        axis.set(title=f"{name} the gate", xticks=[], yticks=[])
    figure.colorbar(shown, ax=axes, label="log10 of the gradient's magnitude")
    figure.savefig(path, dpi=110)
    plt.close(figure)
