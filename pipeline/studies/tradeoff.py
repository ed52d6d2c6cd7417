"""What accuracy costs in time: which settings buy what, found within a budget, and their frontier."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path

import pandas as pd

from pipeline.clip.curves import read_curve
from pipeline.config.request import Request
from pipeline.errors import UserError
from pipeline.studies.measure import AvatarMeter
from pipeline.studies.plots import curves, scatter
from pipeline.studies.points import combinations, frontier, noise_of, point_table, worth_of
from pipeline.studies.report import Page, Picture, Section, publish
from pipeline.studies.search import Search, seconds_of, spoken
from pipeline.studies.sweep import GAUSSIANS, overrides_of, sizes_of, sweep_levels
from pipeline.studies.tables import MAIN, NOTE, Table
from pipeline.studies.variants import Base, Result, base_of, run_record

DEFAULT_BUDGET = "20m"
COLUMNS = [
    "gaussians", "psnr", "psnr_interior", "ssim", "lpips_alex", "train_s", "times", "gain", "whole_s",
    "animation_ms", "rendering_ms", "short",
]  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Tradeoff:
    """The results of a study.

    Attributes:
        base: whose avatar, and the study's own settings.
        points: as ``point_table`` gives them; 1 is the base. Quality is that of the base's held-out frames
            at the base's picture size.
        expected: preset -> expected training cost, of those that were not run.
        fits: indexed by steps, with the columns of ``fit_numbers``.
        budget, seconds: allowed, and taken by this call.
    """

    base: Base
    points: pd.DataFrame
    expected: Mapping[str, float]
    fits: pd.DataFrame
    budget: float
    seconds: float

    @property
    def choices(self) -> pd.DataFrame:
        """The points that a user can choose from."""
        return self.points[~self.points["chance"]]

    @property
    def noise(self) -> float:
        """How far another seed's PSNR is off; NaN where it was not reached."""
        return noise_of(self.points)

    def frontier(self, cost: str = "train_s", metric: str = "psnr") -> list[int]:
        """The numbers of the points that nothing beats, the cheapest first."""
        sign = -1 if metric.startswith("lpips") else 1
        return frontier(self.choices[cost], sign * self.choices[metric])


def tradeoff(subject: str, request: Request) -> Path:
    """Explores one subject's settings and writes table, plots and page.

    Returns:
        The study's folder.

    Raises:
        UserError: a setting is wrong, or the base itself failed.
    """
    text = request.budget or DEFAULT_BUDGET
    budget, folder = seconds_of(text), request.workspace.data / "studies" / "tradeoff" / subject
    base = base_of(subject, request, folder / "log.txt")
    levels = sweep_levels(base.settings)
    print(f"tradeoff of {subject}: {len(levels)} levels alone, then what combines, within {text}", flush=True)
    meters: list[AvatarMeter] = []

    def measure(result: Result) -> Result:
        if not meters and not result.failure:  # the first result is the base's
            meters.append(AvatarMeter(base.job(), result.folders["ingest"]))
        return meters[0].measured(result) if meters else result

    search = Search(base, budget, measure)
    own = search.make(())
    if own.failure:
        raise UserError(own.failure)
    fits = search.run_fits()
    search.make_affordable((level,) for level in levels)
    presets, expected = search.run_presets(levels)
    search.make_affordable(combinations(point_table(search.results)))
    speeds = meters[0].speeds([*search.results.values(), *presets.values()])
    points = point_table(search.results, presets, speeds)
    points.loc[1, "preset"] = base.preset
    write_tradeoff(folder, Tradeoff(base, points, expected, fits, budget, search.spent))
    return folder


def write_tradeoff(folder: Path, study: Tradeoff) -> None:
    """Writes the tables, the plots and the page."""
    tables, points = tables_of(study), study.points.set_index("label")
    failed = [result.variant for result in points["result"] if result.failure]
    lines = [
        f"Settings that were tried within {spoken(study.budget)}: {len(points)}; each level of each sweep "
        "parameter alone, then combinations of those that gained most for their time. Gains smaller than "
        "another seed's difference mean nothing.",
        *([f"Failed: {', '.join(failed)}; the table says why."] if failed else []),
    ]
    sections = [
        Section("The frontier", frontier_lines(study), pictures=plots(folder, study)),
        *(Section(table.title, tables=[table]) for table in tables),
    ]
    changed = {
        name: {"preset": point["preset"]} if point["design"] is None else overrides_of(point["design"])
        for name, point in points.iterrows()
    }
    title, results = f"{study.base.subject}: what accuracy costs", points["result"].to_dict()
    page = Page(title, headline(study), lines, sections, study.base, changed, results, study.seconds)
    publish(folder, page, pd.concat([table.values(study.base.subject) for table in tables]))


