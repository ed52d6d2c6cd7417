"""Quality and speed of finished avatars on one clip, measured once.

evaluate measures at the size that the avatar learnt from; numbers of two sizes cannot be compared. So a
study measures every avatar on its base's pictures, by evaluate's metrics (``pipeline.metrics``). Speed is
that of the baked avatar (``pipeline.avatar.bake``) in held-out poses, drawn for the base's camera at 512
pixels, as in the paper's runtime table.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import pandas as pd
import torch

from pipeline.avatar import load_avatar
from pipeline.avatar.bake import bake
from pipeline.body import load_body, read_poses
from pipeline.clip.camera import Camera
from pipeline.clip.composite import BACKGROUNDS, BLACK, composite_frame, over
from pipeline.clip.frames import read_frame, read_mask
from pipeline.clip.records import read_cameras, read_footage, read_split
from pipeline.config.assets import require
from pipeline.files.json_files import json_text
from pipeline.metrics import Lpips
from pipeline.metrics.person_pixels import interior
from pipeline.metrics.psnr import psnr
from pipeline.metrics.ssim import ssim
from pipeline.numba_kernels import threads
from pipeline.run.job import Job
from pipeline.splat import Gaussians, render
from pipeline.store.digest import write_atomically
from pipeline.studies.variants import Result

SIDE = 512  # pixels of the picture that speed is measured at
REPEATS, POSES = 15, 4  # frames that are timed, and poses that they take in turn

Numbers = dict[str, float]


class MeasurementCache:
    """Small dictionaries of numbers in one folder; a name must say all that its numbers depend on."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def read(self, name: str) -> Numbers | None:
        """The numbers under a name; None where there are none, or none that can be read."""
        try:
            value = json.loads((self.folder / f"{name}.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        known = isinstance(value, dict) and all(isinstance(one, (int, float)) for one in value.values())
        return value if known else None

    def write(self, name: str, numbers: Mapping[str, float]) -> Numbers:
        """Keeps the finite ones of some numbers, and returns them."""
        self.folder.mkdir(parents=True, exist_ok=True)
        known = {key: value for key, value in numbers.items() if math.isfinite(value)}
        write_atomically(self.folder / f"{name}.json", json_text(known))
        return known

    def get(self, name: str, measure: Callable[[], Mapping[str, float]]) -> Numbers:
        """The numbers under a name, measured now if there are none."""
        known = self.read(name)
        return self.write(name, measure()) if known is None else known


class AvatarMeter:
    """Measures avatars on the frames and cameras of one ingested clip; both kinds of study share its cache.

    Args:
        job: of the study's base, for the places and evaluate's background.
        ingest: the clip's folder.
    """

    def __init__(self, job: Job, ingest: Path) -> None:
        background = getattr(job.settings["evaluate"], "background", "black")
        self.background = background if background in ("black", "white") else "black"
        self.ingest, self.body_file = ingest, job.workspace.body_file
        self.lpips = Lpips(require(job.workspace, "lpips"), "alex")
        self.cache = MeasurementCache(job.workspace.data / "studies" / "measured" / job.subject.name)
        self.cameras = read_cameras(ingest / "cameras.parquet")
        self.split = read_split(ingest / "split.json")
        seconds = read_footage(ingest / "footage.json").seconds
        self.seconds = dict(zip(sorted(self.cameras), seconds, strict=False))

    def quality(self, result: Result) -> Numbers:
        """PSNR, PSNR inside the mask, SSIM and LPIPS, means over the clip's held-out frames.

        Poses are those of the result's own fit; the camera is the clip's, so that pictures have its size.
        """
        train, fit = (result.folders[stage].name for stage in ("train", "fit"))
        name = f"quality_{train}_{fit}_{self.ingest.name}_{self.background}"
        return self.cache.get(name, lambda: self._quality(result))

    def _quality(self, result: Result) -> Numbers:
        posed = self._posed(result)
        rows = [self._frame_quality(posed(frame), frame) for frame in self.split.test]
        return pd.DataFrame(rows).mean().to_dict()

    @torch.no_grad()
    def _frame_quality(self, gaussians: Gaussians, frame: int) -> Numbers:
        rendering = render(gaussians, self.cameras[frame])
        mask = read_mask(self.ingest / "masks", frame)
        person = partial(composite_frame, read_frame(self.ingest / "frames", frame), mask)

        def picture(background: str) -> torch.Tensor:
            return over(rendering.color.float(), rendering.alpha.float(), background).clamp(0, 1)

        shown, truth = picture(self.background), person(self.background)
        return {
            "psnr": psnr(shown, truth),
            "psnr_interior": psnr(picture(BLACK), person(BLACK), interior(mask)),
            "ssim": ssim(shown, truth, BACKGROUNDS[self.background]),
            "lpips_alex": float(self.lpips.distance(*map(self.lpips.features, (shown, truth)))),
        }

    @torch.no_grad()
    def _posed(self, result: Result) -> Callable[[int], Gaussians]:
        """A function: frame -> the baked avatar's Gaussians in that frame's fitted pose."""
        baked = bake(load_avatar(result.folders["train"] / "avatar.safetensors", load_body(self.body_file)))
        poses = read_poses(result.folders["fit"] / "poses.parquet")

        @torch.no_grad()
        def posed(frame: int) -> Gaussians:
            return baked.gaussians(poses.pose(frame), self.seconds.get(frame))

        return posed

    def speeds(self, results: Sequence[Result]) -> dict[str, Numbers]:
        """Size and time of a frame of each finished avatar: name of the train version -> numbers.

        Avatars that are not in the cache take turns, frame by frame, in this process and on one thread: what
        else the machine does then falls on all alike. The least of ``REPEATS`` frames is taken.

        Returns:
            ``gaussians``; ``asset_mib``, a Gaussian's mean, opacity, scale, rotation and colour in float32;
            ``animation_ms`` and ``rendering_ms``, processor milliseconds.
        """
        by_name = {one.folders["train"].name: one for one in results}
        entries = {name: f"speed_{name}_{self.ingest.name}_{SIDE}" for name in by_name}
        known = {name: self.cache.read(entry) for name, entry in entries.items()}
        unknown = {name: self._posed(by_name[name]) for name, numbers in known.items() if numbers is None}
        with threads(1):
            timed = self._timed(unknown) if unknown else {}
        known |= {name: self.cache.write(entries[name], numbers) for name, numbers in timed.items()}
        return {name: numbers for name, numbers in known.items() if numbers is not None}

    @torch.no_grad()
    def _timed(self, avatars: Mapping[str, Callable[[int], Gaussians]]) -> dict[str, Numbers]:
        held_out = self.split.test or self.split.train
        frames = held_out[:: max(1, len(held_out) // POSES)][:POSES]
        camera = square(self.cameras[frames[0]])
        found = {}
        for name, posed in avatars.items():  # the first frame compiles and warms up
            gaussians = posed(frames[0])
            render(gaussians, camera)
            floats = sum(tensor.numel() for tensor in gaussians.tensors())
            found[name] = {"gaussians": float(len(gaussians.means)), "asset_mib": 4 * floats / 2**20}
        for repeat in range(REPEATS):
            for name, posed in avatars.items():
                start = time.process_time()
                gaussians = posed(frames[(repeat + 1) % len(frames)])
                middle = time.process_time()
                render(gaussians, camera)
                took = {"animation_ms": middle - start, "rendering_ms": time.process_time() - middle}
                for key, seconds in took.items():
                    found[name][key] = min(1e3 * seconds, found[name].get(key, math.inf))
        return found


def square(camera: Camera) -> Camera:
    """The camera's middle as a picture of ``SIDE`` x ``SIDE`` pixels."""
    side = min(camera.width, camera.height)
    cropped = camera.cropped((camera.width - side) // 2, (camera.height - side) // 2, side, side)
    return cropped.resized(SIDE, SIDE)
