"""The CUDA path beside the CPU's, and its speed: one command, under four minutes once gsplat is built.

Holds: docs/results.md, "On a GPU". On a mannequin both devices start from the same weights: their pictures
and gradients are compared, and what one hundred steps have made of them. Then a training step and an animated
frame are timed, and the sample clip is trained, for both representations. Rounding differs between devices:
``LIMITS`` says up to where they agree.

Without a GPU it says so and ends with status 1. Footage and weights are fetched first (``doit run assets``).
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib.util
import itertools
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from benchmarks import frame
from benchmarks.avatars import avatar_camera, avatar_of, bases_avatar_of
from benchmarks.representations import folder_of, training
from benchmarks.step import Frame, adam, frames_of, photometric, regularisers
from pipeline.avatar import Avatar
from pipeline.body import Pose
from pipeline.clip.camera import Camera, facing_camera
from pipeline.clip.curves import read_curve
from pipeline.clip.plan import read_plan
from pipeline.config.request import parse_request
from pipeline.device import moved
from pipeline.errors import UserError
from pipeline.run.job import Job, open_job
from pipeline.splat import Gaussians, render
from stages.train.data import TrainingData, read_training_data
from stages.train.held_out import held_out_psnr
from stages.train.initial_avatar import initial_avatar
from stages.train.loop import Trainer
from stages.train.poses import PoseRefinement
from stages.train.settings import TrainSettings, apply_plan

REPRESENTATIONS = ("bases", "triplane")
MANNEQUIN, SAMPLE = "mannequin_head", "smile"
SMALL_MANNEQUIN = {"ingest.mannequin_frames": "24", "ingest.mannequin_views": "", "fit.iterations": "100"}
ALL_FROM_THE_START = {
    "pose_heads_from": 0.0, "residual_from": 0.0, "refine_from": 0.0, "subdivide_from": 0.0,
    "half_precision": False,  # which a GPU rounds otherwise
    "lpips": 0.0,  # plain torch on both
}  # fmt: skip
STEPS, QUICK_STEPS = 100, 5
COUNTS, QUICK_COUNTS = (20_000, 84_000, 167_000), (5_000,)
BATCHES = (1, 8)
SIZE, QUICK_SIZE = 512, 128
REPEATS, QUICK_REPEATS = 5, 1
AWAKE = 0.02  # standard deviation that is added to every weight, so that no head is silent

LIMITS = {"picture": 1e-3, "gradients": 0.05, "dB": 0.3}
"""Up to where the devices agree: mean absolute difference of colours, largest relative difference of any
weight's gradient (Frobenius norms), and difference in held-out PSNR after all steps."""


def measure(options: argparse.Namespace, report: frame.Report) -> str:
    """Compares, times and trains."""
    start = time.monotonic()
    device = require_gpu()
    built = seconds(lambda: draw_one(device), device)
    report.add({"device": name_of(device), "gsplat built and loaded, s": built}, "device")
    sample, effort = (MANNEQUIN, {"train.effort": "0.05"}) if options.quick else (SAMPLE, {})
    with frame.settings_of(options) as words:
        jobs = [(one, job_of(sample, {**words, **effort}, one)) for one in REPRESENTATIONS]
        fetch_assets(jobs[0][1])  # what cannot be fetched is found out before anything is measured
        for representation in REPRESENTATIONS:
            data, settings = fitted_mannequin(words, representation)
            steps = QUICK_STEPS if options.quick else STEPS
            report.add(compare(data, settings, device, steps), "apart")
        for count in options.gaussians or (QUICK_COUNTS if options.quick else COUNTS):
            for representation in REPRESENTATIONS:
                for row in timings(count, representation, device, options):
                    report.add(row, "times")
        for representation, job in jobs:
            report.add(trained(job, representation), "trained")
    return headline(report, time.monotonic() - start - built)


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of this benchmark."""
    parser.add_argument("--gaussians", type=int, nargs="+", metavar="N", help="the counts to time")
    parser.add_argument("--size", type=int, metavar="PIXELS", help="of the pictures that are timed")
    parser.add_argument("--repeats", type=int, help="of what is timed; the least counts")
    frame.stage_options(parser)


# The device


def require_gpu() -> torch.device:
    """The GPU.

    Raises:
        UserError: torch finds none, or gsplat is not installed.
    """
    if not torch.cuda.is_available():
        build = "was built for the CPU" if torch.version.cuda is None else "finds none that it can use"
        raise UserError(
            f"there is no GPU here (torch {torch.__version__} {build}): run this where nvidia-smi lists one, "
            "with a CUDA build of torch"
        )
    if importlib.util.find_spec("gsplat") is None:
        raise UserError("gsplat, which renders on the GPU, is not installed: pip install -e '.[gpu]'")
    return torch.device("cuda")


def name_of(device: torch.device) -> str:
    """The GPU's name and torch's CUDA."""
    if device.type != "cuda":
        return str(device)
    return f"{torch.cuda.get_device_name()}, CUDA {torch.version.cuda}"


def seconds(job: Callable[[], object], device: torch.device) -> float:
    """The seconds that a call takes until the device has done all of it."""
    wait_for(device)
    start = time.perf_counter()
    job()
    wait_for(device)
    return time.perf_counter() - start


def wait_for(device: torch.device) -> None:
    """Returns when the device has done what it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize()


