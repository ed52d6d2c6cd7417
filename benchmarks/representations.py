"""The two representations of an avatar and the presets, on every subject, against copying the nearest frame.

Holds: docs/results.md, "Representations". Each row is a whole job through evaluate (what the store has is not
run again): means over the held-out frames, of the poses as they were fitted; processor seconds of training
without compiling; the size of the avatar's file. ``--plot`` draws all curves on one page. Stages
run one after the other in processes of their own.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
import safetensors
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from benchmarks import frame
from pipeline.clip.curves import read_curve
from pipeline.config.request import Request, parse_request
from pipeline.errors import UserError
from pipeline.run.job import Job, open_job
from pipeline.run.process import run_stage_process
from stages.evaluate.methods import AVATAR, NEAREST

SUBJECTS = ("smile", "carphone", "oliver", "balance", "mannequin_head", "mannequin_upper", "mannequin_full")
VARIANTS: Mapping[str, Mapping[str, str]] = {
    "triplane": {"train.representation": "triplane", "train.lpips": "0"},
    "bases": {},
    "draft": {"preset": "draft"},
    "balanced": {"preset": "balanced"},
}
COLORS = {"triplane": "#d95f02", "bases": "#1f77b4", "draft": "#7570b3", "balanced": "#1b9e77"}
Line = list[tuple[float, float]]  # processor seconds, dB
METRICS = {"psnr": "psnr", "ssim": "ssim", "lpips_alex": "lpips x100"}


def measure(options: argparse.Namespace, report: frame.Report) -> str:
    """Runs every variant of every subject, and reads its scores."""
    quick = {"train__effort": "0.1", "ingest__mannequin_frames": "24"} if options.quick else {}
    names = ("mannequin_head",) if options.quick else SUBJECTS
    subjects = options.subjects.split(",") if options.subjects else names
    variants = options.variants.split(",")
    lines: dict[str, dict[str, Line]] = {}
    with frame.settings_of(options, **quick) as words:
        for subject in subjects:
            nearest: dict[str, float] = {}
            for variant in variants:
                job = finished({**words, **VARIANTS[variant]}, subject)
                scores = held_out_scores(job)
                nearest = nearest or scores[NEAREST]
                lines.setdefault(subject, {})[variant] = held_out_curve(folder_of(job, "train"))
                report.add({"subject": subject, "variant": variant, **training(job), **scores[AVATAR]})
            report.add({"subject": subject, "variant": "nearest frame", **nearest}, "nearest")
    if options.plot:
        draw_curves(options.plot, lines)
    return headline(report.tables["rows"])


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of this benchmark."""
    parser.add_argument("--subjects", metavar="NAMES", help=f"joined by commas; {','.join(SUBJECTS)} if none")
    parser.add_argument("--variants", default="triplane,bases", help=f"of {', '.join(VARIANTS)}")
    parser.add_argument("--plot", type=Path, metavar="PNG", help="draw held-out PSNR against training time")
    frame.stage_options(parser)


def finished(words: Mapping[str, str], subject: str) -> Job:
    """The job of a subject with evaluate's result in the store; UserError where a stage fails."""
    request: Request = parse_request(words, subject)
    job = open_job(subject, request)
    for stage in job.upstream_first(["evaluate"]):
        if job.find(stage) is not None:
            continue
        for asset in job.needed_assets(stage):
            frame.asset_folder(job.workspace, asset)
        reason = run_stage_process(stage, subject, request)
        if reason:
            raise UserError(f"{stage}:{subject}: {reason}")
    return job


def held_out_scores(job: Job) -> dict[str, dict[str, float]]:
    """Method -> means over the held-out frames of the cameras that were trained on."""
    table = pd.read_parquet(folder_of(job, "evaluate") / "metrics.parquet")
    table = table[(table["split"] == "test") & (table["view"] == "") & table["metric"].isin(list(METRICS))]
    means = table.groupby(["method", "metric"])["value"].mean()
    return {
        method: {
            shown: float(means[method, metric]) * (100 if "x100" in shown else 1)
            for metric, shown in METRICS.items()
        }
        for method in (AVATAR, NEAREST)
    }


