"""What each part of the method is worth: the paper's ablation tables for any subject or dataset.

Each variant is the whole method with one setting changed. The whole has everything that the paper's has, so
generated views too, which the quick preset leaves out. What two variants share is made once.
"""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from pipeline.config.request import Request
from pipeline.config.settings import read_toml
from pipeline.errors import UserError
from pipeline.run.progress import Progress
from pipeline.store.artifact import MANIFEST
from pipeline.studies.measure import AvatarMeter
from pipeline.studies.plots import bars
from pipeline.studies.report import Page, Section, publish, settings_section, sizes_of, timings_section
from pipeline.studies.tables import HERE, IMAGE, MAIN, MEAN, METRICS, NOTE, PAPER, REGIONS, RUNTIME, Table
from pipeline.studies.variants import Base, Result, Variant, base_of, scale_overrides, study_folder

FULL, CHANCE, CHANCE_LABEL = "full", "chance", "another seed"
FIXED = 0.4  # the paper's threshold by hand

VARIANTS: Mapping[str, Variant] = {
    FULL: Variant("full"),
    "no_refinement": Variant("without refinement (residual colours)", {"train.residual_from": "1"}),
    "no_views": Variant("without generated views", {"auxiliary.generator": "off"}),
    "no_gate": Variant("without visibility gate", {"plan.visibility_gate": "off"}),
    "no_masked_fit": Variant("without masked fit", {"fit.masked": "false"}),
    "weight_1": Variant("generated views' weight 1.0", {"train.generated": "1"}),
    "moves": Variant("residual also moves positions", {"train.residual_moves": "true"}),
    "whole_body": Variant("whole-body residual", {"train.residual_parts": "face,left_hand,right_hand,rest"}),
    "fixed_threshold": Variant(f"fixed threshold {FIXED}", {"train.gate_threshold": str(FIXED)}),
}
"""Key -> variant, in the paper's order; another seed comes last."""

LABELS = {**{key: variant.name for key, variant in VARIANTS.items()}, CHANCE: CHANCE_LABEL}

COLUMNS: Mapping[str, Sequence[str]] = {"runtime": list(RUNTIME), "regions": list(REGIONS)}
CAPTIONS = {
    "runtime": "Processor milliseconds of one thread, the least of 15 frames of the baked avatar in held-out "
    "poses, drawn at 512×512; asset: mean, opacity, scale, rotation and colour in float32.",
    "regions": "Means over held-out frames of square crops around face and hands.",
}
SAME = "the very same avatar as full: here it changes nothing"
CHANCE_TABLE = {
    "name": "chance",
    "title": "What chance is worth: the whole method with another seed",
    "kind": "chance",
    "rows": [{"variant": FULL}, {"variant": CHANCE}],
}


@dataclasses.dataclass(frozen=True)
class Ablation:
    """The results of an ablation.

    Attributes:
        results: (subject, key of the variant) -> result.
        scores: a row a result, indexed likewise; a column a metric or a number of the runtime.
        dataset: the one that all subjects belong to; empty if none.
        refined: whether the scores are those with held-out poses refined, as on NeuMan.
    """

    results: Mapping[tuple[str, str], Result]
    scores: pd.DataFrame
    dataset: str = ""
    refined: bool = False

    @property
    def subjects(self) -> list[str]:
        """Whose avatars."""
        return list(dict.fromkeys(subject for subject, _ in self.results))

    def gains(self, metric: str) -> pd.Series:
        """Key of a variant -> its mean difference from the whole method, over the subjects that have both.

        For another seed it is the mean of absolute differences: how large one must be to mean anything.
        """
        table = self.scores[metric].unstack()
        differences = table.sub(table[FULL], axis=0)
        differences[CHANCE] = differences[CHANCE].abs()
        return differences.mean()


def ablate(name: str, subjects: Sequence[str], request: Request) -> Path:
    """Runs every variant of the subjects and writes tables, plots and page.

    Args:
        name: of the study: a subject, or a dataset.
        subjects: whose avatars.
        request: the command line's.

    Returns:
        The study's folder.

    Raises:
        UserError: a setting is wrong, or nothing at all could be made.
    """
    scale_overrides(request)  # refused before anything is made
    start, folder = time.monotonic(), study_folder(request, "ablate", name)
    bases, results = run_all(subjects, request, folder / "log.txt")
    if all(result.failure for result in results.values()):
        raise UserError(next(iter(results.values())).failure)
    refined = all(counts_refined(base) for base in bases.values())
    ablation = Ablation(results, scores_of(bases, results, refined), dataset_of(subjects, request), refined)
    write_ablation(folder, name, ablation, next(iter(bases.values())), time.monotonic() - start)
    return folder


