"""What the visibility gate and the plan are worth, on mannequins and real subjects in three framings.

    python -m benchmarks.visibility --subjects mannequin_head,smile --json FILE
    python -m benchmarks.visibility --quick                 one mannequin, a few iterations
    python -m benchmarks.visibility --only plans            every subject's plan, nothing is trained
    python -m benchmarks.visibility --only gradients --figure FOLDER

Subjects are read from the store, as ``doit run plan:NAME`` left them. Each variant trains for the same few
iterations, without subdivision unless asked, and is scored on the same few held-out frames. "off" means that
every body vertex carries a Gaussian from the start to the end. Seconds a step are medians over steps of all
variants in turn, after training, so that whatever else the machine does meets all of them alike.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import statistics
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from benchmarks.machine import described, prepare
from benchmarks.visibility_pictures import gradient_picture, unseen_error
from pipeline.avatar.otsu_threshold import evidence_threshold
from pipeline.clip.plan import EFFECTS, Plan, read_plan
from pipeline.config.request import parse_request
from pipeline.errors import UserError
from pipeline.metrics import Lpips, psnr, ssim
from pipeline.run.job import Job, open_job
from pipeline.splat import render
from stages.plan.measure import read_inputs, visibility
from stages.train.data import TrainingData, read_training_data
from stages.train.loop import Trainer
from stages.train.run import build_trainer
from stages.train.settings import TrainSettings, apply_plan
from stages.train.visibility_gate import VisibilityGate

SUBJECTS = ("mannequin_full", "mannequin_upper", "mannequin_head", "smile", "oliver", "balance")
ALL = (*SUBJECTS, "carphone")
HEAD_ONLY = ("mannequin_head", "smile")
VARIANTS: Mapping[str, Mapping[str, Any]] = {
    "on": {},
    "off": {"gate": False},
    "late": {"early_gate": False},
    "fixed 0.4": {"gate_threshold": 0.4},
    "fixed 0.6": {"gate_threshold": 0.6},
}


@dataclasses.dataclass(frozen=True)
class Subject:
    """A subject as the store has it.

    Attributes:
        name: the subject's.
        job: with every stage's settings.
        data: what train reads.
        plan: of the subject.
        clip: what the plan looked at.
    """

    name: str
    job: Job
    data: TrainingData
    plan: Plan
    folders: Mapping[str, Path]


def open_subject(name: str) -> Subject:
    """Reads a subject.

    Raises:
        UserError: the store has no plan of it under the present settings.
    """
    job = open_job(name, parse_request({}, name))
    folders = {}
    for stage in ("ingest", "fit", "plan"):
        artifact = job.find(stage)
        if artifact is None:
            raise UserError(f"{name} has no {stage} in the store: doit run plan:{name}")
        folders[stage] = artifact.folder
    plan, margin = read_plan(folders["plan"] / "plan.json"), TrainSettings().crop_margin
    data = read_training_data(folders["ingest"], folders["fit"], None, job.workspace.body_file, margin)
    return Subject(name, job, data, plan, folders)


def trainer_of(subject: Subject, settings: TrainSettings, plan: Plan | None = None) -> Trainer:
    """A trainer as the stage makes it."""
    return build_trainer(subject.data, settings if plan is None else apply_plan(settings, plan))


def scored(subject: Subject, trainer: Trainer, frames: tuple[int, ...], network: Lpips) -> dict[str, float]:
    """Held-out PSNR, SSIM and LPIPS of the person on black, and an animation's frame."""
    values: dict[str, list[float]] = {"psnr": [], "ssim": [], "lpips": [], "animation_ms": []}
    avatar = trainer.avatar.eval()
    clip = subject.data.clip
    with torch.no_grad():
        for frame in frames:
            pose, view = clip.pose(frame), subject.data.whole[frame]
            avatar.gaussians(pose, clip.seconds.get(frame))
            start = time.perf_counter()
            gaussians = avatar.gaussians(pose, clip.seconds.get(frame))
            values["animation_ms"].append(1e3 * (time.perf_counter() - start))
            image, truth = render(gaussians, view.camera).color.clamp(0, 1), view.composite(torch.zeros(3))
            values["psnr"].append(psnr(image, truth))
            values["ssim"].append(ssim(image, truth))
            values["lpips"].append(float(network(image, truth)[0]))
    avatar.train()
    means = {name: statistics.fmean(each) for name, each in values.items()}
    return means | {"animation_ms": min(values["animation_ms"]), "megabytes": megabytes(trainer)}


