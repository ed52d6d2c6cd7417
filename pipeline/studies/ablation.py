"""What each part of the method is worth: the paper's ablation tables for any subject or dataset.

Each variant is the whole method with one setting changed. The whole has everything that the paper's has, so
generated views too, which the quick preset leaves out. What two variants share is made once.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from pipeline.config.evaluation_protocol import ON, chosen
from pipeline.config.request import Request
from pipeline.config.settings import as_dict, read_toml
from pipeline.errors import UserError
from pipeline.run.progress import Progress
from pipeline.store.artifact import read_manifest
from pipeline.studies.measure import AvatarMeter, Numbers, score_table
from pipeline.studies.plots import bars
from pipeline.studies.report import Page, Section, publish
from pipeline.studies.sweep import sizes_of
from pipeline.studies.tables import HERE, IMAGE, MAIN, MEAN, METRICS, NOTE, PAPER, Table
from pipeline.studies.variants import Base, Result, Variant, another_seed, base_of

FULL, CHANCE = "full", "chance"
FIXED = 0.4  # the paper's threshold by hand

VARIANTS: Mapping[str, Variant] = {
    FULL: Variant("full"),
    "no_refinement": Variant("without refinement (residual colours)", {"train.residual_from": "1"}),
    "no_views": Variant("without generated views", {"auxiliary.generator": "off"}),
    "no_gate": Variant("without visibility gate", {"plan.visibility_gate": "off"}),
    "no_masked_fit": Variant("without masked fit", {"fit.masked": "false"}),
    "weight_1": Variant("generated views' weight 1.0", {"train.generated": "1"}),
    "weight_equal": Variant("generated views' weights as captured", {"train.generated_as_captured": "true"}),
    "moves": Variant("residual also moves positions", {"train.residual_moves": "true"}),
    "whole_body": Variant("whole-body residual", {"train.residual_parts": "face,left_hand,right_hand,rest"}),
    "fixed_threshold": Variant(f"fixed threshold {FIXED}", {"train.gate_threshold": str(FIXED)}),
}
"""Key -> variant, in the paper's order; another seed comes last."""

LABELS = {**{key: variant.name for key, variant in VARIANTS.items()}, CHANCE: "another seed"}

SAME = "the very same avatar as full: here it changes nothing"


@dataclasses.dataclass(frozen=True)
class Ablation:
    """The results of an ablation.

    Attributes:
        scores: as ``score_table`` gives them, indexed by ``subject`` and ``variant``, the variant's key.
        dataset: the one that all subjects belong to; empty if none.
        refined: whether the scores are those with held-out poses refined, as on NeuMan.
    """

    scores: pd.DataFrame
    dataset: str = ""
    refined: bool = False

    @property
    def subjects(self) -> list[str]:
        """Whose avatars."""
        return self.scores.index.unique("subject").tolist()

    def gains(self, metric: str) -> pd.Series:
        """Key of a variant -> its mean difference from the whole method, over the subjects that have both.

        For another seed it is the mean of absolute differences: how large one must be to mean anything.
        """
        table = self.scores[metric].unstack()
        differences = table.sub(table[FULL], axis=0)
        differences[CHANCE] = differences[CHANCE].abs()
        return differences.mean()


def ablate(name: str, subjects: Sequence[str], request: Request) -> Path:
    """Runs every variant of the subjects, one after the other, and writes tables, plots and page.

    Args:
        name: of the study: a subject, or a dataset.
        subjects: whose avatars.
        request: the command line's.

    Returns:
        The study's folder.

    Raises:
        UserError: a setting is wrong, or nothing at all could be made.
    """
    start, folder = time.monotonic(), request.workspace.data / "studies" / "ablate" / name
    bases: dict[str, Base] = {}
    results: dict[tuple[str, str], Result] = {}
    with contextlib.closing(Progress(len(subjects) * len(LABELS), "ablate")) as progress:
        for subject in subjects:
            try:
                base = base_of(subject, request, folder / "log.txt", views=True)
            except UserError as error:
                results |= {(subject, key): Result(subject, key, str(error)) for key in LABELS}
                progress.advance(len(LABELS), subject)
                continue
            bases[subject] = base
            for key, variant in variants_of(base).items():
                results[subject, key] = base.run(variant)
                print(results[subject, key].line, flush=True)
                progress.advance(1, variant.name)
    if all(result.failure for result in results.values()):
        raise UserError(next(iter(results.values())).failure)
    speeds: dict[Path, Numbers] = {}
    for subject, base in bases.items():  # each subject's avatars are timed together
        done = [one for one in results.values() if one.subject == subject and not one.failure]
        if done:
            speeds |= AvatarMeter(base.job(), done[0].folders["ingest"]).speeds(done)
    refined = all(counts_refined(base) for base in bases.values())
    scores = score_table(results, speeds, "avatar_refined" if refined else "avatar")
    ablation = Ablation(scores.rename_axis(["subject", "variant"]), dataset_of(subjects, request), refined)
    write_ablation(folder, name, ablation, next(iter(bases.values())), time.monotonic() - start)
    return folder