def run_all(
    subjects: Sequence[str], request: Request, log: Path
) -> tuple[dict[str, Base], dict[tuple[str, str], Result]]:
    """Every variant of every subject, a subject after the other; and the bases that could be read."""
    bases: dict[str, Base] = {}
    results: dict[tuple[str, str], Result] = {}
    progress = Progress(len(subjects) * (len(VARIANTS) + 1), "ablate")
    try:
        for subject in subjects:
            try:
                bases[subject] = base_of(subject, request, log, {"auxiliary.generator": "auto"})
            except UserError as error:
                results |= {(subject, key): Result(subject, key, str(error)) for key in (*VARIANTS, CHANCE)}
                progress.advance(len(VARIANTS) + 1, subject)
                continue
            for key, variant in variants_of(bases[subject]).items():
                results[subject, key] = bases[subject].run(variant)
                print(results[subject, key].line, flush=True)
                progress.advance(1, variant.name)
    finally:
        progress.close()
    return bases, results


def variants_of(base: Base) -> dict[str, Variant]:
    """The variants in the paper's order, and another seed."""
    seed = base.settings["train"].seed + 1
    return {**VARIANTS, CHANCE: Variant(CHANCE_LABEL, {"train.seed": str(seed)})}


def dataset_of(subjects: Sequence[str], request: Request) -> str:
    """The dataset that all subjects belong to; empty if none."""
    files = [request.workspace.data / "subjects" / f"{subject}.toml" for subject in subjects]
    names = {str(read_toml(file).get("dataset", "")) if file.is_file() else "" for file in files}
    return request.dataset or (names.pop() if len(names) == 1 else "")


def counts_refined(base: Base) -> bool:
    """Whether the settings ask for scores with held-out poses refined, as the paper has them on NeuMan."""
    evaluate = base.settings["evaluate"]
    return evaluate.refine_test_poses == "on" or getattr(evaluate, "protocol", "") == "paper"


def scores_of(
    bases: Mapping[str, Base], results: Mapping[tuple[str, str], Result], refined: bool
) -> pd.DataFrame:
    """Every result's scores of held-out frames and what a frame of its avatar costs; see ``Ablation``."""
    speeds: dict[str, Mapping[str, float]] = {}
    for subject, base in bases.items():
        done = [one for one in results.values() if one.subject == subject and not one.failure]
        if done:
            print(f"{subject}: timing {len(done)} avatars in motion", flush=True)
            speeds |= AvatarMeter(base.job(), done[0].folders["ingest"]).speeds(done)
    return score_table(results, speeds, refined)


def score_table(
    results: Mapping[tuple[str, str], Result], speeds: Mapping[str, Mapping[str, float]], refined: bool
) -> pd.DataFrame:
    """Scores and runtime of results, indexed by subject and variant; NaN where there is none.

    Args:
        results: as ``Ablation`` has them.
        speeds: name of the train version -> numbers of ``AvatarMeter.speeds``.
        refined: whether scores are those with held-out poses refined.
    """
    rows = [
        {}
        if one.failure
        else one.held_out("avatar_refined" if refined else "avatar") | dict(speeds[one.folders["train"].name])
        for one in results.values()
    ]
    index = pd.MultiIndex.from_tuples(list(results), names=["subject", "variant"])
    scores = pd.DataFrame(rows, index).reindex(columns=[*IMAGE, *RUNTIME, *REGIONS]).astype(float)
    scores["total_ms"] = scores["animation_ms"] + scores["rendering_ms"]
    scores["fps"] = 1e3 / scores["total_ms"]
    return scores


def tables_of(ablation: Ablation, sizes: str) -> list[Table]:
    """The paper's tables with what was measured here; those of which nothing was measured are left out.

    Args:
        ablation: its results.
        sizes: a sentence on the sizes, for the captions.
    """
    noise = ablation.gains("psnr")[CHANCE]
    sizes += f" Another seed differs by {noise:.2f} dB." if math.isfinite(noise) else ""
    described = [*read_toml(Path(__file__).with_name("paper.toml"))["tables"], CHANCE_TABLE]
    return [
        table_of(about, ablation, sizes)
        for about in described
        if ablation.scores[COLUMNS.get(about.get("kind", ""), list(IMAGE))].notna().any(axis=None)
    ]


def table_of(about: Mapping[str, Any], ablation: Ablation, sizes: str) -> Table:
    """One of the paper's tables; its own figures stand beside ours where they are of the same footage.

    Args:
        about: the table as paper.toml describes it.
        ablation: its results.
        sizes: a sentence for the caption.
    """
    keys = COLUMNS.get(about.get("kind", ""), list(IMAGE))
    wanted = [row["variant"] for row in about["rows"]]
    present = ablation.scores["psnr"].unstack()[wanted].notna().all(axis=1)
    counted = [subject for subject in ablation.subjects if present[subject]] or ablation.subjects
    same = ablation.dataset and ablation.dataset == about.get("dataset")
    same = same and ("subject" not in about or [about["subject"]] == ablation.subjects)

    def published(values: Sequence[float]) -> list[float]:
        return [value / METRICS[key].factor for key, value in zip(keys, values, strict=True)]

    rows = {}
    for row in about["rows"]:
        own = ablation.scores.xs(row["variant"], level="variant").loc[counted, keys].mean().to_dict()
        paper = (
            dict(zip((f"{PAPER} {key}" for key in keys), published(row["paper"]), strict=True))
            if same
            else {}
        )
        note = {NOTE: note_on(row["variant"], ablation, counted), MAIN: row["variant"] == FULL}
        rows[LABELS[row["variant"]]] = own | paper | note
    for row in about.get("published", ()):
        if row["dataset"] == ablation.dataset:
            values = dict(zip(keys, published(row["values"]), strict=True))
            rows[row["label"]] = {**values, NOTE: "published, on another machine"}
    poses = ", poses refined on them" if ablation.refined else ""
    caption = CAPTIONS.get(about.get("kind", ""), f"Means over held-out frames{poses}.")
    frame, ranked = pd.DataFrame.from_dict(rows, orient="index"), about.get("kind", "") != "chance"
    return Table(about["name"], about["title"], f"{caption} {sizes}", frame, ranked=ranked)


