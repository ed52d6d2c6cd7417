"""The mannequin as footage: what the ingest stage publishes, with the truth beside it.

Besides the stage's own files there are those of :mod:`stages.ingest.mannequin.truth`, and for each unseen
camera ``views/<name>/`` with ``frames/``, ``masks/`` and ``cameras.parquet`` as for the clip itself.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.body import load_body, load_landmarks
from pipeline.clip.frames import write_frame, write_mask
from pipeline.clip.keypoints import write_keypoints
from pipeline.clip.records import Footage, write_cameras, write_footage, write_split
from stages.ingest.mannequin.footage import Filming, film_view
from stages.ingest.mannequin.scene import Picture
from stages.ingest.mannequin.spec import MannequinSpec, spec_of
from stages.ingest.mannequin.truth import write_truth
from stages.ingest.preview import write_preview
from stages.ingest.split import split_frames

if TYPE_CHECKING:
    from pipeline.run.stage import Context


def run_mannequin(context: Context) -> None:
    """Film the mannequin that ``context.settings.mannequin...`` describes.

    A BVH file given as the footage (``context.source``) is its motion.

    Raises:
        UserError: the BVH file, the body or its landmarks cannot be used, or too few frames are left to
            learn from.
    """
    settings, output = context.settings, context.output
    spec = spec_of(settings)
    if context.source is not None:
        spec = dataclasses.replace(spec, motion=str(context.source))
    body = load_body(context.body_file)
    frames = tuple(range(spec.frames))
    split = split_frames(frames, settings.test_fraction, settings.test_frames)

    started = time.perf_counter()
    filming = Filming(spec, body, load_landmarks(body, context.body))
    with context.progress(spec.frames, "filming") as progress:
        for row, picture in enumerate(filming.pictures()):
            _write(output, row, picture)
            progress.advance()
    keypoints, truth = filming.finish()
    context.timing("film_seconds", round(time.perf_counter() - started, 2))

    write_cameras(output / "cameras.parquet", dict.fromkeys(frames, filming.scene.shot.camera))
    write_keypoints(output / "keypoints.parquet", keypoints)
    write_split(output / "split.json", split)
    write_footage(output / "footage.json", describe(spec))
    write_preview(output / "preview.png", output / "frames", output / "masks", keypoints)
    write_truth(output, truth, body)
    for name in spec.views:
        cameras = {}
        for row, camera, picture in film_view(spec, filming.scene, name):
            _write(output / "views" / name, row, picture)
            cameras[row] = camera
        write_cameras(output / "views" / name / "cameras.parquet", cameras)
    context.log(
        f"{spec.frames} frames of a mannequin, {spec.framing} framing, {len(split.test)} of them held out"
    )


def describe(spec: MannequinSpec) -> Footage:
    """The content of ``footage.json``."""
    motion = Path(spec.motion).name if spec.is_bvh else "+".join(spec.layers)
    return Footage(
        name=f"mannequin {spec.framing} {motion}",
        width=spec.size,
        height=spec.size,
        fps=spec.fps,
        scale=1.0,
        read=spec.frames,
        kept=spec.frames,
        dropped={},
        people=1,
        seconds=tuple(round(frame / spec.fps, 6) for frame in range(spec.frames)),
        sources={"keypoints": "mannequin", "masks": "mannequin"},
    )


def _write(folder: Path, row: int, picture: Picture) -> None:
    for kind in ("frames", "masks"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    write_frame(folder / "frames", row, picture.image)
    write_mask(folder / "masks", row, picture.mask)