def draw_one(device: torch.device) -> None:
    """Draws one Gaussian, for which gsplat is built where it never was."""
    one = torch.tensor([[0.0, 0.0, -2.0]]), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.1)
    render(moved(Gaussians(*one, torch.ones(1, 3), torch.tensor([0.9])), device), facing_camera(16, 16, 16.0))


# Both devices on a mannequin


def job_of(subject: str, words: Mapping[str, str], representation: str) -> Job:
    """The job of a subject that is trained on the GPU; a mannequin is a small one."""
    small = SMALL_MANNEQUIN if subject == MANNEQUIN else {}
    own = {"train.device": "cuda", "train.representation": representation}
    return open_job(subject, parse_request({**small, **own, **words}, subject))


def fetch_assets(job: Job) -> None:
    """Fetches what training needs; UserError where it cannot."""
    for stage in job.upstream_first(["train"]):
        for name in job.needed_assets(stage):
            frame.asset_folder(job.workspace, name)


def fitted_mannequin(words: Mapping[str, str], representation: str) -> tuple[TrainingData, TrainSettings]:
    """A mannequin as training reads it, and the settings under which everything takes part at once."""
    job = job_of(MANNEQUIN, words, representation)
    made = {stage: artifact.folder for stage, artifact in frame.made(job, "plan").items()}
    asked: TrainSettings = job.settings["train"]
    data = read_training_data(made["ingest"], made["fit"], None, job.workspace.body_file, asked.crop_margin)
    settings = apply_plan(asked, read_plan(made["plan"] / "plan.json"))
    return data, dataclasses.replace(settings, **ALL_FROM_THE_START)


def compare(data: TrainingData, settings: TrainSettings, device: torch.device, steps: int) -> dict[str, Any]:
    """A row: how far the devices are apart in pictures, gradients and what steps make of the weights."""
    cpu, gpu = (trainer_on(place, data, settings) for place in (torch.device("cpu"), device))
    pictures = [apart(*pair) for pair in zip(pictures_of(cpu), pictures_of(gpu), strict=True)]
    for one in (cpu, gpu):
        one.step()
    gradients = gradients_apart(cpu, gpu)
    worst = max(gradients, key=lambda name: gradients[name])
    places = (cpu, torch.device("cpu")), (gpu, device)
    spent = [seconds(lambda one=one: [one.step() for _ in range(steps - 1)], place) for one, place in places]
    scores = [held_out_psnr(one, data.clip.split.test) for one in (cpu, gpu)]
    row = {
        "representation": settings.representation, "Gaussians": len(cpu.avatar),
        "picture": sum(mean for mean, _ in pictures) / len(pictures),
        "largest": max(largest for _, largest in pictures),
        "gradients": gradients[worst], "worst": worst,
        "steps": steps, "CPU dB": scores[0], "GPU dB": scores[1], "dB": scores[1] - scores[0],
        "CPU s": spent[0], "GPU s": spent[1], "each": gradients,
    }  # fmt: skip
    return {**row, "agree": all(abs(row[name]) <= limit for name, limit in LIMITS.items())}


def trainer_on(place: torch.device, data: TrainingData, settings: TrainSettings) -> Trainer:
    """A trainer on a device; its weights are made on the CPU, always alike."""
    train = data.clip.split.train
    avatar, data = initial_avatar(data, PoseRefinement(data.poses, train), settings)
    generator = torch.Generator().manual_seed(5)
    for _, parameter in sorted(avatar.named_parameters()):
        parameter.data += AWAKE * torch.randn(parameter.shape, generator=generator)
    return Trainer(avatar.to(place), PoseRefinement(moved(data.poses, place), train), data, settings)


@torch.no_grad()
def pictures_of(trainer: Trainer) -> list[Tensor]:
    """The held-out frames as the avatar shows them, on the CPU, [H, W, 3] each."""
    avatar, data = trainer.avatar, trainer.data
    decoded = avatar.decode(trainer.level)
    found = []
    for number in data.clip.split.test:
        posed = avatar.pose(decoded, trainer.poses.fitted(number), time=data.clip.seconds.get(number))
        found.append(render(posed.gaussians, moved(data.whole[number].camera, avatar.device)).color.cpu())
    return found


def apart(picture: Tensor, other: Tensor) -> tuple[float, float]:
    """The mean and the largest absolute difference of two pictures."""
    difference = (picture - other).abs()
    return float(difference.mean()), float(difference.max())


def gradients_apart(cpu: Trainer, gpu: Trainer) -> dict[str, float]:
    """Parameter -> relative difference of its gradients, of those that have one; of all poses as one."""
    ours, theirs = gradients_of(cpu), gradients_of(gpu)
    if ours.keys() != theirs.keys():
        raise UserError(f"only one device has gradients of {', '.join(sorted(ours.keys() ^ theirs.keys()))}")
    return {
        name: float((ours[name] - theirs[name]).norm() / ours[name].norm().clamp_min(1e-12)) for name in ours
    }