def tables_of(study: Tradeoff) -> list[Table]:
    """The points, and the registrations."""
    chance = f" Another seed differs by {study.noise:.2f} dB." if math.isfinite(study.noise) else ""
    caption = (
        f"Sizes: {sizes_of(study.base.settings)}. Quality: means over held-out frames, all at the base's "
        "picture size. Seconds are processor seconds of all threads, of the run that made the result; "
        "training includes the views that were made for it, the whole job all up to training. Milliseconds: "
        "the baked avatar on one thread, the least of 15 frames, drawn at 512×512. In bold letters: on the "
        f"frontier of PSNR and training seconds.{chance}"
    )
    points = study.points
    failures = points["result"].map(lambda one: one.failure and f"failed: {one.failure}")
    presets = ("preset " + points["preset"]).where(points["preset"].ne("") & points["design"].notna(), "")
    rows = points.assign(**{NOTE: failures + presets, MAIN: points.index.isin(study.frontier())})
    rows = rows.set_index("label").rename_axis(None)[[*COLUMNS, NOTE, MAIN]]
    tables = [Table("tradeoff", f"What accuracy costs: {study.base.subject}", caption, rows)]
    if not study.fits.empty:
        told = (
            "Seconds (processor) of the registration alone. px: mean distance of the trusted keypoints from "
            "where they were detected; mm: of the joints that the camera sees from the truth, aligned at the "
            "neck."
        )
        fits = study.fits.set_axis(study.fits.index.astype(str) + " steps")
        tables.append(Table("fits", "What the fit's effort buys", told, fits, first="fit"))
    return tables


TRAINING = "processor seconds of training, views included"
ANIMATION = "processor milliseconds to animate a frame"
PLOTS = (
    # file, cost, metric, factor, label of the costs, label of the metric
    ("psnr_over_training", "train_s", "psnr", 1, TRAINING, "PSNR, dB"),
    ("lpips_over_training", "train_s", "lpips_alex", 100, TRAINING, "LPIPS×100"),
    ("psnr_over_animation", "animation_ms", "psnr", 1, ANIMATION, "PSNR, dB"),
)
FIT_PLOTS = (
    ("fit_pixels", "pixels", "Reprojection error, px"),
    ("fit_millimetres", "millimetres", "Joints' distance from the truth, mm"),
)
CURVES = (
    "Training curves of every run that learnt from the base's pictures; the frontier's in colour. "
    "Wall-clock seconds carry what else the machine was doing."
)


def plots(folder: Path, study: Tradeoff) -> list[Picture]:
    """Draws every plot there is something for."""
    pictures: list[Picture] = []
    points, fits = study.points.assign(base=study.points.index == 1), study.fits
    for name, cost, metric, factor, across, up in PLOTS:
        file, shown = folder / f"{name}.png", points.assign(x=points[cost], y=factor * points[metric])
        expected = study.expected if cost == "train_s" else {}
        scatter(file, shown, study.frontier(cost, metric), across, f"held-out {up}", expected)
        dashed = " Dashed: what a preset that was not run would cost, if near." if expected else ""
        told = f"Held-out {up.partition(',')[0]} against {across}. Numbers are the table's."
        pictures.append((file, told + dashed))
    file, up = folder / "training_curves.png", "PSNR of a few held-out frames, dB"
    curves(file, training_curves(study), "wall-clock seconds of training", up)
    pictures.append((file, CURVES))
    for name, error, up in FIT_PLOTS:
        if error in fits and fits[error].notna().any():
            file, shown = folder / f"{name}.png", fits.assign(x=fits["seconds"], y=fits[error])
            scatter(file, shown, frontier(shown["x"], -shown["y"]), "seconds of registration", up)
            told = f"{up.partition(',')[0]} against the registration's seconds; numbers are steps."
            pictures.append((file, told))
    return pictures


