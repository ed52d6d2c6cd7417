"""The ablation's plot and page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from pipeline.studies.ablation import CHANCE, FULL, VARIANTS, Results, full_words, variants_of
from pipeline.studies.page import Page, Picture, Section, settings_section, timings_section, write_page
from pipeline.studies.plots import bars
from pipeline.studies.tables import Table
from pipeline.study import Outcome


def write_ablation(
    folder: Path,
    name: str,
    results: Results,
    tables: Sequence[Table],
    versions: Mapping[str, str],
    seconds: float,
    words: Mapping[str, str],
) -> None:
    """Writes ``worth.png`` and ``report.html``."""
    worth, noise = differences(results), chance(results)
    pictures = []
    for metric, label, file in (
        ("psnr", "PSNR against full, dB", "worth_psnr.png"),
        ("lpips_alex", "LPIPS×100 against full, less is better", "worth_lpips.png"),
    ):
        factor = 1 if metric == "psnr" else 100
        values = {label_of(key): factor * worth(key, metric) for key in VARIANTS if key != FULL}
        bars(folder / file, values, label, factor * noise(metric), higher_is_better=metric == "psnr")
        pictures.append(Picture(folder / file, f"{label}; grey: by how much another seed differs."))
    subject = next(one.subject for one in results.endings.values() if isinstance(one, Outcome))
    own = full_words(subject, words)
    changed = {variant.name: variant.words for variant in variants_of(subject, own).values()}
    outcomes = {
        f"{one.subject}, {one.variant}" if len(results.subjects) > 1 else one.variant: one
        for one in results.endings.values()
        if isinstance(one, Outcome)
    }
    page = Page(
        title=f"{name}: what each part is worth",
        lead=headline(results),
        lines=[f"Subjects: {', '.join(results.subjects)}."] if len(results.subjects) > 1 else [],
        sections=[
            Section("At a glance", pictures=pictures),
            Section("The paper's tables", tables=tables),
            settings_section(own, subject, changed),
            timings_section(outcomes, seconds, versions),
        ],
    )
    write_page(folder / "report.html", page)


def label_of(key: str) -> str:
    """A variant's name in tables."""
    return VARIANTS[key][0] if key in VARIANTS else "another seed"


def differences(results: Results):
    """A function: variant and metric -> its mean difference from the whole method over subjects with both."""

    def worth(key: str, metric: str) -> float:
        pairs = [
            (results.value(subject, key, metric), results.value(subject, FULL, metric))
            for subject in results.subjects
        ]
        known = [one - full for one, full in pairs if math.isfinite(one) and math.isfinite(full)]
        return sum(known) / len(known) if known else math.nan

    return worth


def chance(results: Results):
    """A function: metric -> how far another seed is off, the mean of absolute differences."""

    def noise(metric: str) -> float:
        pairs = [
            (results.value(subject, CHANCE, metric), results.value(subject, FULL, metric))
            for subject in results.subjects
        ]
        known = [abs(one - full) for one, full in pairs if math.isfinite(one) and math.isfinite(full)]
        return sum(known) / len(known) if known else math.nan

    return noise


def headline(results: Results) -> str:
    """One sentence: what costs most when it is left out, and what does no more than chance."""
    worth, noise = differences(results), chance(results)("psnr")
    gaps = {key: worth(key, "psnr") for key in VARIANTS if key != FULL}
    gaps = {key: value for key, value in gaps.items() if math.isfinite(value)}
    if not gaps:
        return "No variant could be compared with the whole method."
    worst = min(gaps, key=lambda key: gaps[key])
    best = max(gaps, key=lambda key: gaps[key])
    within = [key for key, value in gaps.items() if abs(value) <= noise] if math.isfinite(noise) else []
    parts = []
    if gaps[worst] < -(noise if math.isfinite(noise) else 0):
        parts.append(f"{label_of(worst)} costs most: {gaps[worst]:+.2f} dB")
    if gaps[best] > (noise if math.isfinite(noise) else 0):
        parts.append(f"{label_of(best)} gains most: {gaps[best]:+.2f} dB")
    if within:
        parts.append(
            f"{len(within)} of {len(gaps)} variants differ by no more than another seed does ({noise:.2f} dB)"
        )
    text = "; ".join(parts) or "no variant differs from the whole method"
    return f"{text[0].upper()}{text[1:]}."
