"""What each part of the method is worth: the paper's ablation tables for any subject or dataset.

Each variant is the whole method with one setting changed. The whole has everything that the paper's has, so
generated views too, which the quick preset leaves out. What two variants share is made once.
"""

from __future__ import annotations

import dataclasses
import json
import math
import statistics
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.artifact import MANIFEST
from pipeline.config.request import parse_request
from pipeline.digest import write_atomically
from pipeline.errors import UserError
from pipeline.job import open_job, shown
from pipeline.settings import read_toml
from pipeline.stage import Progress
from pipeline.studies.run import Ending, Failure, base_words, run_variants, scale_words, study_folder
from pipeline.studies.sizes import sizes_of, versions_of
from pipeline.studies.tables import HERE, MEAN, PAPER, Column, Row, Table, Value, values_of
from pipeline.study import Outcome, Variant
from pipeline.workspace import Workspace

FULL, CHANCE = "full", "chance"
REFINED = "avatar_refined"  # evaluate's name for it
WHOLE_BODY = "face,left_hand,right_hand,rest"
FIXED = 0.4  # the paper's threshold by hand

VARIANTS: Mapping[str, tuple[str, Mapping[str, str]]] = {
    FULL: ("full", {}),
    "no_refinement": ("without refinement (residual colours)", {"train.residual_from": "1"}),
    "no_views": ("without generated views", {"auxiliary.generator": "off"}),
    "no_gate": ("without visibility gate", {"plan.visibility_gate": "off"}),
    "no_masked_fit": ("without masked fit", {"fit.masked": "false"}),
    "weight_1": ("generated views' weight 1.0", {"train.generated": "1"}),
    "moves": ("residual also moves positions", {"train.residual_moves": "true"}),
    "whole_body": ("whole-body residual", {"train.residual_parts": WHOLE_BODY}),
    "fixed_threshold": (f"fixed threshold {FIXED}", {"train.gate_threshold": str(FIXED)}),
}
"""Variant -> its label and what it changes, in the paper's order; another seed comes last."""

IMAGE = (
    Column("psnr", "PSNR", 2, "higher"),
    Column("ssim", "SSIM", 4, "higher"),
    Column("lpips_alex", "LPIPS×100", 2, "lower", 100.0),
)
RUNTIME = (
    Column("gaussians", "#G", 0),
    Column("asset_mib", "asset MB", 2, "lower"),
    Column("animation_ms", "animation ms", 1, "lower"),
    Column("rendering_ms", "rendering ms", 1, "lower"),
    Column("total_ms", "total ms", 1, "lower"),
    Column("fps", "frames/s", 1, "higher"),
)
EVEN = tuple(dataclasses.replace(column, better="") for column in IMAGE)  # neither row is the better one
REGIONS = tuple(
    dataclasses.replace(column, key=f"{column.key}_{region}", label=f"{region} {column.label}")
    for region in ("face", "hands")
    for column in IMAGE
)
COLUMNS = {"runtime": RUNTIME, "regions": REGIONS, "chance": EVEN}
SAME = "the very same avatar as full: here it changes nothing"


@dataclasses.dataclass(frozen=True)
class Results:
    """What an ablation came to.

    Attributes:
        subjects: whose avatars.
        endings: (subject, variant) -> outcome or failure.
        speeds: (subject, variant) -> numbers of ``pipeline.studies.clip.speeds``.
        dataset: the one that all subjects belong to; empty if none.
        refined: whether the numbers that count are those with held-out poses refined, as on NeuMan.
    """

    subjects: tuple[str, ...]
    endings: Mapping[tuple[str, str], Ending]
    speeds: Mapping[tuple[str, str], Mapping[str, float]]
    dataset: str = ""
    refined: bool = False

    def outcome(self, subject: str, variant: str) -> Outcome | None:
        """The outcome, None where the variant failed or was not reached."""
        ending = self.endings.get((subject, variant))
        return ending if isinstance(ending, Outcome) else None

    def value(self, subject: str, variant: str, key: str) -> float:
        """A metric of the held-out frames, or a number of the runtime; NaN where there is none."""
        outcome = self.outcome(subject, variant)
        if outcome is None:
            return math.nan
        speed = self.speeds.get((subject, variant), {})
        if key in ("total_ms", "fps"):
            total = speed.get("animation_ms", math.nan) + speed.get("rendering_ms", math.nan)
            return total if key == "total_ms" else 1e3 / total
        if key in speed:
            return speed[key]
        return outcome.held_out(key, REFINED if self.refined else "avatar")


