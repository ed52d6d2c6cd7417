"""What accuracy costs in time: which settings buy what, found within a budget, and their frontier."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from pipeline.clip.curves import read_curve
from pipeline.config.request import Request
from pipeline.errors import UserError
from pipeline.run.job import Job
from pipeline.studies.fit_error import fit_numbers, fit_steps
from pipeline.studies.measure import AvatarMeter, Numbers
from pipeline.studies.plots import curves, scatter
from pipeline.studies.report import (
    Page,
    Picture,
    Section,
    publish,
    settings_section,
    sizes_of,
    timings_section,
)
from pipeline.studies.search import TRAIN, Search, seconds_of, spoken, training_cost
from pipeline.studies.sweep import (
    CHANCE,
    GAUSSIANS,
    PRECISION,
    Design,
    Level,
    combinations,
    frontier,
    gain_for_time,
    overrides_of,
    shortfalls,
    sweep_levels,
)
from pipeline.studies.tables import MAIN, NOTE, Table
from pipeline.studies.variants import Base, Result, Variant, base_of, run_record, study_folder

DEFAULT_BUDGET = "20m"
Run = tuple[Result, Design | None, str]
"""A result, its design (None for a preset), and the preset that it is (empty if none)."""
COLUMNS = (
    "gaussians", "psnr", "psnr_interior", "ssim", "lpips_alex", "train_s", "times", "gain", "whole_s",
    "animation_ms", "rendering_ms", "short",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Tradeoff:
    """The results of a study.

    Attributes:
        base: whose avatar, and the study's own settings.
        points: indexed by number, in the order of their making; 1 is the base. A column for each of
            ``COLUMNS``: quality over the base's held-out frames at the base's picture size, processor
            seconds, milliseconds. And ``result``; ``design``, None for a preset; ``preset``, which it is,
            empty if none; ``label``; ``chance``, true of another seed, which is no choice.
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
        return self.points.loc[self.points["chance"], "gain"].abs().max()

    def frontier(self, cost: str = "train_s", metric: str = "psnr") -> list[int]:
        """The numbers of the points that nothing beats, the cheapest first."""
        sign = -1 if metric.startswith("lpips") else 1
        return list(frontier(self.choices[cost], sign * self.choices[metric]))


def tradeoff(subject: str, request: Request) -> Path:
    """Explores one subject's settings and writes table, plots and page.

    Returns:
        The study's folder.

    Raises:
        UserError: a setting is wrong, or the base itself failed.
    """
    text = request.budget or DEFAULT_BUDGET
    budget, folder = seconds_of(text), study_folder(request, "tradeoff", subject)
    base = base_of(subject, request, folder / "log.txt")
    levels = sweep_levels(base.settings)
    print(f"tradeoff of {subject}: {len(levels)} levels alone, then what combines, within {text}", flush=True)
    meters: list[AvatarMeter] = []

    def quality(result: Result) -> Numbers:
        if not meters:  # the first result is the base's
            meters.append(AvatarMeter(base.job(), result.folders["ingest"]))
        return meters[0].quality(result)

    search = Search(base, budget, lambda result: quality(result).get("psnr", math.nan))
    own = search.make(())
    if own.failure:
        raise UserError(own.failure)
    fits = run_fits(search)
    search.make_affordable((level,) for level in levels)
    presets, expected = run_presets(search, levels)
    search.make_affordable(combinations(search.alone(), search.noise))

    runs: list[Run] = [
        (result, design, "" if design else base.preset) for design, result in search.results.items()
    ]
    runs += [(result, None, preset) for preset, result in presets.items()]
    done = [result for result, _, _ in runs if not result.failure]
    print(f"timing {len(done)} avatars in motion", flush=True)
    speeds = meters[0].speeds(done)
    measured = [{} if one.failure else quality(one) | speeds[one.folders[TRAIN].name] for one, _, _ in runs]
    points = point_table(runs, measured)
    write_tradeoff(folder, Tradeoff(base, points, expected, fits, budget, search.spent))
    return folder


