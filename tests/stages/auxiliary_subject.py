"""A mannequin's clip with its true fit, small enough for tests of the auxiliary stage."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch

from pipeline.body import load_body, load_landmarks, write_identity, write_poses
from pipeline.clip.frames import write_frame, write_mask
from pipeline.clip.keypoints import write_keypoints
from pipeline.clip.plan import write_plan
from pipeline.clip.records import Footage, Split, write_cameras, write_footage, write_split
from stages.auxiliary.settings import AuxiliarySettings
from stages.auxiliary.turntable_motion import read_numbered_clip
from stages.ingest.mannequin.appearance import make_appearance
from stages.ingest.mannequin.attire import surface_offset
from stages.ingest.mannequin.footage import Mannequin, make_mannequin
from stages.ingest.mannequin.framing import FramedMotion
from stages.ingest.mannequin.person import make_identity
from stages.ingest.mannequin.scene import film, make_background, make_scene
from stages.ingest.mannequin.spec import MannequinSpec
from tests.plans import plan_of

BODY = Path(__file__).parents[2] / "data" / "body"
BODY_FILE = BODY / "open_body.npz"
FRAMES = 6


@functools.cache
def body_and_landmarks():
    body = load_body(BODY_FILE)
    return body, load_landmarks(body, BODY)


@functools.cache
def mannequin(framing: str, size: int = 96, motion: str = "sway") -> Mannequin:
    spec = MannequinSpec(framing=framing, motion=motion, frames=FRAMES, size=size, noise=0.0)
    return make_mannequin(spec, *body_and_landmarks())


def write_clip(folder: Path, framing: str = "full", size: int = 96) -> Path:
    """Writes ``ingest``, ``fit`` and ``plan`` as those stages would, with the truth as the fit."""
    made, body = mannequin(framing, size), body_and_landmarks()[0]
    ingest, fit, plan = (folder / name for name in ("ingest", "fit", "plan"))
    for place in (ingest / "frames", ingest / "masks", fit, plan):
        place.mkdir(parents=True)
    for row in range(FRAMES):
        write_frame(ingest / "frames", row, made.frames[row])
        write_mask(ingest / "masks", row, made.masks[row])
    write_cameras(ingest / "cameras.parquet", made.cameras)
    write_keypoints(ingest / "keypoints.parquet", made.keypoints)
    write_split(ingest / "split.json", Split(tuple(range(FRAMES - 1)), (FRAMES - 1,)))
    seconds = tuple(row / 25 for row in range(FRAMES))
    write_footage(
        ingest / "footage.json", Footage("m", size, size, 25.0, 1.0, FRAMES, FRAMES, {}, 1, seconds, {})
    )
    write_plan(plan / "plan.json", plan_of())
    write_identity(fit / "identity.safetensors", made.truth.surface, body)
    write_poses(fit / "poses.parquet", made.truth.poses)
    return folder


def read(folder: Path):
    return read_numbered_clip(folder / "ingest", folder / "fit", BODY_FILE)


def context_for(place: Path, output: Path, assets=(), **changes):
    """A stand-in for the runner's context; ``changes`` are settings."""
    work = output.with_name(f"{output.name}-work")
    for made in (output, work):
        made.mkdir(parents=True, exist_ok=True)

    @contextlib.contextmanager
    def progress(total: int, label: str):
        yield SimpleNamespace(advance=lambda n=1, note="": None)

    logged: list[str] = []
    small = {"frames": 8, "width": 144, "height": 256, "texture_levels": 0, "texture_frames": 3}
    return SimpleNamespace(
        settings=dataclasses.replace(AuxiliarySettings(), **{**small, **changes}),
        inputs={name: place / name for name in ("ingest", "fit", "plan")},
        assets=dict(assets),
        body=BODY,
        body_file=BODY_FILE,
        output=output,
        work=work,
        progress=progress,
        log=logged.append,
        logged=logged,
        timing=lambda name, value: None,
    )


def films(turn, seed: int) -> list[np.ndarray]:
    """A mannequin of another seed, or of the clip's own (0), filmed in the poses of a turn."""
    body, landmarks = body_and_landmarks()
    identity, appearance = make_identity(body, seed), make_appearance(body, landmarks, seed)
    worn = surface_offset(body, appearance.measures, appearance.style)
    clothed = dataclasses.replace(identity, face_offset=identity.face_offset + worn)
    shot = FramedMotion(turn.camera, torch.zeros(3), turn.poses)
    scene, background = make_scene(body, clothed, appearance, shot, 0), make_background(turn.camera, 3)
    return [film(scene, row, turn.camera, background).image for row in range(len(turn.poses))]