def ablate(name: str, subjects: Sequence[str], words: Mapping[str, str]) -> Path:
    """Runs every variant of the subjects and writes tables, plots and page.

    Args:
        name: of the study: a subject, or a dataset.
        subjects: whose avatars.
        words: the command line's.

    Returns:
        The study's folder.

    Raises:
        UserError: a word is wrong, or nothing at all could be made.
    """
    scale_words(words)  # before anything is made
    workspace = parse_request(words).workspace
    folder, start = study_folder(workspace, "ablate", name), time.monotonic()
    endings = run_all(subjects, words, folder / "log.txt")
    results = Results(
        subjects=tuple(subjects),
        endings=endings,
        speeds=speeds_of(endings, words, workspace),
        dataset=dataset_of(workspace, subjects, words),
        refined=all(counts_refined(subject, words) for subject in subjects),
    )
    if not any(isinstance(one, Outcome) for one in endings.values()):
        raise UserError(next(one.reason for one in endings.values() if isinstance(one, Failure)))
    publish(folder, name, results, words, time.monotonic() - start)
    return folder


def run_all(subjects: Sequence[str], words: Mapping[str, str], log: Path) -> dict[tuple[str, str], Ending]:
    """Every variant of every subject, a subject after the other."""
    endings: dict[tuple[str, str], Ending] = {}
    progress = Progress(len(subjects) * (len(VARIANTS) + 1), "ablate")
    try:
        for subject in subjects:
            try:
                own = full_words(subject, words)
            except UserError as error:
                endings |= {(subject, key): Failure(subject, key, str(error)) for key in VARIANTS}
                progress.advance(len(VARIANTS) + 1, subject)
                continue
            for key, variant in variants_of(subject, own).items():
                endings[subject, key] = run_variants(subject, [variant], own, log, progress)[0]
    finally:
        progress.close()
    return endings


def full_words(subject: str, words: Mapping[str, str]) -> dict[str, str]:
    """The whole method: with generated views if the plan asks for them, unless words say otherwise."""
    return {"auxiliary.generator": "auto", **base_words(subject, words)}


def variants_of(subject: str, own: Mapping[str, str]) -> dict[str, Variant]:
    """The variants in the paper's order, and another seed."""
    seed = open_job(subject, parse_request(own, subject)).settings["train"].seed + 1
    found = {key: Variant(label, words) for key, (label, words) in VARIANTS.items()}
    return {**found, CHANCE: Variant("another seed", {"train.seed": str(seed)})}


def dataset_of(workspace: Workspace, subjects: Sequence[str], words: Mapping[str, str]) -> str:
    """The dataset that all subjects belong to, or nothing."""
    if "dataset" in words:
        return words["dataset"]
    files = [workspace.data / "subjects" / f"{subject}.toml" for subject in subjects]
    names = {str(read_toml(file).get("dataset", "")) if file.is_file() else "" for file in files}
    return names.pop() if len(names) == 1 else ""


def counts_refined(subject: str, words: Mapping[str, str]) -> bool:
    """Whether the settings ask for numbers with held-out poses refined, as the paper has them on NeuMan."""
    evaluate = open_job(subject, parse_request(full_words(subject, words), subject)).settings["evaluate"]
    return evaluate.refine_test_poses == "on" or getattr(evaluate, "protocol", "") == "paper"