def run_fits(search: Search) -> pd.DataFrame:
    """Registrations of several efforts, as far as a quarter of the budget reaches; see ``fit_numbers``."""
    own = max(1, search.base.settings["fit"].iterations)
    rows: dict[int, Mapping[str, float | str]] = {}
    for steps in fit_steps(own):
        overrides = {"fit.iterations": str(steps)}
        seconds = search.results[()].seconds["fit"] * steps / own
        late = search.spent + seconds > search.budget / 4
        if rows and late and search.base.missing("fit", overrides):
            print(f"fit of {steps} steps is left out: the budget")
            continue
        result = search.base.run(Variant(f"fit of {steps} steps", overrides), ["fit"])
        if result.failure:
            print(f"fit of {steps} steps failed: {result.failure}")
        else:
            rows[steps] = fit_numbers(search.base, result)
    return pd.DataFrame.from_dict(rows, orient="index")


def run_presets(search: Search, levels: Sequence[Level]) -> tuple[dict[str, Result], dict[str, float]]:
    """The presets that the store holds or half of the budget's rest reaches; the others' expected cost."""
    own = search.results[()]
    results, expected = {}, {}
    for path in sorted((search.base.request.workspace.data / "presets").glob("*.toml")):
        base = search.base.under_preset(path.stem)
        expected[path.stem] = expected_cost(search, base.job(), levels)
        seconds = expected[path.stem] * sum(own.seconds.values()) / max(training_cost(own), 1e-9)
        if base.missing(TRAIN, {}) and seconds > (search.budget - search.spent) / 2:
            continue
        result, _ = search.run(base, Variant(f"preset {path.stem}"))
        if not result.failure:
            results[path.stem] = result
            del expected[path.stem]
    return results, expected


def expected_cost(search: Search, job: Job, levels: Sequence[Level]) -> float:
    """Processor seconds that training under a job's settings would cost, from the levels tried alone.

    Iterations count in proportion, levels of subdivision and precision by what they were found to cost.
    """
    own, wanted, result = search.base.settings["train"], job.settings["train"], search.results[()]
    cost = training_cost(result)
    marks = run_record(result.folders[TRAIN])["timings"].get("curve_seconds") or [(0, 0.0, cost)]
    iterating = float(marks[-1][2])  # the rest is spent before and after the iterations
    cost += iterating * (wanted.iterations / own.iterations - 1)
    fields = {GAUSSIANS: "subdivisions", PRECISION: "half_precision"}
    for level in levels:
        field = fields.get(level.parameter, "")
        if field and dict(level.overrides)[f"train.{field}"] == str(getattr(wanted, field)).lower():
            cost *= search.cost_ratio(level) if getattr(wanted, field) != getattr(own, field) else 1.0
    return cost


def point_table(runs: Sequence[Run], measured: Sequence[Mapping[str, float]]) -> pd.DataFrame:
    """The points, as ``Tradeoff`` describes them.

    Args:
        runs: result, design and preset of each, the base's first.
        measured: quality and speed of each; empty where it failed.
    """
    points = pd.DataFrame(measured, index=range(1, len(runs) + 1))
    points = points.reindex(columns=COLUMNS).astype(float)
    points["result"], points["design"], points["preset"] = (
        pd.Series(list(values), points.index, dtype=object) for values in zip(*runs, strict=True)
    )
    points["train_s"] = points["result"].map(training_cost).astype(float)
    points["whole_s"] = [pd.Series(r.cpu_seconds, dtype=float).sum(min_count=1) for r in points["result"]]
    points["times"] = points["train_s"] / points["train_s"].iloc[0]
    points["gain"] = points["psnr"] - points["psnr"].iloc[0]
    points["label"] = [result.variant for result in points["result"]]
    points["chance"] = [bool(d) and d[0].parameter == CHANCE for d in points["design"]]
    choices = points[~points["chance"]]
    points["short"] = shortfalls(choices["train_s"], choices["psnr"])
    return points


def numbered(points: pd.DataFrame) -> pd.DataFrame:
    """The points, indexed by ``number. label``."""
    return points.set_axis(points.index.astype(str) + ". " + points["label"])


