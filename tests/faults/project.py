"""A real subject, small enough to be run again and again: every stage, all effects, seconds each."""

from __future__ import annotations

import dataclasses
import os
import sys
from pathlib import Path

from pipeline.config.workspace import REPOSITORY
from pipeline.run.stage import load_stages, usual
from pipeline.store.artifact import Store

SUBJECT = "tiny"
TINY = """title = "A mannequin's head, as small as it gets"
[ingest]
mannequin = "head"
mannequin_frames = 8
mannequin_size = 96
test_frames = 2
[fit]
iterations = 12
[auxiliary]
generator = "texture"
frames = 6
width = 96
height = 128
texture_frames = 3
texture_levels = 0
texture_guidance = false
[train]
iterations = 12
checkpoint_every = 1
held_out_every = 6
held_out_frames = 1
subdivisions = 0
plane_resolution = 16
plane_channels = 4
width = 16
groups = 4
residual_width = 16
color_frames = 3
gate_from = 0.25
gate_every = 2
[evaluate]
turntable_frames = 4
turntable_width = 64
turntable_height = 64
training_frames = 2
comparison_frames = 2
"""


@dataclasses.dataclass(frozen=True)
class Project:
    """One subject in folders of its own, and the command that makes all of it.

    Attributes:
        words: the command line's.
        subject: who.
        stages: those that the command runs, upstream first.
        artifacts: the store's folder.
    """

    words: tuple[str, ...]
    subject: str
    stages: tuple[str, ...]
    artifacts: Path

    @property
    def store(self) -> Store:
        return Store(self.artifacts)

    def command(self, *tasks: str) -> list[str]:
        return [sys.executable, "-m", "doit", "run", *tasks, *self.words]

    def environment(self) -> dict[str, str]:
        """One thread, and lines that are seen as soon as they are written."""
        threads = {name: "1" for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS")}
        return {**os.environ, **threads, "PYTHONPATH": str(REPOSITORY), "PYTHONUNBUFFERED": "1"}


def toy_project(root: Path) -> Project:
    """Stages that only count, a second each: for many kills in little time."""
    from tests.pipeline.conftest import ToyProject

    toy = ToyProject(root).write()
    words = ("subject=ann", "paint.iterations=8", "paint.rate=0.02", *toy.words())
    return Project(words, "ann", ("gather", "bend", "paint"), toy.store)


def real_project(root: Path, assets: Path) -> Project:
    """The tiny subject; the definitions that it shares with the checkout are links."""
    data = root / "data"
    (data / "subjects").mkdir(parents=True)
    for name in ("assets.toml", "body", "datasets", "presets"):
        (data / name).symlink_to(REPOSITORY / "data" / name)
    (data / "subjects" / f"{SUBJECT}.toml").write_text(TINY, encoding="utf-8")
    artifacts = root / "artifacts"
    words = (f"subject={SUBJECT}", f"data={data}", f"artifacts={artifacts}", f"assets={assets}")
    return Project(words, SUBJECT, tuple(usual(load_stages())), artifacts)
