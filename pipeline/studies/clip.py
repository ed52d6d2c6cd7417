"""Measuring a finished avatar on a clip: its quality at another picture size than its own, and its speed.

evaluate measures at the size that the avatar learnt from; numbers of two sizes cannot be compared. So a
study measures every avatar that learnt from other pictures than the base on the base's pictures, by
evaluate's metrics (``pipeline.metrics``). Speed is that of the baked avatar (``pipeline.avatar.bake``) in
held-out poses, drawn for the base's camera at 512 pixels, as the paper's runtime table.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import torch

from pipeline.avatar import load_avatar
from pipeline.avatar.bake import BakedAvatar, bake
from pipeline.body import load_body, read_poses
from pipeline.camera import Camera
from pipeline.frames import read_frame, read_mask
from pipeline.metrics import Lpips
from pipeline.metrics.image import psnr, ssim
from pipeline.metrics.protocol import BACKGROUNDS, BLACK, composite, interior, over
from pipeline.records import read_cameras, read_footage, read_split
from pipeline.splat import Gaussians, render
from pipeline.studies.notes import Notes, Numbers
from pipeline.study import Outcome
from pipeline.threads import threads

SIDE = 512  # pixels of the picture that speed is measured at
REPEATS, POSES = 15, 4  # frames that are timed, and poses that they take in turn


@dataclasses.dataclass(frozen=True)
class Clip:
    """What avatars are measured on.

    Attributes:
        ingest: the folder that ingest published.
        body_file: the body model.
        background: what avatar and truth are composited on.
        lpips: AlexNet's.
    """

    ingest: Path
    body_file: Path
    background: str
    lpips: Lpips

    @property
    def key(self) -> str:
        """What its numbers hang on."""
        return f"{self.ingest.name}_{self.background}"


def quality(outcome: Outcome, clip: Clip) -> Numbers:
    """PSNR, PSNR inside the mask, SSIM and LPIPS of the held-out frames of ``clip``, means.

    Poses are those of the outcome's own fit; the camera is the clip's, so that the picture has its size.
    """
    cameras, held_out = (
        read_cameras(clip.ingest / "cameras.parquet"),
        read_split(clip.ingest / "split.json").test,
    )
    seconds = _seconds(clip.ingest, sorted(cameras))
    poses, baked = read_poses(outcome.folders["fit"] / "poses.parquet"), _baked(outcome, clip.body_file)
    rows = []
    for frame in held_out:
        gaussians = _posed(baked, poses, frame, seconds.get(frame))
        rows.append(_frame_quality(gaussians, cameras[frame], frame, clip))
    names = rows[0] if rows else ()
    return {name: _mean([row[name] for row in rows]) for name in names}


@torch.no_grad()
def _frame_quality(gaussians: Gaussians, camera: Camera, frame: int, clip: Clip) -> Numbers:
    rendering = render(gaussians, camera)
    mask = read_mask(clip.ingest / "masks", frame)
    person = partial(composite, read_frame(clip.ingest / "frames", frame), mask)

    def picture(background: str) -> torch.Tensor:
        return over(rendering.color.float(), rendering.alpha.float(), background).clamp(0, 1)

    shown, truth = picture(clip.background), person(clip.background)
    features = [clip.lpips.features(one) for one in (shown, truth)]
    return {
        "psnr": psnr(shown, truth),
        "psnr_interior": psnr(picture(BLACK), person(BLACK), interior(mask)),
        "ssim": ssim(shown, truth, BACKGROUNDS[clip.background]),
        "lpips_alex": float(clip.lpips.distance(*features)),
    }


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if value == value]
    return sum(known) / len(known) if known else float("nan")


def _seconds(ingest: Path, frames: Sequence[int]) -> Mapping[int, float]:
    return dict(zip(frames, read_footage(ingest / "footage.json").seconds, strict=False))


def _baked(outcome: Outcome, body_file: Path) -> BakedAvatar:
    return bake(load_avatar(outcome.folders["train"] / "avatar.safetensors", load_body(body_file)))


def _posed(baked: BakedAvatar, poses, frame: int, seconds: float | None) -> Gaussians:
    return baked.gaussians(poses.pose(frame), seconds)


def speeds(outcomes: Sequence[Outcome], clip: Clip, notes: Notes) -> dict[str, Numbers]:
    """What a frame of each finished avatar costs: train key -> numbers, measured where not noted.

    Avatars that are measured take turns, frame by frame, in this process and on one thread: what else the
    machine does then falls on all alike. The least processor time of ``REPEATS`` frames is taken.

    Returns:
        ``gaussians``; ``asset_mib``, a Gaussian's mean, opacity, scale, rotation and colour in float32;
        ``animation_ms`` and ``rendering_ms``, processor milliseconds.
    """
    by_key = {one.folders["train"].name: one for one in outcomes}
    known = {key: notes.read(speed_name(key, clip)) for key in by_key}
    missing = {key: one for key, one in by_key.items() if known[key] is None}
    if missing:
        with threads(1):
            for key, numbers in _race(missing, clip).items():
                notes.write(speed_name(key, clip), numbers)
                known[key] = numbers
    return {key: numbers for key, numbers in known.items() if numbers is not None}


def speed_name(train: str, clip: Clip) -> str:
    """What the speed of an avatar is noted under."""
    return f"speed_{train}_{clip.ingest.name}_{SIDE}"


def quality_name(outcome: Outcome, clip: Clip) -> str:
    """What the quality of an avatar on a clip is noted under."""
    return f"quality_{outcome.folders['train'].name}_{outcome.folders['fit'].name}_{clip.key}"


@torch.no_grad()
def _race(outcomes: Mapping[str, Outcome], clip: Clip) -> dict[str, Numbers]:
    cameras = read_cameras(clip.ingest / "cameras.parquet")
    split = read_split(clip.ingest / "split.json")
    frames = (split.test or split.train)[:: max(1, len(split.test or split.train) // POSES)][:POSES]
    seconds, camera = _seconds(clip.ingest, sorted(cameras)), _square(cameras[frames[0]])
    runners = {
        key: (_baked(one, clip.body_file), read_poses(one.folders["fit"] / "poses.parquet"))
        for key, one in outcomes.items()
    }
    times: dict[str, list[tuple[float, float]]] = {key: [] for key in runners}
    found: dict[str, Numbers] = {}
    for repeat in range(REPEATS + 1):
        frame = frames[repeat % len(frames)]
        for key, (baked, poses) in runners.items():
            start = time.process_time()
            gaussians = _posed(baked, poses, frame, seconds.get(frame))
            middle = time.process_time()
            render(gaussians, camera)
            end = time.process_time()
            if repeat:  # the first turn compiles and warms up
                times[key].append((1e3 * (middle - start), 1e3 * (end - middle)))
            else:
                found[key] = _size(gaussians)
    for key, pairs in times.items():
        found[key]["animation_ms"] = min(one for one, _ in pairs)
        found[key]["rendering_ms"] = min(one for _, one in pairs)
    return found


def _size(gaussians: Gaussians) -> Numbers:
    count = sum(tensor.numel() * 4 for tensor in gaussians.tensors())
    return {"gaussians": float(len(gaussians.means)), "asset_mib": count / 2**20}


def _square(camera: Camera) -> Camera:
    """The camera's middle as a picture of ``SIDE`` x ``SIDE`` pixels."""
    side = min(camera.width, camera.height)
    cropped = camera.cropped((camera.width - side) // 2, (camera.height - side) // 2, side, side)
    return cropped.resized(SIDE, SIDE)