def megabytes(trainer: Trainer) -> float:
    """What the Gaussians of a finished avatar take: canonical constants, features and decoded values."""
    surface = trainer.avatar.surface()
    with torch.no_grad():
        decoded = trainer.avatar.decode()
    owners = (surface.canonical, surface.skinning_tables, decoded)
    tensors = [one for owner in owners for one in vars(owner).values() if isinstance(one, torch.Tensor)]
    for pair in (surface.samples, surface.neighbours):
        for matrix in (pair.matrix, pair.transpose):
            tensors += [matrix.values(), matrix.col_indices(), matrix.crow_indices()]
    return sum(one.numel() * one.element_size() for one in tensors) / 2**20


def in_turn(trainers: Mapping[str, Trainer], rounds: int) -> dict[str, float]:
    """Median CPU milliseconds of a step of each trainer, taken in turn."""
    spent: dict[str, list[float]] = {name: [] for name in trainers}
    for _ in range(rounds):
        for name, trainer in trainers.items():
            start = time.process_time()
            trainer.step()
            spent[name].append(1e3 * (time.process_time() - start))
    return {name: statistics.median(each) for name, each in spent.items()}


def compare(subject: Subject, options: argparse.Namespace, network: Lpips) -> list[dict[str, Any]]:
    """Trains every variant of one subject and scores it."""
    frames = subject.data.clip.spread(options.frames, "test")
    trainers, rows = {}, []
    for name in options.variants:
        forced = name == "forced"
        changes = {"gate": False} if forced else VARIANTS[name]
        settings = dataclasses.replace(
            TrainSettings(), iterations=options.iterations, subdivisions=options.subdivisions,
            subdivide_from=0.0, checkpoint_every=10**6, **changes,
        )  # fmt: skip
        start = time.process_time()
        trainer = trainer_of(subject, settings, None if forced else subject.plan)
        while trainer.iteration < options.iterations:
            trainer.step()
        row = {"subject": subject.name, "variant": name, "seconds": time.process_time() - start}
        row |= {"gaussians": len(trainer.avatar), **scored(subject, trainer, frames, network)}
        gate = trainer.hooks.get("gate")
        threshold = gate.threshold if isinstance(gate, VisibilityGate) else None
        row |= {"tau": threshold.tau if threshold else 0.0}
        row |= {"views": unseen_error(subject, trainer, options.figure)}
        rows.append(row)
        trainers[name] = trainer
        print(f"  {subject.name} {name}: {row['psnr']:.2f} dB, {row['gaussians']} Gaussians", flush=True)
    for name, value in in_turn(trainers, options.rounds).items():
        next(row for row in rows if row["variant"] == name)["step_ms"] = value
    return rows


def threshold_of(subject: Subject) -> dict[str, Any]:
    """The gate's threshold, from fitted poses."""
    inputs = read_inputs(subject.folders["ingest"], subject.folders["fit"], subject.job.workspace.body_file)
    scores, _ = visibility(inputs)
    return {"subject": subject.name, **dataclasses.asdict(evidence_threshold(scores))}