def note_on(key: str, ablation: Ablation, counted: Sequence[str]) -> str:
    """The remarks on a row: who failed, whose avatar is full's own, how many subjects it is a mean of."""
    notes, several = [], len(ablation.subjects) > 1
    for subject in ablation.subjects:
        of, one, full = (
            f" ({subject})" if several else "",
            *(ablation.results[subject, k] for k in (key, FULL)),
        )
        if one.failure:
            notes.append(f"failed{of}: {one.failure}")
        elif key not in (FULL, CHANCE) and not full.failure and avatar_digest(one) == avatar_digest(full):
            notes.append(f"{SAME}{of}")
    if len(counted) < len(ablation.subjects):
        notes.append(f"mean of {len(counted)} of {len(ablation.subjects)} subjects")
    return "; ".join(notes)


def avatar_digest(result: Result) -> str:
    """The digest of the avatar's file, as the store's manifest has it."""
    manifest = json.loads((result.folders["train"] / MANIFEST).read_text(encoding="utf-8"))
    return next(file["sha256"] for file in manifest["files"] if file["path"] == "avatar.safetensors")


def values_of(tables: Sequence[Table], ablation: Ablation) -> pd.DataFrame:
    """Every number of the tables, and each subject's own where there are several."""
    several = len(ablation.subjects) > 1
    values = [table.values(MEAN if several else ablation.subjects[0]) for table in tables]
    if several:
        own = ablation.scores.rename_axis(columns="metric").stack().rename("value").reset_index()
        own = own.assign(table="each subject", row=own["variant"].map(LABELS), source=HERE).dropna()
        values.append(own[values[0].columns])
    return pd.concat(values, ignore_index=True)


def write_ablation(folder: Path, name: str, ablation: Ablation, base: Base, seconds: float) -> None:
    """Writes the tables, the plots and the page.

    Args:
        folder: where they go.
        name: of the study.
        ablation: its results.
        base: a subject's, for the settings.
        seconds: of this call.
    """
    pictures = []
    for metric, label, file, factor in (
        ("psnr", "PSNR against full, dB", "worth_psnr.png", 1),
        ("lpips_alex", "LPIPS×100 against full, less is better", "worth_lpips.png", 100),
    ):
        gains = factor * ablation.gains(metric)
        own = pd.Series({one.name: gains[key] for key, one in VARIANTS.items() if key != FULL})
        bars(folder / file, own, label, gains[CHANCE], higher_is_better=metric == "psnr")
        pictures.append((folder / file, f"{label}; grey: by how much another seed differs."))
    several = len(ablation.subjects) > 1
    done = [one for one in ablation.results.values() if not one.failure]
    tables = tables_of(ablation, sizes_of(base.settings))
    changed = {one.name: one.overrides for one in variants_of(base).values()}
    results = {f"{one.subject}, {one.variant}" if several else one.variant: one for one in done}
    page = Page(
        title=f"{name}: what each part is worth",
        lead=headline(ablation),
        lines=[f"Subjects: {', '.join(ablation.subjects)}."] if several else [],
        sections=[
            Section("At a glance", pictures=pictures),
            Section("The paper's tables", tables=tables),
            settings_section(base.settings, changed),
            timings_section(results, seconds),
        ],
    )
    publish(folder, page, tables, values_of(tables, ablation))


def headline(ablation: Ablation) -> str:
    """One sentence: what costs most when it is left out, what gains, and what does no more than chance."""
    gains = ablation.gains("psnr")
    chance = gains[CHANCE]
    noise = chance if math.isfinite(chance) else 0.0
    gains = gains[[key for key in VARIANTS if key != FULL]].dropna()
    if gains.empty:
        return "No variant could be compared with the whole method."
    parts = []
    for key, word, counts in (
        (gains.idxmin(), "costs", gains.min() < -noise),
        (gains.idxmax(), "gains", gains.max() > noise),
    ):
        if counts:
            parts.append(f"{VARIANTS[key].name} {word} most: {gains[key]:+.2f} dB")
    within = (gains.abs() <= chance).sum()
    if within:
        parts.append(
            f"{within} of {len(gains)} variants differ by no more than another seed does ({noise:.2f} dB)"
        )
    text = "; ".join(parts) or "no variant differs from the whole method"
    return f"{text[0].upper()}{text[1:]}."