def write_tradeoff(folder: Path, study: Tradeoff) -> None:
    """Writes the tables, the plots and the page."""
    tables, points = tables_of(study), numbered(study.points)
    failed = [result.variant for result in points["result"] if result.failure]
    changed = {
        name: {"preset": point["preset"]} if point["design"] is None else overrides_of(point["design"])
        for name, point in points.iterrows()
    }
    lines = [
        f"Settings that were tried within {spoken(study.budget)}: {len(points)}; each level of each sweep "
        "parameter alone, then combinations of those that gained most for their time. Gains smaller than "
        "another seed's difference mean nothing.",
        *([f"Failed: {', '.join(failed)}; the table says why."] if failed else []),
    ]
    page = Page(
        title=f"{study.base.subject}: what accuracy costs",
        lead=headline(study),
        lines=lines,
        sections=[
            Section("The frontier", frontier_lines(study), pictures=plots(folder, study)),
            *(Section(table.title, tables=[table]) for table in tables),
            settings_section(study.base.settings, changed),
            timings_section(points["result"].to_dict(), study.seconds),
        ],
    )
    publish(folder, page, tables, pd.concat([table.values(study.base.subject) for table in tables]))


def tables_of(study: Tradeoff) -> list[Table]:
    """The points, and the registrations."""
    noise = study.noise
    chance = f" Another seed differs by {noise:.2f} dB." if math.isfinite(noise) else ""
    caption = (
        f"{sizes_of(study.base.settings)} Quality: means over held-out frames, all at the base's picture "
        "size. Seconds are processor seconds of all threads, of the run that made the result; training "
        "includes the views that were made for it, the whole job all up to training. Milliseconds: the baked "
        "avatar on one thread, the least of 15 frames, drawn at 512×512. In bold letters: on the frontier of "
        f"PSNR and training seconds.{chance}"
    )
    points = study.points
    failures = points["result"].map(lambda one: one.failure and f"failed: {one.failure}")
    presets = ("preset " + points["preset"]).where(points["preset"].ne("") & points["design"].notna(), "")
    rows = points.assign(**{NOTE: failures + presets, MAIN: points.index.isin(study.frontier())})
    rows = numbered(rows)[[*COLUMNS, NOTE, MAIN]]
    tables = [Table("tradeoff", f"What accuracy costs: {study.base.subject}", caption, rows)]
    if not study.fits.empty:
        told = (
            f"Seconds ({' and '.join(sorted(set(study.fits['clock'])))}) of the registration alone. px: mean "
            "distance of the trusted keypoints from where they were detected; mm: of the joints that the "
            "camera sees from the truth, aligned at the neck."
        )
        fits = study.fits.set_axis(study.fits.index.astype(str) + " steps")
        tables.append(
            Table("fits", "What the fit's effort buys", told, fits.drop(columns="clock"), first="fit")
        )
    return tables


PLOTS = (
    # file, cost, metric, label of the costs, label of the metric
    ("psnr_over_training", "train_s", "psnr", "processor seconds of training, views included", "PSNR, dB"),
    (
        "lpips_over_training",
        "train_s",
        "lpips_alex",
        "processor seconds of training, views included",
        "LPIPS×100",
    ),
    ("psnr_over_animation", "animation_ms", "psnr", "processor milliseconds to animate a frame", "PSNR, dB"),
)
FIT_PLOTS = (
    ("fit_pixels", "pixels", "Reprojection error, px"),
    ("fit_millimetres", "millimetres", "Joints' distance from the truth, mm"),
)


def plots(folder: Path, study: Tradeoff) -> list[Picture]:
    """Draws every plot there is something for."""
    points = study.points.assign(base=study.points.index == 1)
    pictures = []
    for name, cost, metric, across, up in PLOTS:
        shown = points.assign(x=points[cost], y=points[metric] * (100 if metric == "lpips_alex" else 1))
        expected = study.expected if cost == "train_s" else {}
        scatter(
            folder / f"{name}.png", shown, study.frontier(cost, metric), across, f"held-out {up}", expected
        )
        dashed = " Dashed: what a preset that was not run would cost, if near." if expected else ""
        told = f"Held-out {up.partition(',')[0]} against {across}. Numbers are the table's."
        pictures.append((folder / f"{name}.png", told + dashed))
    file, told = folder / "training_curves.png", (
        "Training curves of every run that learnt from the base's pictures; the frontier's in colour. "
        "Wall-clock seconds carry what else the machine was doing."
    )  # fmt: skip
    curves(
        file, training_curves(study), "wall-clock seconds of training", "PSNR of a few held-out frames, dB"
    )
    pictures.append((file, told))
    for name, error, up in FIT_PLOTS if len(study.fits) else ():
        if study.fits[error].notna().any():
            shown = study.fits.assign(x=study.fits["seconds"], y=study.fits[error])
            edge = frontier(shown["x"], -shown["y"])
            scatter(folder / f"{name}.png", shown, edge, "seconds of registration", up)
            told = f"{up.partition(',')[0]} against the registration's seconds; numbers are steps."
            pictures.append((folder / f"{name}.png", told))
    return pictures