def variants_of(base: Base) -> dict[str, Variant]:
    """The variants in the paper's order, and another seed."""
    return {**VARIANTS, CHANCE: another_seed(base.settings)}


def dataset_of(subjects: Sequence[str], request: Request) -> str:
    """The dataset that all subjects belong to; empty if none."""
    files = [request.workspace.definitions("subjects") / f"{subject}.toml" for subject in subjects]
    names = {str(read_toml(file).get("dataset", "")) if file.is_file() else "" for file in files}
    return request.dataset or (names.pop() if len(names) == 1 else "")


def counts_refined(base: Base) -> bool:
    """Whether the settings ask for scores with held-out poses refined, as the paper has them on NeuMan."""
    return chosen(as_dict(base.settings["evaluate"])).refine_test_poses == ON


def tables_of(ablation: Ablation, sizes: str) -> list[Table]:
    """The paper's tables with what was measured here; those of which nothing was measured are left out.

    ``sizes`` stand in the captions, see ``sizes_of``.
    """
    noise = ablation.gains("psnr")[CHANCE]
    chance = f" Another seed differs by {noise:.2f} dB." if math.isfinite(noise) else ""
    return [
        table_of(about, ablation, f"Sizes: {sizes}.{chance}")
        for about in read_toml(Path(__file__).with_name("paper.toml"))["tables"]
        if ablation.scores[about.get("columns", list(IMAGE))].notna().any(axis=None)
    ]


def table_of(about: Mapping[str, Any], ablation: Ablation, remark: str) -> Table:
    """One of the paper's tables; its own figures stand beside ours where they are of the same footage.

    Args:
        about: the table as paper.toml describes it.
        ablation: its results.
        remark: ends the caption.
    """
    keys, wanted = about.get("columns", list(IMAGE)), [row["variant"] for row in about["rows"]]
    factors = [METRICS[key].factor for key in keys]
    present = ablation.scores["psnr"].unstack()[wanted].notna().all(axis=1)
    counted = [subject for subject in ablation.subjects if present[subject]] or ablation.subjects
    own = ablation.scores.loc[(counted, wanted), keys].groupby("variant").mean().loc[wanted]
    same = ablation.dataset and ablation.dataset == about.get("dataset")
    if same and ("subject" not in about or [about["subject"]] == ablation.subjects):
        paper = pd.DataFrame([row["paper"] for row in about["rows"]], wanted, keys) / factors
        own = own.join(paper.add_prefix(f"{PAPER} "))
    own[NOTE] = [note_on(key, ablation, counted) for key in wanted]
    own[MAIN] = [key == FULL for key in wanted]
    rows = [own.rename(LABELS)]
    for row in about.get("published", ()):
        if row["dataset"] == ablation.dataset:
            published = pd.DataFrame([row["values"]], [row["label"]], keys) / factors
            rows.append(published.assign(**{NOTE: "published, on another machine", MAIN: False}))
    poses = ", poses refined on them" if ablation.refined else ""
    caption = f"{about.get('caption', f'Means over held-out frames{poses}.')} {remark}"
    table, ranked = pd.concat(rows).rename_axis(None), about.get("ranked", True)
    return Table(about["name"], about["title"], caption, table, ranked=ranked)