def speeds_of(
    endings: Mapping[tuple[str, str], Ending], words: Mapping[str, str], workspace: Workspace
) -> dict[tuple[str, str], dict[str, float]]:
    """What a frame of each avatar costs; measured once."""
    from pipeline.studies.clip import speeds  # torch, which the DAG does without
    from pipeline.studies.measured import clip_of, notes_of

    found: dict[tuple[str, str], dict[str, float]] = {}
    for subject in dict.fromkeys(subject for subject, _ in endings):
        made = {key: one for key, one in endings.items() if key[0] == subject and isinstance(one, Outcome)}
        if not made:
            continue
        print(f"{subject}: timing {len(made)} avatars in motion", flush=True)
        clip = clip_of(next(iter(made.values())), words, workspace)
        by_key = speeds(list(made.values()), clip, notes_of(workspace, subject))
        found |= {key: by_key[one.folders["train"].name] for key, one in made.items()}
    return found


def tables_of(results: Results, sizes: str) -> list[Table]:
    """The paper's tables with what was measured here.

    Args:
        results: of every variant.
        sizes: a sentence on the sizes, for the captions.
    """
    described = read_toml(Path(__file__).with_name("paper.toml"))["tables"]
    psnr = [[results.value(one, which, "psnr") for which in (CHANCE, FULL)] for one in results.subjects]
    gap = _mean([abs(other - full) for other, full in psnr])
    sizes += f" Another seed differs by {gap:.2f} dB." if math.isfinite(gap) else ""
    tables = [_table(one, results, sizes) for one in described]
    chance = {
        "name": "chance",
        "title": "What chance is worth: the whole method with another seed",
        "kind": "chance",
        "rows": [{"variant": FULL}, {"variant": CHANCE}],
    }
    return [table for table in (*tables, _table(chance, results, sizes)) if not _empty(table)]


def _empty(table: Table) -> bool:
    """Whether nothing of a table was measured: what evaluate was not asked for."""
    own = [value for row in table.rows for (_, source), value in row.values.items() if source == HERE]
    return not any(math.isfinite(value) for value in own)


def _table(about: Mapping[str, Any], results: Results, sizes: str) -> Table:
    columns = COLUMNS.get(about.get("kind", ""), IMAGE)
    same = results.dataset and results.dataset == about.get("dataset")
    if same and "subject" in about:
        same = results.subjects == (about["subject"],)
    published = (
        [dataclasses.replace(column, source=PAPER) for column in columns]
        if same and any("paper" in row for row in about["rows"])
        else []
    )
    rows = [_row(row, about, results, columns, bool(published)) for row in about["rows"]]
    for row in about.get("published", ()):
        if row["dataset"] == results.dataset:
            numbers = zip(columns, row["values"], strict=True)
            values = {
                (column.key, HERE): (value / column.factor if column.factor != 1 else value)
                for column, value in numbers
            }
            rows.append(Row(row["label"], values, "published, on another machine"))
    poses = ", poses refined on them" if results.refined else ""
    how = HOW.get(about.get("kind", ""), f"Means over held-out frames{poses}.")
    return Table(about["name"], about["title"], f"{how} {sizes}", [*columns, *published], rows)


HOW = {
    "runtime": "Processor milliseconds of one thread, the least of 15 frames of the baked avatar in held-out "
    "poses, drawn at 512×512; asset: mean, opacity, scale, rotation and colour in float32.",
    "regions": "Means over held-out frames of square crops around face and hands.",
}


