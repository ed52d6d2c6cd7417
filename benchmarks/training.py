"""What benchmarks that train share: a run of the train stage in this process, and its score."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pipeline.avatar import Avatar, load_avatar
from pipeline.body import load_body
from pipeline.clip.composite import composite_frame
from pipeline.clip.fitted_clip import FittedClip, read_fitted_clip
from pipeline.clip.keypoints import FACE, LEFT_HAND, RIGHT_HAND
from pipeline.metrics.psnr import psnr
from pipeline.metrics.regions import interior
from pipeline.run.job import Job
from pipeline.run.process import make_results
from pipeline.run.stage import Context
from pipeline.splat import Rendering, render
from stages.evaluate.baselines import nearest_frames
from stages.evaluate.frame_metrics import Scorer
from stages.train import run as train

CROPS = {"face": FACE, "left_hand": LEFT_HAND, "right_hand": RIGHT_HAND}
SEEN, SMALLEST = 0.4, 8  # score from which a keypoint is seen; pixels along a side of a crop


@dataclasses.dataclass(frozen=True)
class Trained:
    """A finished avatar and what it took.

    Attributes:
        avatar: ready to be posed.
        seconds: processor seconds of all threads, from reading the inputs to writing the avatar.
        curve: the bytes of ``curve.parquet``.
    """

    avatar: Avatar
    seconds: float
    curve: bytes


def trained(job: Job, **instead: Path) -> Trained:
    """Runs the train stage in this process; what it needs is made by the store first.

    Args:
        job: whose avatar, and under which settings.
        instead: folders that stand in for upstream stages' published ones.
    """
    upstream = make_results(job, job.stages["train"].needs)
    demands = job.stages["train"].demands(job.settings["train"])
    with tempfile.TemporaryDirectory() as folder:
        places = {name: Path(folder) / name for name in ("output", "work")}
        for place in places.values():
            place.mkdir()
        context = Context(
            subject=job.subject.name,
            settings=job.settings["train"],
            inputs={**{name: one.folder for name, one in upstream.items()}, **instead},
            assets={asset: job.workspace.assets / asset for asset in demands.assets},
            source=None,
            body=job.workspace.body,
            body_file=job.workspace.body_file,
            stage="train",
            **places,
        )
        start = time.process_time()
        with contextlib.redirect_stdout(io.StringIO()):
            train.run(context)
        seconds = time.process_time() - start
        avatar = load_avatar(context.output / "avatar.safetensors", load_body(context.body_file))
        return Trained(avatar, seconds, (context.output / "curve.parquet").read_bytes())


@dataclasses.dataclass(frozen=True)
class JudgedClip:
    """The frames that an avatar is judged by.

    Attributes:
        clip: the fitted clip.
        test: its held-out frames, at most as many as asked for, evenly spread.
    """

    clip: FittedClip
    test: tuple[int, ...]

    @classmethod
    def read(cls, ingest: Path, fit: Path, body_file: Path, most: int) -> JudgedClip:
        """Reads what ingest and fit published."""
        clip = read_fitted_clip(ingest, fit, body_file)
        step = max(1, -(-len(clip.split.test) // most))
        return cls(clip, clip.split.test[::step])

    @torch.no_grad()
    def render(self, avatar: Avatar, frame: int) -> Rendering:
        """The avatar as a frame's camera sees it in that frame's fitted pose."""
        gaussians = avatar.gaussians(self.clip.pose(frame), self.clip.seconds.get(frame))
        return render(gaussians, self.clip.cameras[frame])

    def person(self, frame: int) -> Tensor:
        """What was filmed, the person on black: [H, W, 3]."""
        return composite_frame(self.clip.frame(frame), self.clip.mask(frame))

    def scores(self, avatar: Avatar, scorer: Scorer) -> dict[str, float]:
        """Each metric's mean over the held-out frames, the person on black."""
        return self.scores_of(lambda frame: self.render(avatar, frame).color.clamp(0, 1), scorer)

    def nearest_scores(self, scorer: Scorer) -> dict[str, float]:
        """The same of the training frame that is most like each held-out one."""
        training = self.clip.split.train
        nearest = nearest_frames(self.person, training, self.test)
        return self.scores_of(lambda frame: self.person(nearest[frame]), scorer)

    def scores_of(self, shown_at: Callable[[int], Tensor], scorer: Scorer) -> dict[str, float]:
        """Each metric's mean over the held-out frames of what is shown at each, [H, W, 3] on black."""
        total: dict[str, list[float]] = {}
        for frame in self.test:
            mask = self.clip.mask(frame)
            truth, shown = scorer.picture(self.person(frame)), scorer.picture(shown_at(frame))
            for name, value in scorer.values(shown, truth, interior(mask)).items():
                total.setdefault(name, []).append(value)
            for name, box in self.crops(frame).items():
                value = psnr(shown.image[box], truth.image[box])
                total.setdefault(f"psnr_{name}", []).append(value)
        return {name: sum(values) / len(values) for name, values in total.items()}

    def crops(self, frame: int) -> dict[str, tuple[slice, slice]]:
        """Rows and columns around the face and around each hand, of those that were detected."""
        found = self.clip.keypoints
        points = found.whole_body[found.index(frame)]
        size = self.clip.mask(frame).shape
        found = {}
        for name, rows in CROPS.items():
            box = crop_box(points[rows], size)
            if box is not None:
                found[name] = box
        return found


def crop_box(points: np.ndarray, size: tuple[int, int]) -> tuple[slice, slice] | None:
    """Rows and columns around keypoints with a fifth to spare on each side; None where few are seen.

    Args:
        points: [K, 3], x, y in pixels and score.
        size: rows and columns of the picture.
    """
    seen = points[points[:, 2] >= SEEN, :2]
    if len(seen) < len(points) / 2:
        return None
    low, high = seen.min(0), seen.max(0)
    spare = 0.2 * (high - low)
    low = np.clip(np.floor(low - spare), 0, None).astype(int)
    high = np.minimum(np.ceil(high + spare), size[::-1]).astype(int)
    if (high - low).min() < SMALLEST:
        return None
    return slice(low[1], high[1]), slice(low[0], high[0])