def print_rows(rows: list[dict[str, Any]]) -> None:
    """The table of variants."""
    print("\n| subject | gate | Gaussians | step, CPU ms | PSNR | SSIM | LPIPS | animation ms | MB | tau |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for row in rows:
        print(
            f"| {row['subject']} | {row['variant']} | {row['gaussians']} | {row['step_ms']:.0f} | "
            f"{row['psnr']:.2f} | {row['ssim']:.4f} | {row['lpips']:.4f} | {row['animation_ms']:.1f} | "
            f"{row['megabytes']:.1f} | {row['tau']:.2f} |"
        )
    for row in rows:
        for view, value in row["views"].items():
            print(f"{row['subject']} {row['variant']}, {view}: {value:.4f}")


def print_plans(subjects: list[Subject]) -> None:
    """Every subject's plan in one table: the number measured, bold where the effect is on."""
    print("\n| effect | threshold | " + " | ".join(one.name for one in subjects) + " |")
    print("|---" * (len(subjects) + 2) + "|")
    for effect in EFFECTS:
        made = [one.plan[effect] for one in subjects]
        cells = [f"**on** {one.measured:.3g}" if one.on else f"off {one.measured:.3g}" for one in made]
        print(f"| {effect} | {made[0].threshold:g} {made[0].unit} | {' | '.join(cells)} |")


def print_thresholds(found: list[dict[str, Any]]) -> None:
    """The gate's threshold of each subject, and why."""
    print("\n| subject | Otsu | eta | mu_0 | tau | cut | lost | why |")
    print("|---" * 8 + "|")
    for one in found:
        cells = [f"{one['otsu']:.2f}", f"{one['separability']:.2f}", f"{one['low_mean']:.3f}"]
        cells += [f"{one['tau']:.2f}", f"{one['cut']:.1%}", f"{one['lost']:.2%}"]
        print(f"| {one['subject']} | {' | '.join(cells)} | {one['why']} |")


def headline(rows: list[dict[str, Any]]) -> str:
    """One line: what the gate saves on heads, and what it costs."""
    parts = []
    for name in dict.fromkeys(row["subject"] for row in rows):
        own = {row["variant"]: row for row in rows if row["subject"] == name}
        if {"on", "off"} <= set(own):
            on, off = own["on"], own["off"]
            parts.append(
                f"{name}: {1 - on['gaussians'] / off['gaussians']:.0%} fewer Gaussians, "
                f"{1 - on['step_ms'] / off['step_ms']:.0%} less CPU time a step, "
                f"{on['psnr'] - off['psnr']:+.2f} dB"
            )
    return "; ".join(parts)


def parsed() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--subjects", type=lambda text: text.split(","), default=list(SUBJECTS))
    parser.add_argument("--variants", type=lambda text: text.split(","), default=["on", "off"])
    parser.add_argument("--iterations", type=int, default=200)
    parser.add_argument("--subdivisions", type=int, default=0)
    parser.add_argument("--frames", type=int, default=4, help="held-out frames that are scored")
    parser.add_argument("--rounds", type=int, default=9, help="timed steps of each variant")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--only", choices=("plans", "train", "gradients"))
    parser.add_argument("--figure", type=Path, help="folder for pictures")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--quick", action="store_true")
    options = parser.parse_args()
    if options.quick:
        options.subjects, options.iterations, options.frames, options.rounds = ["mannequin_head"], 20, 2, 3
    return options


def main() -> None:
    """Runs what is asked for."""
    options = parsed()
    prepare("benchmarks.visibility", options.threads)
    print(described())
    subjects = [open_subject(name) for name in options.subjects]
    result: dict[str, Any] = {"machine": described(), "rows": [], "thresholds": [], "gradients": {}}
    if options.only in (None, "plans"):
        result["thresholds"] = [threshold_of(one) for one in subjects]
        print_thresholds(result["thresholds"])
        print_plans(subjects)
    if options.only in (None, "gradients"):
        for one in subjects:
            result["gradients"][one.name] = gradient_picture(one, options.figure, trainer_of)
    if options.only in (None, "train"):
        network = Lpips(subjects[0].job.workspace.assets / "lpips", "alex")
        for one in subjects:
            result["rows"] += compare(one, options, network)
        print_rows(result["rows"])
    if options.json:
        options.json.write_text(json.dumps(result, indent=1), encoding="utf-8")
    print(headline(result["rows"]) or "nothing was trained")


if __name__ == "__main__":
    main()
