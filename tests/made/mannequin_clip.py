"""A mannequin's clip with its true fit, small enough for tests of the auxiliary stage."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import numpy as np
import torch

from stages.auxiliary.settings import AuxiliarySettings
from stages.auxiliary.turntable_motion import read_numbered_clip
from stages.ingest.mannequin.appearance import make_appearance
from stages.ingest.mannequin.attire import surface_offset
from stages.ingest.mannequin.footage import Mannequin, make_mannequin
from stages.ingest.mannequin.framing import FramedMotion
from stages.ingest.mannequin.person import make_identity
from stages.ingest.mannequin.scene import film, make_background, make_scene
from stages.ingest.mannequin.spec import MannequinSpec
from tests.made.body import BODY_FILE, open_body, open_landmarks
from tests.made.context import RecordedContext, stage_context
from tests.made.published import publish, simple_footage

FRAMES = 6


@functools.cache
def mannequin(framing: str, size: int = 96, motion: str = "sway") -> Mannequin:
    spec = MannequinSpec(framing=framing, motion=motion, frames=FRAMES, size=size, noise=0.0)
    return make_mannequin(spec, open_body(), open_landmarks())


def write_clip(folder: Path, framing: str = "full", size: int = 96) -> Path:
    """Writes ``ingest``, ``fit`` and ``plan`` as those stages would, with the truth as the fit."""
    made = mannequin(framing, size)
    publish(
        folder,
        zip(made.frames, made.masks, strict=True),
        made.cameras,
        (open_body(), made.truth.surface, made.truth.poses),
        simple_footage(size, size, 25.0, FRAMES),
        keypoints=made.keypoints,
    )
    return folder


def read(folder: Path):
    return read_numbered_clip(folder / "ingest", folder / "fit", BODY_FILE)


def context_for(place: Path, output: Path, assets=(), **changes) -> RecordedContext:
    """The auxiliary stage's context over a clip's folder; ``changes`` are settings."""
    small = {"frames": 8, "width": 144, "height": 256, "texture_levels": 0, "texture_frames": 3}
    settings = dataclasses.replace(AuxiliarySettings(), **{**small, **changes})
    inputs = {name: place / name for name in ("ingest", "fit", "plan")}
    return stage_context("auxiliary", settings, output, inputs, assets=dict(assets))


def films(turn, seed: int) -> list[np.ndarray]:
    """A mannequin of another seed, or of the clip's own (0), filmed in the poses of a turn."""
    body, landmarks = open_body(), open_landmarks()
    identity, appearance = make_identity(body, seed), make_appearance(body, landmarks, seed)
    worn = surface_offset(body, appearance.measures, appearance.style)
    clothed = dataclasses.replace(identity, face_offset=identity.face_offset + worn)
    shot = FramedMotion(turn.camera, torch.zeros(3), turn.poses)
    scene, background = make_scene(body, clothed, appearance, shot, 0), make_background(turn.camera, 3)
    return [film(scene, row, turn.camera, background).image for row in range(len(turn.poses))]
