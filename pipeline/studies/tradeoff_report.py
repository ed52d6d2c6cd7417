"""Table, plots and page of a study of what accuracy costs."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

from pipeline.artifact import RUN
from pipeline.curves import read_curve
from pipeline.digest import write_atomically
from pipeline.job import shown
from pipeline.studies.explore import spoken
from pipeline.studies.fits import FitPoint
from pipeline.studies.frontier import frontier
from pipeline.studies.page import (
    Page,
    Picture,
    Section,
    settings_section,
    timings_section,
    total_time,
    write_page,
)
from pipeline.studies.plots import Axis, Dot, curves, scatter
from pipeline.studies.sizes import sizes_of, versions_of
from pipeline.studies.tables import HERE, Column, Row, Table, latex, markdown, values_of, write_values
from pipeline.studies.tradeoff import Entry, Study, sentence
from pipeline.study import Outcome

TRAIN_SECONDS = Axis("processor seconds of training, views included", log=True)
ANIMATION = Axis("processor milliseconds to animate one frame", log=True)
COLUMNS = (
    Column("gaussians", "Gaussians", 0),
    Column("psnr", "PSNR", 2, "higher"),
    Column("psnr_interior", "inside", 2, "higher"),
    Column("ssim", "SSIM", 4, "higher"),
    Column("lpips_alex", "LPIPS×100", 2, "lower", 100.0),
    Column("train_s", "training s", 0, "lower"),
    Column("times", "× base", 2),
    Column("gain", "gain dB", 2),
    Column("whole_s", "whole job s", 0, "lower"),
    Column("animation_ms", "animation ms", 1, "lower"),
    Column("rendering_ms", "rendering ms", 1, "lower"),
    Column("short", "short of frontier dB", 2),
)
FIT_COLUMNS = (
    Column("seconds", "seconds", 2),
    Column("pixels", "px", 3, "lower"),
    Column("millimetres", "mm to the truth", 2, "lower"),
)


def publish(folder: Path, study: Study) -> None:
    """Writes everything and says where it is."""
    tables = tables_of(study)
    write_atomically(folder / "table.md", "\n".join([f"{sentence(study)}\n", *map(markdown, tables)]))
    write_atomically(folder / "table.tex", "\n".join(latex(table) for table in tables))
    values = [one for table in tables for one in values_of(table, study.subject)]
    write_values(folder / "table.parquet", values)
    pictures = plots(folder, study)
    write_page(folder / "report.html", page(study, tables, pictures))
    print("\n".join(map(markdown, tables)))
    print(sentence(study))
    made = [entry.outcome for entry in study.entries if entry.outcome]
    print(f"{total_time(made)} This call: {spoken(study.seconds)} of {spoken(study.budget)}; {shown(folder)}")


def tables_of(study: Study) -> list[Table]:
    """The points, and the registrations."""
    assert study.base.outcome is not None
    sizes = sizes_of(study.own, study.base.outcome)
    edge, noise = study.edge(), study.noise
    chance = f" Another seed differs by {noise:.2f} dB." if math.isfinite(noise) else ""
    caption = (
        f"{sizes} Quality: means over held-out frames, all at the base's picture size. Seconds are processor "
        "seconds of all threads, of the run that made the result; training includes the views that were "
        "made for it, the whole job all up to training. Milliseconds: the baked avatar on one thread, "
        "the least of 15 frames, drawn at 512×512. In bold letters: on the frontier of PSNR and training "
        f"seconds.{chance}"
    )
    points = Table(
        "tradeoff",
        f"What accuracy costs: {study.subject}",
        caption,
        COLUMNS,
        [row(study, e, edge) for e in study.entries],
    )
    if not study.fits:
        return [points]
    rows = [Row(f"{fit.steps} steps", fit_values(fit)) for fit in study.fits]
    clocks = sorted({fit.clock for fit in study.fits})
    told = (
        f"Seconds ({' and '.join(clocks)}) of the registration alone. px: mean distance of the trusted "
        "keypoints from where they were detected; mm: of the joints that the camera sees from the truth, "
        "aligned at the neck."
    )
    return [points, Table("fits", "What the fit's effort buys", told, FIT_COLUMNS, rows, first="fit")]


def row(study: Study, entry: Entry, edge: set[int]) -> Row:
    """A line of the table of points."""
    label = f"{entry.number}. {entry.label}"
    if entry.outcome is None:
        return Row(label, {}, f"failed: {entry.reason}")
    values = {
        "gaussians": entry.gaussians,
        **{name: entry.get(name) for name in ("psnr", "psnr_interior", "ssim", "lpips_alex")},
        "train_s": entry.cost,
        "times": entry.cost / study.base.cost,
        "gain": entry.get("psnr") - study.base.get("psnr"),
        "whole_s": entry.whole,
        **{name: entry.speed.get(name, math.nan) for name in ("animation_ms", "rendering_ms")},
        "short": study.short(entry),
    }
    note = f"preset {entry.preset}" if entry.preset and "preset" not in entry.label else ""
    return Row(label, {(key, HERE): value for key, value in values.items()}, note, entry.number in edge)


def fit_values(fit: FitPoint) -> dict[tuple[str, str], float]:
    """The numbers of a registration."""
    return {(name, HERE): getattr(fit, name) for name in ("seconds", "pixels", "millimetres")}


def plots(folder: Path, study: Study) -> list[Picture]:
    """Draws every plot there is something for."""
    pictures = []
    for metric, label, file in (
        ("psnr", "Held-out PSNR, dB", "psnr_over_training.png"),
        ("lpips_alex", "Held-out LPIPS×100", "lpips_over_training.png"),
    ):
        scatter(folder / file, dots(study, "train", metric), TRAIN_SECONDS, Axis(label), study.expected)
        dashed = " Dashed: what a preset that was not run would cost, if near." if study.expected else ""
        told = f"{label.removesuffix(', dB')} against what training cost. Numbers are the table's.{dashed}"
        pictures.append(Picture(folder / file, told))
    scatter(
        folder / "psnr_over_animation.png",
        dots(study, "animation_ms", "psnr"),
        ANIMATION,
        Axis("Held-out PSNR, dB"),
    )
    pictures.append(
        Picture(
            folder / "psnr_over_animation.png", "Held-out PSNR against what a new frame costs to animate."
        )
    )
    curves(
        folder / "training_curves.png",
        training_curves(study),
        Axis("wall-clock seconds of training"),
        Axis("PSNR of a few held-out frames, dB"),
    )
    pictures.append(
        Picture(
            folder / "training_curves.png",
            "Training curves of every run that learnt from the base's pictures; the frontier's in colour. "
            "Wall-clock seconds carry what else the machine was doing.",
        )
    )
    return [*pictures, *fit_plots(folder, study.fits)]


def dots(study: Study, cost: str, metric: str) -> list[Dot]:
    """The points of a plot."""
    edge, factor = study.edge(cost, metric), 100 if metric.startswith("lpips") else 1
    return [
        Dot(
            number=entry.number,
            x=study.costs(entry, cost),
            y=factor * entry.get(metric),
            on_frontier=entry.number in edge,
            base=entry.number == 1,
            preset=entry.preset,
        )
        for entry in study.entries
    ]


def training_curves(study: Study) -> dict[str, list[tuple[float, float]]]:
    """Label -> (wall-clock seconds, PSNR); the base and the frontier's best first.

    A curve is of pictures of its own run's size, so that runs of other sizes are left out.
    """
    edge, base = study.edge(), study.base.outcome
    order = sorted(study.entries, key=lambda e: (e.number != 1, e.number not in edge, -e.get("psnr")))
    return {
        f"{entry.number}. {entry.label}": curve_of(entry.outcome)
        for entry in order
        if entry.outcome and base and entry.outcome.folders["ingest"].name == base.folders["ingest"].name
    }


def curve_of(outcome: Outcome) -> list[tuple[float, float]]:
    """Seconds and PSNR of a run; evenly spread where the run noted no seconds of its points."""
    line = read_curve(outcome.folders["train"] / "curve.parquet", "run the train stage again").get("psnr", [])
    timings = json.loads((outcome.folders["train"] / RUN).read_text(encoding="utf-8"))["timings"]
    marks = {int(mark[0]): float(mark[1]) for mark in timings.get("curve_seconds", [])}
    if line and not marks:
        each = timings.get("train_seconds", 0.0) / line[-1][0]
        marks = {iteration: each * iteration for iteration, _ in line}
    return [(marks[iteration], value) for iteration, value in line if iteration in marks]


def fit_plots(folder: Path, fits: Sequence[FitPoint]) -> list[Picture]:
    """Fit error against fit seconds: in pixels, and in millimetres where the truth is known."""
    pictures = []
    for name, label, file in (
        ("pixels", "Reprojection error, px", "fit_pixels.png"),
        ("millimetres", "Joints' distance from the truth, mm", "fit_millimetres.png"),
    ):
        values = [getattr(fit, name) for fit in fits]
        if not any(math.isfinite(value) for value in values):
            continue
        edge = frontier([fit.seconds for fit in fits], [-value for value in values])
        marks = [
            Dot(fit.steps, fit.seconds, value, place in edge)
            for place, (fit, value) in enumerate(zip(fits, values, strict=True))
        ]
        scatter(folder / file, marks, Axis("seconds of registration", log=True), Axis(label))
        told = f"{label.partition(',')[0]} against the registration's seconds; numbers are steps."
        pictures.append(Picture(folder / file, told))
    return pictures


def page(study: Study, tables: Sequence[Table], pictures: Sequence[Picture]) -> Page:
    """The study's page."""
    assert study.base.outcome is not None
    changed = {f"{entry.number}. {entry.label}": entry.words for entry in study.entries}
    outcomes = {f"{e.number}. {e.label}": e.outcome for e in study.entries if e.outcome}
    failed = [entry for entry in study.entries if entry.outcome is None]
    lines = [
        f"Settings that were tried within {spoken(study.budget)}: {len(study.entries)}; each level of each "
        "knob alone, then the combinations that promised most for their time. Gains smaller than another "
        "seed's difference mean nothing.",
    ]
    if failed:
        lines.append(f"Failed: {', '.join(entry.label for entry in failed)}; the table says why.")
    return Page(
        title=f"{study.subject}: what accuracy costs",
        lead=sentence(study),
        lines=lines,
        sections=[
            Section("The frontier", frontier_lines(study), pictures=pictures),
            *(Section(table.title, tables=[table]) for table in tables),
            settings_section(study.own, study.subject, changed),
            timings_section(outcomes, study.seconds, versions_of(study.base.outcome)),
        ],
    )


def frontier_lines(study: Study) -> list[str]:
    """The frontier in words, the cheapest first, and how far presets lie from it."""
    edge = sorted((e for e in study.entries if e.number in study.edge()), key=lambda entry: entry.cost)
    lines = [
        f"{entry.number}. {entry.label}: {entry.get('psnr'):.2f} dB for {entry.cost:.0f} s" for entry in edge
    ]
    for entry in study.entries:
        if entry.preset and entry.number not in study.edge():
            lines.append(f"Preset {entry.preset} lies {study.short(entry):.2f} dB under the frontier.")
        elif entry.preset:
            lines.append(f"Preset {entry.preset} lies on the frontier.")
    lines += [f"Preset {name} was not run: about {spoken(cost)}." for name, cost in study.expected.items()]
    return lines
