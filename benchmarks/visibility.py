"""The worth of the visibility gate, on mannequins and, if asked for, real subjects.

Holds: docs/results.md, "Visibility". Each variant trains for the same few iterations, without subdivision
unless asked, and is scored on the same few held-out frames. "off": every body vertex carries a Gaussian from
the start to the end. Steps are timed in turn after training, medians of CPU time. ``outside`` and ``ghost``
are what a camera that never was sees of what no frame showed: the mean absolute difference from the truth
there (mannequins), and the pixels covered there, from a camera farther back. ``cut`` and ``lost`` are the
shares of vertices and of an average frame's visible body under the threshold tau.
"""

from __future__ import annotations

import argparse
import dataclasses
import statistics
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from benchmarks import frame
from pipeline.avatar import Architecture, Avatar
from pipeline.avatar.otsu_threshold import evidence_threshold
from pipeline.avatar.visibility import body_in_frame
from pipeline.body import joint_transforms
from pipeline.clip.camera import Camera, facing_camera, project
from pipeline.clip.composite import composite_frame
from pipeline.clip.frames import read_frame, read_mask
from pipeline.clip.plan import Plan, read_plan
from pipeline.clip.records import read_cameras
from pipeline.config.request import parse_request
from pipeline.metrics import Lpips, psnr, ssim
from pipeline.run.job import open_job
from pipeline.splat import Rendering, render
from stages.plan.measure import read_inputs, visibility
from stages.train.data import TrainingData, read_training_data
from stages.train.loop import Trainer
from stages.train.run import build_trainer
from stages.train.settings import TrainSettings, apply_plan

SUBJECTS = ("mannequin_full", "mannequin_upper", "mannequin_head")
VARIANTS: Mapping[str, Mapping[str, Any]] = {
    "on": {},
    "off": {"gate": False},
    "late": {"early_gate": False},
    "fixed 0.4": {"gate_threshold": 0.4},
    "fixed 0.6": {"gate_threshold": 0.6},
}
VIEW = "above"  # of the mannequin's unseen cameras, the one that shows most of what no frame did
BACK = 2.2  # metres that the wide camera stands behind the filming one
REACH = 6  # pixels about a seen vertex that count as the seen region


@dataclasses.dataclass(frozen=True)
class Subject:
    """A subject as the stages up to plan left it.

    Attributes:
        name: the subject's.
        data: for training.
        plan: of the subject.
        threshold: the gate's from fitted poses: tau, Otsu's, its separability, what it cuts and loses.
        views: folder of a mannequin's unseen cameras; need not exist.
    """

    name: str
    data: TrainingData
    plan: Plan
    threshold: dict[str, Any]
    views: Path


def open_subject(name: str, words: Mapping[str, str]) -> Subject:
    """Reads a subject; the stages up to plan run first where the store lacks them."""
    job = open_job(name, parse_request(words, name))
    ingest, fit, plan = (frame.made(job, "plan")[stage].folder for stage in ("ingest", "fit", "plan"))
    margin, body_file = TrainSettings().crop_margin, job.workspace.body_file
    scores, _ = visibility(read_inputs(ingest, fit, body_file))
    data = read_training_data(ingest, fit, None, body_file, margin)
    threshold = dataclasses.asdict(evidence_threshold(scores))
    return Subject(name, data, read_plan(plan / "plan.json"), threshold, ingest / "views" / VIEW)


