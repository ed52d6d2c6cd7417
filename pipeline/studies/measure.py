"""Quality and speed of finished avatars on one clip, measured once.

evaluate measures at the size that the avatar learnt from; numbers of two sizes cannot be compared. So a
study measures every avatar on its base's pictures, by evaluate's metrics (``pipeline.metrics``). Speed is
that of the baked avatar (``pipeline.avatar.bake``) in held-out poses, drawn for the base's camera at 512
pixels, as in the paper's runtime table.
"""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import pandas as pd
import torch

from pipeline.avatar import load_avatar
from pipeline.avatar.bake import bake
from pipeline.body import load_body
from pipeline.clip.composite import BACKGROUNDS, BLACK, composite_frame, over
from pipeline.clip.fitted_clip import FittedClip, read_fitted_clip
from pipeline.config.assets import require
from pipeline.files.json_files import json_text
from pipeline.metrics import Lpips
from pipeline.metrics.psnr import psnr
from pipeline.metrics.regions import interior
from pipeline.metrics.ssim import ssim
from pipeline.numba_kernels import threads
from pipeline.run.job import Job
from pipeline.splat import Gaussians, render
from pipeline.store.digest import write_atomically
from pipeline.studies.tables import METRICS
from pipeline.studies.variants import Result

SIDE = 512  # pixels of the picture that speed is measured at
REPEATS, POSES = 15, 4  # frames that are timed, and poses that they take in turn

Numbers = dict[str, float]
Posed = Callable[[int], Gaussians]  # frame -> an avatar's Gaussians in that frame's pose