def training_curves(study: Tradeoff) -> dict[str, list[tuple[float, float]]]:
    """Label -> (wall-clock seconds, PSNR) of a few held-out frames; the base and the frontier's best first.

    A curve is of pictures of its own run's size, so that runs of other sizes are left out.
    """
    edge = study.frontier()
    order = sorted(study.points.index, key=lambda n: (n != 1, n not in edge, -study.points["psnr"][n]))
    lines = {}
    for label, result in study.points.loc[order, ["label", "result"]].itertuples(index=False):
        if result.folders.get("ingest") == study.points.loc[1, "result"].folders["ingest"]:
            train, remedy = result.folders["train"], "run the train stage again"
            seconds = {mark[0]: mark[1] for mark in run_record(train)["timings"]["curve_seconds"]}
            line = read_curve(train / "curve.parquet", remedy).get("psnr", [])
            lines[label] = [(seconds[step], value) for step, value in line if step in seconds]
    return lines


def frontier_lines(study: Tradeoff) -> list[str]:
    """The frontier in words, the cheapest first, and how far presets lie from it."""
    points, edge = study.points, study.frontier()
    lines = [
        f"{point['label']}: {point['psnr']:.2f} dB for {point['train_s']:.0f} s"
        for _, point in points.loc[edge].iterrows()
    ]
    for number, point in points[points["preset"].ne("")].iterrows():
        where = "on" if number in edge else f"{point['short']:.2f} dB under"
        lines.append(f"Preset {point['preset']} lies {where} the frontier.")
    missing = study.expected.items()
    return lines + [f"Preset {name} was not run: about {spoken(cost)}." for name, cost in missing]


def headline(study: Tradeoff) -> str:
    """One sentence: the level that gains most for its time, the one that gains most; else what is as good."""
    single = study.choices["design"].map(lambda design: len(design or ()) == 1)
    levels, base = study.choices[single & study.choices["psnr"].notna()], study.points.loc[1]
    if levels.empty:
        return "The budget reached no setting but the study's own: give it more time."
    noise = study.noise if math.isfinite(study.noise) else 0.05  # what would be told as 0.0
    gaining = levels[levels["gain"] > noise]
    if gaining.empty:
        return f"No single change that was tried gains {idle_change(study, noise)}."
    best, most = gaining.loc[worth_of(gaining).idxmax()], gaining.loc[gaining["gain"].idxmax()]
    more = f"; the most is gained by going {change(most, base)}" if most.name != best.name else ""
    return f"Going {change(best, base)}{more}."


def idle_change(study: Tradeoff, noise: float) -> str:
    """What to do where no level gains: the cheapest choice that is as good as the base."""
    base = study.points.loc[1]
    chance = f"more than another seed does ({noise:.1f} dB)" if math.isfinite(study.noise) else "anything"
    as_good = study.choices[study.choices["gain"] >= -noise].sort_values("train_s", kind="stable").iloc[0]
    if as_good["times"] > 0.95:
        sizes = sizes_of(study.base.settings)
        return f"{chance}: stay with {base['gaussians']:,.0f} Gaussians and {sizes}"
    told = f"does as well in PSNR ({perceived(as_good, base)})"
    return f"{chance}: {as_good['result'].variant}, at {times(as_good)}, {told}"


def change(point: pd.Series, base: pd.Series) -> str:
    """A level tried alone in words: from what to what, at how much time, for what gain."""
    level = point["design"][0]
    before, after = level.before, level.label
    if level.parameter == GAUSSIANS:
        before, after = (f"{one['gaussians']:,.0f} Gaussians" for one in (base, point))
    told = after if after.startswith("with") else f"from {before} to {after}"
    return f"{told}, at {times(point)}: {point['gain']:+.1f} dB ({perceived(point, base)})"


def perceived(point: pd.Series, base: pd.Series) -> str:
    """A point's LPIPS beside the base's: what gains in PSNR may well be less sharp."""
    return f"LPIPS×100 {100 * point['lpips_alex']:.1f}, was {100 * base['lpips_alex']:.1f}"


def times(point: pd.Series) -> str:
    """A point's training time over the base's, in words."""
    same = abs(point["times"] - 1) <= 0.05
    return "no more training time" if same else f"{point['times']:.1f} times the training time"