def _row(
    row: Mapping[str, Any],
    about: Mapping[str, Any],
    results: Results,
    columns: Sequence[Column],
    published: bool,
) -> Row:
    variant = row["variant"]
    label = "another seed" if variant == CHANCE else VARIANTS[variant][0]
    counted = complete(about, results)
    values = {
        (column.key, HERE): _mean([results.value(subject, variant, column.key) for subject in counted])
        for column in columns
    }
    if published and "paper" in row:
        for column, value in zip(columns, row["paper"], strict=True):
            values[column.key, PAPER] = value / column.factor
    return Row(label, values, note_on(variant, results, counted), main=variant == FULL)


def complete(about: Mapping[str, Any], results: Results) -> tuple[str, ...]:
    """The subjects that have every row of a table, so that its means are over the same; else all."""
    wanted = [row["variant"] for row in about["rows"]]
    whole = tuple(
        subject for subject in results.subjects if all(results.outcome(subject, one) for one in wanted)
    )
    return whole or results.subjects


def note_on(variant: str, results: Results, counted: Sequence[str]) -> str:
    """What must be said of a row: who failed, whose avatar is full's own, how many it is a mean of."""
    notes = []
    for subject in results.subjects:
        ending = results.endings.get((subject, variant))
        if isinstance(ending, Failure):
            notes.append(f"failed{_of(subject, results)}: {ending.reason}")
        elif variant not in (FULL, CHANCE) and _same_avatar(results, subject, variant):
            notes.append(f"{SAME}{_of(subject, results)}")
    if len(counted) < len(results.subjects):
        notes.append(f"mean of {len(counted)} of {len(results.subjects)} subjects")
    return "; ".join(notes)


def _of(subject: str, results: Results) -> str:
    return f" ({subject})" if len(results.subjects) > 1 else ""


def _same_avatar(results: Results, subject: str, variant: str) -> bool:
    one, full = results.outcome(subject, variant), results.outcome(subject, FULL)
    return one is not None and full is not None and avatar_digest(one) == avatar_digest(full)


def avatar_digest(outcome: Outcome) -> str:
    """The digest of the avatar's file, as the store's manifest has it."""
    manifest = json.loads((outcome.folders["train"] / MANIFEST).read_text(encoding="utf-8"))
    return next(file["sha256"] for file in manifest["files"] if file["path"] == "avatar.safetensors")


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if math.isfinite(value)]
    return statistics.fmean(known) if known else math.nan


def parquet_values(tables: Sequence[Table], results: Results) -> list[Value]:
    """Every number of the tables, and each subject's own where there are several."""
    several = len(results.subjects) > 1
    values = [one for table in tables for one in values_of(table, MEAN if several else results.subjects[0])]
    if several:
        keys = {column.key for column in (*IMAGE, *RUNTIME, *REGIONS)}
        labels = {**{key: label for key, (label, _) in VARIANTS.items()}, CHANCE: "another seed"}
        values += [
            Value("each subject", labels[variant], subject, key, HERE, value)
            for subject, variant in results.endings
            for key in sorted(keys)
            if math.isfinite(value := results.value(subject, variant, key))
        ]
    return values


def publish(folder: Path, name: str, results: Results, words: Mapping[str, str], seconds: float) -> None:
    """Writes the tables, the plot and the page, and says where they are."""
    from pipeline.studies.ablation_report import write_ablation
    from pipeline.studies.page import total_time
    from pipeline.studies.tables import latex, markdown, write_values

    first = next(one for one in results.endings.values() if isinstance(one, Outcome))
    sizes = sizes_of(full_words(first.subject, words), first)
    tables = tables_of(results, sizes)
    write_atomically(folder / "table.md", "\n".join(markdown(table) for table in tables))
    write_atomically(folder / "table.tex", "\n".join(latex(table) for table in tables))
    write_values(folder / "table.parquet", parquet_values(tables, results))
    write_ablation(folder, name, results, tables, versions_of(first), seconds, words)
    print("\n".join(markdown(table) for table in tables))
    made = [one for one in results.endings.values() if isinstance(one, Outcome)]
    print(f"{total_time(made)} This call: {seconds:.0f} s; tables, plots and page: {shown(folder)}")