class MeasurementCache:
    """Small dictionaries of numbers in one folder; a name must say all that its numbers depend on."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def read(self, name: str) -> Numbers | None:
        """The numbers under a name; None where there are none, or none that can be read."""
        try:
            text = (self.folder / f"{name}.json").read_text(encoding="utf-8")
            return {key: float(value) for key, value in json.loads(text).items()}
        except (OSError, ValueError, TypeError, AttributeError):
            return None

    def write(self, name: str, numbers: Mapping[str, float]) -> Numbers:
        """Keeps the finite ones of some numbers, and returns them."""
        self.folder.mkdir(parents=True, exist_ok=True)
        known = {key: value for key, value in numbers.items() if math.isfinite(value)}
        write_atomically(self.folder / f"{name}.json", json_text(known))
        return known


class AvatarMeter:
    """Measures avatars on the frames and cameras of one ingested clip; both kinds of study share its cache.

    Args:
        job: of the study's base, for the places and evaluate's background.
        ingest: the clip's folder.
    """

    def __init__(self, job: Job, ingest: Path) -> None:
        background = job.settings["evaluate"].background
        self.background = background if background in BACKGROUNDS else "black"
        self.ingest, self.body = ingest, load_body(job.workspace.body_file)
        self.lpips = Lpips(require(job.workspace, "lpips"), "alex")
        self.cache = MeasurementCache(job.workspace.data / "studies" / "measured" / job.subject.name)

    def measured(self, result: Result) -> Result:
        """A result whose means are PSNR, PSNR inside the mask, SSIM and LPIPS of held-out frames.

        Poses are those of the result's own fit; the camera is the clip's, so that pictures have its size. A
        failure stays what it is.
        """
        if result.failure:
            return result
        train, fit = (result.folders[stage].name for stage in ("train", "fit"))
        name = f"quality_{train}_{fit}_{self.ingest.name}_{self.background}"
        quality = self.cache.read(name) or self.cache.write(name, self._quality(result))
        return dataclasses.replace(result, means={"avatar": quality})

    @torch.no_grad()
    def _quality(self, result: Result) -> Numbers:
        clip, posed = self._posed(result)
        rows = [self._frame_quality(posed(frame), clip, frame) for frame in clip.split.test]
        return pd.DataFrame(rows).mean().to_dict()

    def _frame_quality(self, gaussians: Gaussians, clip: FittedClip, frame: int) -> Numbers:
        rendering, mask = render(gaussians, clip.cameras[frame]), clip.mask(frame)

        def pair(background: str) -> tuple[torch.Tensor, torch.Tensor]:
            shown = over(rendering.color.float(), rendering.alpha.float(), background).clamp(0, 1)
            return shown, composite_frame(clip.colors(frame), mask, background)

        shown, truth = pair(self.background)
        return {
            "psnr": psnr(shown, truth),
            "psnr_interior": psnr(*pair(BLACK), interior(mask)),
            "ssim": ssim(shown, truth, BACKGROUNDS[self.background]),
            "lpips_alex": float(self.lpips(shown, truth)),
        }

    @torch.no_grad()
    def _posed(self, result: Result) -> tuple[FittedClip, Posed]:
        """The clip with the poses of a result's own fit, and the baked avatar in them."""
        clip = read_fitted_clip(self.ingest, result.folders["fit"], self.body)
        baked = bake(load_avatar(result.folders["train"] / "avatar.safetensors", self.body))
        return clip, lambda frame: baked.gaussians(clip.pose(frame), clip.seconds.get(frame))

    def speeds(self, results: Iterable[Result]) -> dict[Path, Numbers]:
        """Size and time of a frame of each finished avatar: folder of the train version -> numbers.

        Avatars that are not in the cache take turns, frame by frame, in this process and on one thread: what
        else the machine does then falls on all alike. The least of ``REPEATS`` frames is taken.

        Returns:
            ``gaussians``; ``asset_mib``, a Gaussian's mean, opacity, scale, rotation and colour in float32;
            ``animation_ms`` and ``rendering_ms``, processor milliseconds.
        """
        avatars = {one.folders["train"]: one for one in results if not one.failure}
        entries = {folder: f"speed_{folder.name}_{self.ingest.name}_{SIDE}" for folder in avatars}
        found = {folder: self.cache.read(entry) for folder, entry in entries.items()}
        unknown = {folder: self._posed(avatars[folder]) for folder, known in found.items() if known is None}
        if unknown:
            print(f"timing {len(unknown)} avatars in motion", flush=True)
            with threads(1):
                timed = self._timed(unknown)
            found |= {folder: self.cache.write(entries[folder], numbers) for folder, numbers in timed.items()}
        return {folder: numbers for folder, numbers in found.items() if numbers is not None}

    @torch.no_grad()
    def _timed(self, avatars: Mapping[Path, tuple[FittedClip, Posed]]) -> dict[Path, Numbers]:
        clip, _ = next(iter(avatars.values()))
        frames = clip.spread(POSES, "test") or clip.spread(POSES)
        whole, rows = clip.cameras[frames[0]], []
        side = min(whole.width, whole.height)  # the picture's middle is drawn
        camera = whole.cropped((whole.width - side) // 2, (whole.height - side) // 2, side, side)
        camera = camera.resized(SIDE, SIDE)
        for repeat in range(1 + REPEATS):
            for folder, (_, posed) in avatars.items():
                start = time.process_time()
                gaussians = posed(frames[repeat % len(frames)])
                middle = time.process_time()
                render(gaussians, camera)
                took = {"animation_ms": middle - start, "rendering_ms": time.process_time() - middle}
                size = 4 * sum(tensor.numel() for tensor in gaussians.tensors()) / 2**20
                told = {"folder": folder, "gaussians": float(len(gaussians.means)), "asset_mib": size}
                rows.append(told | {key: 1e3 * seconds for key, seconds in took.items()})
        timed = pd.DataFrame(rows[len(avatars) :])  # the first frames compiled and warmed up
        return timed.groupby("folder").min().to_dict("index")


def score_table(
    results: Mapping[Any, Result], speeds: Mapping[Path, Numbers], method: str = "avatar"
) -> pd.DataFrame:
    """A row a result: its scores of held-out frames, what it took to make it, and what a frame of it costs.

    Args:
        results: by the row's label; failures too, whose scores are NaN.
        speeds: as ``AvatarMeter.speeds`` gives them.
        method: of evaluate, whose scores count.

    Returns:
        Columns are ``result`` and the keys of ``METRICS``; ``train_s`` and ``whole_s`` are processor seconds.
    """
    rows = [
        {
            **one.means.get(method, {}),
            **speeds.get(one.folders.get("train", Path()), {}),
            "train_s": one.training_cost,
            "whole_s": math.nan if one.failure else sum(one.cpu_seconds.values()),
        }
        for one in results.values()
    ]
    scores = pd.DataFrame(rows, pd.Index(list(results)), list(METRICS), dtype=float)
    scores["result"] = pd.Series(list(results.values()), scores.index, dtype=object)
    scores["total_ms"] = scores["animation_ms"] + scores["rendering_ms"]
    scores["fps"] = 1e3 / scores["total_ms"]
    return scores