def measure(options: argparse.Namespace, report: frame.Report) -> str:
    """Trains every variant of every subject."""
    quick = {"ingest__mannequin_frames": "24", "fit__iterations": "50"} if options.quick else {}
    names = ("mannequin_head",) if options.quick else SUBJECTS
    with frame.settings_of(options, **quick) as words:
        for name in options.subjects.split(",") if options.subjects else names:
            subject = open_subject(name, words)
            report.add({"subject": name, **subject.threshold}, "thresholds")
            network = Lpips(frame.asset_folder(parse_request(words, name).workspace, "lpips"), "alex")
            for row in compare(subject, options, network):
                report.add(row)
    return headline(report.tables["rows"])


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of this benchmark."""
    parser.add_argument("--subjects", metavar="NAMES", help=f"joined by commas; {','.join(SUBJECTS)} if none")
    parser.add_argument("--variants", default="on,off", help=f"of {', '.join(VARIANTS)}; joined by commas")
    parser.add_argument("--iterations", type=int, help="of training (200)")
    parser.add_argument("--subdivisions", type=int, default=0)
    parser.add_argument("--frames", type=int, help="held-out frames that are scored (4)")
    parser.add_argument("--rounds", type=int, help="timed steps of each variant (9)")
    frame.stage_options(parser)


def compare(subject: Subject, options: argparse.Namespace, network: Lpips) -> list[dict[str, Any]]:
    """A row a variant."""
    iterations, frames, rounds = (20, 2, 3) if options.quick else (200, 4, 9)
    iterations = options.iterations or iterations
    trainers, rows = {}, []
    for name in options.variants.split(","):
        settings = dataclasses.replace(
            TrainSettings(representation="triplane", lpips=0.0), iterations=iterations,
            subdivisions=options.subdivisions, subdivide_from=0.0, checkpoint_every=10**6, **VARIANTS[name],
        )  # fmt: skip
        trainer = build_trainer(subject.data, apply_plan(settings, subject.plan))
        while trainer.iteration < iterations:
            trainer.step()
        row = {"subject": subject.name, "gate": name, "gaussians": len(trainer.avatar)}
        rows.append(
            row | scored(subject, trainer, options.frames or frames, network) | unseen(subject, trainer)
        )
        trainers[name] = trainer
    timed = {name: lambda one=one: frame.milliseconds(one.step) for name, one in trainers.items()}
    steps = frame.in_turn(timed, options.rounds or rounds)
    return [row | {"step_ms": statistics.median(steps[row["gate"]])} for row in rows]


@torch.no_grad()
def scored(subject: Subject, trainer: Trainer, count: int, network: Lpips) -> dict[str, float]:
    """Held-out PSNR, SSIM and LPIPS of the person on black."""
    values: dict[str, list[float]] = {"psnr": [], "ssim": [], "lpips": []}
    avatar, clip = trainer.avatar.eval(), subject.data.clip
    for number in clip.spread(count, "test"):
        view = subject.data.whole[number]
        gaussians = avatar.gaussians(clip.pose(number), clip.seconds.get(number))
        image, truth = render(gaussians, view.camera).color.clamp(0, 1), view.composite(torch.zeros(3))
        values["psnr"].append(psnr(image, truth))
        values["ssim"].append(ssim(image, truth))
        values["lpips"].append(float(network(image, truth)[0]))
    avatar.train()
    return {name: statistics.fmean(each) for name, each in values.items()}


def unseen(subject: Subject, trainer: Trainer) -> dict[str, float | None]:
    """``ghost`` and ``outside``, as described above."""
    wide = facing_camera(256, 256, 1.2 * 256)
    wide = dataclasses.replace(wide, translation=wide.translation + torch.tensor([0.0, 0.0, BACK]))
    rendering, seen = rendered(subject, trainer, subject.data.clip.split.test[0], wide)
    ghost, total, pixels = float(rendering.alpha[~seen].sum()), 0.0, 0
    if not subject.views.is_dir():
        return {"ghost": ghost, "outside": None}
    for number, camera in read_cameras(subject.views / "cameras.parquet").items():
        rendering, seen = rendered(subject, trainer, number, camera)
        image, mask = (
            read_frame(subject.views / "frames", number),
            read_mask(subject.views / "masks", number),
        )
        error = (rendering.color.clamp(0, 1) - composite_frame(image, mask)).abs().mean(-1)
        total += float(error[~seen].sum())
        pixels += int((~seen).sum())
    return {"ghost": ghost, "outside": total / max(1, pixels)}


@torch.no_grad()
def rendered(subject: Subject, trainer: Trainer, number: int, camera: Camera) -> tuple[Rendering, Tensor]:
    """The avatar in a frame's pose, and the pixels near a vertex that a tenth of the training frames show."""
    clip, avatar = subject.data.clip, trainer.avatar.eval()
    pose = clip.pose(number)
    rendering = render(avatar.gaussians(pose), camera)
    avatar.train()
    bare = Architecture(plane_resolution=2, plane_channels=1, subdivisions=0)
    surface = Avatar(clip.body, clip.identity, torch.arange(len(clip.body.v_template)), bare).surfaces[0]
    hits = torch.zeros(len(surface.canonical))
    for one in clip.split.train:
        hits += body_in_frame(surface, clip.pose(one), subject.data.crops.camera(one))
    often, canonical = hits >= 0.1 * len(clip.split.train), surface.canonical
    transforms = joint_transforms(pose.rotation[None], canonical.joints, canonical.parents)[0]
    vertices = surface.skinning_tables.place(transforms, canonical.vertices, pose.transl)[0][often]
    marks = np.zeros((camera.height, camera.width), np.uint8)
    columns, lines = project(camera, vertices).round().int().numpy().T
    inside = (columns >= 0) & (columns < camera.width) & (lines >= 0) & (lines < camera.height)
    marks[lines[inside], columns[inside]] = 1
    size = 2 * REACH + 1
    return rendering, torch.from_numpy(cv2.dilate(marks, np.ones((size, size), np.uint8)) > 0)


def headline(rows: list[dict[str, Any]]) -> str:
    """One line: what the gate saves, and its cost."""
    parts = []
    for name in dict.fromkeys(row["subject"] for row in rows):
        own = {row["gate"]: row for row in rows if row["subject"] == name}
        if {"on", "off"} <= set(own):
            on, off = own["on"], own["off"]
            parts.append(
                f"{name}: {1 - on['gaussians'] / off['gaussians']:.0%} fewer Gaussians, "
                f"{1 - on['step_ms'] / off['step_ms']:.0%} less CPU time a step, "
                f"{on['psnr'] - off['psnr']:+.2f} dB"
            )
    return "; ".join(parts)


def main(arguments: list[str] | None = None) -> int:
    """Runs the benchmark."""
    return frame.run("visibility", __doc__, measure, arguments, threads=1, options=add_options)


if __name__ == "__main__":
    sys.exit(main())