def training(job: Job) -> dict[str, Any]:
    """The number of Gaussians and steps, what training took, and the size of what it made."""
    folder = folder_of(job, "train")
    timings = json.loads((folder / "run.json").read_text(encoding="utf-8"))["timings"]
    steps, wall, cpu = timings["curve_seconds"][-1]
    file = folder / "avatar.safetensors"
    with safetensors.safe_open(file, "pt") as tensors:
        gaussians = tensors.get_slice("network.base_color").get_shape()[0]
    return {
        "Gaussians": gaussians, "steps": steps, "processor s": round(cpu, 1), "wall s": round(wall, 1),
        "MB": round(file.stat().st_size / 1e6, 1),
    }  # fmt: skip


def held_out_curve(folder: Path) -> Line:
    """Processor seconds of training and the held-out frames' PSNR in training, of a train stage's folder."""
    timings = json.loads((folder / "run.json").read_text(encoding="utf-8"))["timings"]
    seconds = {steps: cpu for steps, _, cpu in timings["curve_seconds"]}
    points = read_curve(folder / "curve.parquet", "run the train stage again")["psnr"]
    return [(seconds[steps], value) for steps, value in points if steps in seconds]


def draw_curves(path: Path, lines: Mapping[str, Mapping[str, Line]]) -> None:
    """A panel for each subject: what a variant's training reaches in how much time, on a logarithmic axis."""
    columns = min(3, len(lines))
    rows = math.ceil(len(lines) / columns)
    figure = Figure((3.2 * columns, 0.4 + 2.3 * rows), dpi=110, layout="constrained")
    panels = list(figure.subplots(rows, columns, squeeze=False).flat)
    for panel, (subject, of_variant) in zip(panels[: len(lines)], lines.items(), strict=True):
        for variant, line in of_variant.items():
            panel.plot(*zip(*line, strict=True), marker=".", color=COLORS[variant], label=variant)
        panel.set(title=subject, xscale="log")
        panel.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        panel.xaxis.set_major_formatter("{x:g}")
        panel.xaxis.set_minor_formatter("")
        panel.grid(alpha=0.3)
    for panel in panels[len(lines) :]:
        panel.remove()
    figure.supxlabel("processor seconds of training")
    figure.supylabel("held-out PSNR, dB")
    named = {
        text: mark
        for panel in figure.axes
        for mark, text in zip(*panel.get_legend_handles_labels(), strict=True)
    }
    figure.legend(named.values(), named, loc="outside upper center", ncols=len(named), frameon=False)
    figure.savefig(path)


def folder_of(job: Job, stage: str) -> Path:
    """The folder of a stage's result; UserError where there is none."""
    artifact = job.find(stage)
    if artifact is None:
        raise UserError(f"there is no {stage} of '{job.subject.name}'")
    return artifact.folder


def headline(rows: list[dict[str, Any]]) -> str:
    """The bases' differences from the triplane: PSNR, share of LPIPS, share of the time."""
    by = {(row["subject"], row["variant"]): row for row in rows}
    pairs = [
        (by[name, "triplane"], by[name, "bases"])
        for name, variant in by
        if variant == "triplane" and (name, "bases") in by
    ]
    if not pairs:
        return f"{len(rows)} rows"
    gain = sum(new["psnr"] - old["psnr"] for old, new in pairs) / len(pairs)
    blur = sum(new["lpips x100"] / old["lpips x100"] for old, new in pairs) / len(pairs)
    time = sum(new["processor s"] / old["processor s"] for old, new in pairs) / len(pairs)
    return (
        f"bases against the triplane on {len(pairs)} subjects: {gain:+.2f} dB, {blur:.2f} of its LPIPS, "
        f"{time:.2f} of its training"
    )


if __name__ == "__main__":
    sys.exit(frame.run("representations", __doc__, measure, options=add_options))