def note_on(key: str, ablation: Ablation, counted: Sequence[str]) -> str:
    """The remarks on a row: who failed, whose avatar is full's own, how many subjects it is a mean of."""
    notes, count = [], len(ablation.subjects)
    for subject in ablation.subjects:
        of = f" ({subject})" if count > 1 else ""
        one, full = (ablation.scores.loc[(subject, name), "result"] for name in (key, FULL))
        if one.failure:
            notes.append(f"failed{of}: {one.failure}")
        elif key not in (FULL, CHANCE) and not full.failure and avatar_digest(one) == avatar_digest(full):
            notes.append(f"{SAME}{of}")
    notes += [f"mean of {len(counted)} of {count} subjects"] if len(counted) < count else []
    return "; ".join(notes)


def avatar_digest(result: Result) -> str:
    """The digest of the avatar's file, as the store's manifest has it."""
    files = (read_manifest(result.folders["train"]) or {"files": []})["files"]
    return next((file["sha256"] for file in files if file["path"] == "avatar.safetensors"), "")


def values_of(tables: Sequence[Table], ablation: Ablation) -> pd.DataFrame:
    """Every number of the tables, and each subject's own where there are several."""
    several = len(ablation.subjects) > 1
    values = [table.values(MEAN if several else ablation.subjects[0]) for table in tables]
    if several:
        own = ablation.scores[list(dict.fromkeys(key for table in tables for key in table.numbers))]
        own = own.rename_axis(columns="metric").stack().rename("value").reset_index().dropna()
        own = own.assign(table="each subject", row=own["variant"].map(LABELS), source=HERE)
        values.append(own[values[0].columns])
    return pd.concat(values, ignore_index=True)


BARS = (
    # metric, factor, label, file
    ("psnr", 1, "PSNR against full, dB", "worth_psnr.png"),
    ("lpips_alex", 100, "LPIPS×100 against full, less is better", "worth_lpips.png"),
)


def write_ablation(folder: Path, name: str, ablation: Ablation, base: Base, seconds: float) -> None:
    """Writes the tables, the plots and the page, with one subject's settings and the seconds of this call."""
    pictures = []
    for metric, factor, label, file in BARS:
        gains = factor * ablation.gains(metric)
        shown = gains.reindex(list(VARIANTS)).drop(FULL).rename(LABELS)
        bars(folder / file, shown, label, gains[CHANCE], METRICS[metric].better == "higher")
        pictures.append((folder / file, f"{label}; grey: by how much another seed differs."))
    several = len(ablation.subjects) > 1
    tables = tables_of(ablation, sizes_of(base.settings))
    sections = [Section("At a glance", pictures=pictures), Section("The paper's tables", tables=tables)]
    lines = [f"Subjects: {', '.join(ablation.subjects)}."] if several else []
    changed = {one.name: one.overrides for one in variants_of(base).values()}
    results = {f"{o.subject}, {o.variant}" if several else o.variant: o for o in ablation.scores["result"]}
    title = f"{name}: what each part is worth"
    page = Page(title, headline(ablation), lines, sections, base, changed, results, seconds)
    publish(folder, page, values_of(tables, ablation))


def headline(ablation: Ablation) -> str:
    """One sentence: what costs most when it is left out, what gains, and what does no more than chance."""
    gains = ablation.gains("psnr")
    chance = gains[CHANCE]
    noise = chance if math.isfinite(chance) else 0.0
    gains = gains.reindex(list(VARIANTS)).drop(FULL).dropna().rename(LABELS)
    if gains.empty:
        return "No variant could be compared with the whole method."
    parts = []
    if gains.min() < -noise:
        parts.append(f"{gains.idxmin()} costs most: {gains.min():+.2f} dB")
    if gains.max() > noise:
        parts.append(f"{gains.idxmax()} gains most: {gains.max():+.2f} dB")
    within = (gains.abs() <= chance).sum()
    if within:
        others = f"{within} of {len(gains)} variants differ"
        parts.append(f"{others} by no more than another seed does ({noise:.2f} dB)")
    text = "; ".join(parts) or "no variant differs from the whole method"
    return f"{text[0].upper()}{text[1:]}."