def training_curves(study: Tradeoff) -> dict[str, list[tuple[float, float]]]:
    """Label -> (wall-clock seconds, PSNR) of a few held-out frames; the base and the frontier's best first.

    A curve is of pictures of its own run's size, so that runs of other sizes are left out.
    """
    edge = study.frontier()
    order = sorted(study.points.index, key=lambda n: (n != 1, n not in edge, -study.points["psnr"][n]))
    results, lines = numbered(study.points.loc[order])["result"], {}
    for name, result in results.items():
        if result.folders.get("ingest") == results.iloc[0].folders["ingest"]:
            train, remedy = result.folders[TRAIN], "run the train stage again"
            seconds = {mark[0]: mark[1] for mark in run_record(train)["timings"].get("curve_seconds", [])}
            line = read_curve(train / "curve.parquet", remedy).get("psnr", [])
            lines[name] = [(seconds[step], value) for step, value in line if step in seconds]
    return lines


def frontier_lines(study: Tradeoff) -> list[str]:
    """The frontier in words, the cheapest first, and how far presets lie from it."""
    points, edge = numbered(study.points), study.frontier()
    lines = [
        f"{name}: {point['psnr']:.2f} dB for {point['train_s']:.0f} s"
        for name, point in points.iloc[[number - 1 for number in edge]].iterrows()
    ]
    for number, point in study.points[study.points["preset"].ne("")].iterrows():
        where = "on" if number in edge else f"{point['short']:.2f} dB under"
        lines.append(f"Preset {point['preset']} lies {where} the frontier.")
    return lines + [
        f"Preset {name} was not run: about {spoken(cost)}." for name, cost in study.expected.items()
    ]


def headline(study: Tradeoff) -> str:
    """One sentence: the level that gains most for its time, the one that gains most; else what is as good."""
    single = study.choices["design"].map(lambda design: len(design or ()) == 1)
    levels, base = study.choices[single & study.choices["psnr"].notna()], study.points.loc[1]
    if levels.empty:
        return "The budget reached no setting but the study's own: give it more time."
    noise = study.noise if math.isfinite(study.noise) else 0.05  # what would be told as 0.0
    gaining = levels[levels["gain"] > noise]
    if gaining.empty:
        chance = f"more than another seed does ({noise:.1f} dB)" if math.isfinite(study.noise) else "anything"
        as_good = study.choices[study.choices["gain"] >= -noise].sort_values("train_s", kind="stable").iloc[0]
        perceived = f"LPIPS×100 {100 * as_good['lpips_alex']:.1f}, was {100 * base['lpips_alex']:.1f}"
        instead = (
            f"stay with {base['gaussians']:,.0f} Gaussians and {sizes_of(study.base.settings)}"
            if as_good["times"] > 0.95
            else f"{as_good['label']}, at {times(as_good)}, does as well in PSNR ({perceived})"
        )
        return f"No single change that was tried gains {chance}: {instead}."
    worth = [gain_for_time(one.gain, one.times) for one in gaining.itertuples()]
    best, most = gaining.iloc[int(np.argmax(worth))], gaining.loc[gaining["gain"].idxmax()]
    more = (
        ""
        if most is best or most.name == best.name
        else f"; the most is gained by going {change(most, base)}"
    )
    return f"Going {change(best, base)}{more}."


def change(point: pd.Series, base: pd.Series) -> str:
    """A level tried alone in words: from what to what, at how much time, for what gain."""
    level = point["design"][0]
    before, after = level.before, level.label
    if level.parameter == GAUSSIANS:
        before, after = (f"{one['gaussians']:,.0f} Gaussians" for one in (base, point))
    told = after if after.startswith("with") else f"from {before} to {after}"
    return f"{told}, at {times(point)}: {point['gain']:+.1f} dB"


def times(point: pd.Series) -> str:
    """A point's training time over the base's, in words."""
    same = abs(point["times"] - 1) <= 0.05
    return "no more training time" if same else f"{point['times']:.1f} times the training time"
