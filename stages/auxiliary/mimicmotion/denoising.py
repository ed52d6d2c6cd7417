"""Denoising the turn: one long latent video, tile by tile at every step, overlaps blended."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from pipeline.errors import UserError
from stages.auxiliary.folder import numbered, read_color
from stages.auxiliary.mimicmotion.model import Model, load_model

if TYPE_CHECKING:
    from pipeline.run.stage import Context

FPS, MOTION, NOISE = 6.0, 127.0, 0.0  # what the model is told: frame rate less one, motion, added noise
CHUNK = 8  # frames that are decoded together


@dataclasses.dataclass(frozen=True)
class Sampling:
    """Settings of the denoising: MimicMotion 1.1's numbers are the stage's defaults."""

    steps: int
    guidance: float
    tile: int
    overlap: int
    seed: int


def animate(context: Context, guidance: Path) -> Iterator[np.ndarray]:
    """The guidance folder's turn, one picture a pose: [H, W, 3] uint8 RGB.

    Raises:
        UserError: the weights cannot be read, or a side of the guidance is not divisible by 64.
    """
    settings = context.settings
    device = _device(settings.device)
    dtype = torch.float16 if settings.half_precision and device.type == "cuda" else torch.float32
    model = load_model(Path(settings.weights), device, dtype)
    context.log(f"MimicMotion on {device}, {dtype}")
    reference = read_color(guidance / "reference.png")
    poses = [read_color(guidance / "reference_pose.png")]
    poses += [read_color(path) for path in numbered(guidance / "poses").values()]
    if reference.shape[0] % 64 or reference.shape[1] % 64:
        raise UserError(f"{guidance}: width and height must be divisible by 64, not {reference.shape[:2]}")
    sampling = Sampling(
        settings.steps, settings.guidance_scale, settings.tile, settings.overlap, settings.seed
    )
    with context.progress(sampling.steps, "denoising") as progress:
        latents = denoise(model, to_tensor(reference), poses, sampling, progress.advance)
    return decoded(model, latents[1:])


@torch.no_grad()
def denoise(
    model: Model,
    reference: Tensor,  # [3, H, W]
    poses: list[np.ndarray],
    sampling: Sampling,
    step_done: Callable[[], None] = lambda: None,
) -> Tensor:
    """The latent video, frame 0 of which shows the reference's pose.

    Args:
        reference: the person, in [-1, 1].
        poses: F skeletons [H, W, 3] uint8, the reference's own first.
        sampling: steps, guidance, tiles, seed.
        step_done: called after each step.

    Returns:
        [F, 4, H / 8, W / 8].
    """
    dtype, device = model.pose_net.scale.dtype, model.device
    reference = reference.to(device)
    embedding, image = model.describe(reference).to(dtype), model.encode(reference).to(dtype)
    drawn = torch.stack([model.pose_net(to_tensor(pose)[None].to(device, dtype))[0] for pose in poses])
    scheduler = model.scheduler
    scheduler.set_timesteps(sampling.steps, device=device)
    generator = torch.Generator().manual_seed(sampling.seed)  # on the CPU: the same noise on every device
    noise = torch.randn((len(poses), *image.shape), generator=generator)
    latents = (noise * float(scheduler.init_noise_sigma)).to(device, dtype)
    times = torch.tensor([[FPS, MOTION, NOISE]], dtype=dtype, device=device)
    order = tiles(len(poses), sampling.tile, sampling.overlap)
    for timestep in scheduler.timesteps:
        scaled = scheduler.scale_model_input(latents, timestep)
        total, weight = torch.zeros_like(latents, dtype=torch.float32), torch.zeros(len(poses), device=device)
        for tile in order:
            answer = guided_noise(
                model, scaled[tile], timestep, embedding, image, times, drawn[tile], sampling.guidance
            )
            share = tile_weights(len(tile)).to(device)
            total[tile] += answer.float() * share.view(-1, 1, 1, 1)
            weight[tile] += share
        mean = (total / weight.view(-1, 1, 1, 1)).to(dtype)
        latents = scheduler.step(mean, timestep, latents).prev_sample
        step_done()
    return latents


def guided_noise(
    model: Model,
    noisy: Tensor,  # [F, 4, h, w]
    timestep: Tensor,
    embedding: Tensor,
    image: Tensor,
    times: Tensor,
    drawn: Tensor,
    guidance: float,
) -> Tensor:
    """One tile's prediction, pushed away from what the model says without picture and pose."""
    still = image.expand(len(noisy), -1, -1, -1)
    blank = torch.cat([noisy, torch.zeros_like(still)], dim=1)[None]
    free = model.predict(blank, timestep, torch.zeros_like(embedding), times, None)[0]
    bound = model.predict(torch.cat([noisy, still], dim=1)[None], timestep, embedding, times, drawn)[0]
    return free + guidance * (bound - free)


@torch.no_grad()
def decoded(model: Model, latents: Tensor) -> Iterator[np.ndarray]:
    """Pictures of latents, a few at a time: [H, W, 3] uint8 RGB each."""
    for start in range(0, len(latents), CHUNK):
        pictures = model.decode(latents[start : start + CHUNK])
        for picture in pictures:
            yield (picture * 255).round().byte().permute(1, 2, 0).cpu().numpy()


def to_tensor(image: np.ndarray) -> Tensor:
    """[H, W, 3] uint8 -> [3, H, W] float32 in [-1, 1]."""
    return torch.from_numpy(image).permute(2, 0, 1).float() / 127.5 - 1


def _device(name: str) -> torch.device:
    if name != "auto":
        return torch.device(name)
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def tiles(frames: int, size: int, overlap: int) -> list[list[int]]:
    """Frame numbers of each tile.

    Frame 0 shows the reference's own pose and leads every tile, so that each knows whom it shows; the
    others follow one another. Two neighbours have ``overlap`` frames in common, frame 0 among them, and the
    last two as many as it takes to end at the last frame.

    Args:
        frames: of the video, frame 0 included.
        size: frames of a tile; a shorter video is one tile.
        overlap: at least 1 and less than ``size - 1``.

    Raises:
        ValueError: the overlap leaves no way forward.
    """
    if frames <= size:
        return [list(range(frames))]
    if not 1 <= overlap < size - 1:
        raise ValueError(f"an overlap of {overlap} leaves tiles of {size} no way forward")
    last = frames - size
    starts = [*range(0, last, size - overlap), last]
    return [[0, *range(start + 1, start + size)] for start in starts]


def tile_weights(size: int) -> Tensor:
    """The weight of each place in a tile, [size]: a triangle, so that tiles fade into one another."""
    rising = (torch.arange(size) + 0.5) * 2 / size
    return torch.minimum(rising, 2 - rising)