def gradients_of(trainer: Trainer) -> dict[str, Tensor]:
    """Parameter -> its gradient, flat, on the CPU."""
    poses = [one.grad for _, one in sorted(trainer.poses.named_parameters()) if one.grad is not None]
    found = {name: one.grad for name, one in trainer.avatar.named_parameters() if one.grad is not None}
    whole = {"poses": torch.cat([one.flatten() for one in poses])} if poses else {}
    return {name: gradient.detach().cpu().flatten() for name, gradient in {**found, **whole}.items()}


# Speed


def timings(
    count: int, representation: str, device: torch.device, options: argparse.Namespace
) -> list[dict[str, Any]]:
    """A row for each batch of a training step, and one for an animated frame."""
    size = options.size or (QUICK_SIZE if options.quick else SIZE)
    repeats = options.repeats or (QUICK_REPEATS if options.quick else REPEATS)
    make = bases_avatar_of if representation == "bases" else avatar_of
    avatar = make(count).to(device)
    frames = frames_of(avatar, max(BATCHES), size)
    optimizer = adam(avatar, fused=True)
    case = {"representation": representation, "Gaussians": len(avatar), "size": size}
    rows = []
    for batch in BATCHES:
        job = timed_job(lambda batch=batch: take_step(avatar, optimizer, frames[:batch]), device, repeats)
        rows.append({**case, "what": "step", "batch": batch, **job})
    turns, camera = itertools.cycle([one.pose for one in frames]), moved(avatar_camera(size), device)
    avatar.eval()
    shown = timed_job(lambda: show(avatar, next(turns), camera), device, repeats)
    return [*rows, {**case, "what": "frame", "batch": 1, **shown}]


def timed_job(job: Callable[[], object], device: torch.device, repeats: int) -> dict[str, Any]:
    """The least milliseconds of a job after a first call, and the most of the GPU's memory that it took."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats()
    taken = [1e3 * seconds(job, device) for _ in range(repeats + 1)][1:]
    memory = torch.cuda.max_memory_allocated() / 2**20 if device.type == "cuda" else None
    return {"ms": min(taken), "MiB": memory, "all": taken}


def take_step(avatar: Avatar, optimizer: torch.optim.Optimizer, frames: list[Frame]) -> None:
    """One optimiser step over some frames, as training takes it."""
    seen = avatar.architecture.representation == "triplane"  # see train.pose_seen_only
    decoded, losses = avatar.decode(), []
    for one in frames:
        posed = avatar.pose(decoded, one.pose, rows=one.seen if seen else None)
        picture = photometric(render(posed.gaussians, one.camera), one.target, one.background)
        losses.append(picture + regularisers(decoded, posed))
    (torch.stack(losses).sum() / len(frames)).backward()
    optimizer.step()
    optimizer.zero_grad(set_to_none=True)


@torch.no_grad()
def show(avatar: Avatar, pose: Pose, camera: Camera) -> None:
    """One animated frame."""
    render(avatar.gaussians(pose), camera)


# Training


def trained(job: Job, representation: str) -> dict[str, Any]:
    """A row: the training of a subject, and its last held-out PSNR."""
    frame.made(job, "train")
    curve = read_curve(folder_of(job, "train") / "curve.parquet", "run this again with other --artifacts")
    return {
        "subject": job.subject.name, "representation": representation, **training(job),
        "psnr": curve["psnr"][-1][1] if "psnr" in curve else None,
    }  # fmt: skip


def headline(report: frame.Report, spent: float) -> str:
    """All of it in a line."""
    tables = report.tables
    apart = tables["apart"]
    verdict = "agree" if all(row["agree"] for row in apart) else "DO NOT AGREE"
    worst = {name: max(abs(row[name]) for row in apart) for name in LIMITS}
    counts = sorted({row["Gaussians"] for row in tables["times"]})
    count = counts[len(counts) // 2]
    steps = {
        row["representation"]: row["ms"]
        for row in tables["times"]
        if (row["Gaussians"], row["what"], row["batch"]) == (count, "step", 1)
    }
    timed = ", ".join(f"{name} {value:.1f} ms" for name, value in steps.items())
    learnt = ", ".join(f"{row['representation']} {row['wall s']:.0f} s" for row in tables["trained"])
    return (
        f"the devices {verdict} (pictures {worst['picture']:.1e}, gradients {worst['gradients']:.1e}, "
        f"{apart[0]['steps']} steps {worst['dB']:.2f} dB); a step at {count}: {timed}; "
        f"{tables['trained'][0]['subject']}: {learnt}; {spent:.0f} s in all"
    )


def main(arguments: list[str] | None = None) -> int:
    """Runs the benchmark."""
    return frame.run("gpu", __doc__, measure, arguments, options=add_options)


if __name__ == "__main__":
    sys.exit(main())
