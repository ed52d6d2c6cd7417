"""What each part of the model and of the objective earns: ``python -m benchmarks.earn [--quick]``.

The whole model, then the same with each part left out, on mannequins and on real clips: held-out PSNR, SSIM
and LPIPS of the person, and processor seconds of training. A second seed of the whole model says how large
a difference must be to mean anything. Every run is a version in the store, so that an interrupted benchmark
goes on where it was. Small sizes (no subdivision, few iterations): a part that needs a long run to pay
shows less here than it is worth.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks.machine import described
from pipeline.study import Outcome, Variant, outcome_of

MANNEQUINS = ("mannequin_full", "mannequin_upper", "mannequin_head")
REAL = ("smile", "oliver", "carphone", "balance")
METRICS = {"psnr": 1, "psnr_interior": 1, "ssim": 100, "lpips_alex": 100}
"""What is compared, and the factor that tables show it with."""

WHOLE, NOISE = "whole", "another seed"

BASE = {
    "train.iterations": "400",
    "train.subdivisions": "0",
    "train.lpips": "0.2",
    "train.face": "0.8",
    "evaluate.training_frames": "1",
    "evaluate.comparison_frames": "1",
    "evaluate.turntable_frames": "4",
}
"""The quick preset with every term of the paper's objective, without subdivision."""

PARTS = {
    "pose heads": {"train.pose_heads_from": "1"},
    "residual colours": {"train.residual_from": "1"},
    "face loss": {"train.face": "0"},
    "LPIPS": {"train.lpips": "0"},
    "SSIM": {"train.ssim": "0"},
    "pose refinement": {"train.refine_poses": "false"},
    "noise on the pose": {"train.pose_noise": "0"},
    "first colours": {"train.initial_color": "false"},
    "smooth offsets": {"train.laplacian_offset": "0", "train.laplacian_offset_face": "0"},
    "smooth scales": {"train.laplacian_scale": "0", "train.laplacian_scale_face": "0"},
    "smooth colours": {"train.laplacian_color": "0", "train.laplacian_color_hands": "0"},
    "small offsets": {"train.offset": "0", "train.offset_hands": "0", "train.offset_face": "0"},
    "small pose offsets": {"train.pose_offset": "0"},
    "scales that do not grow": {"train.scale_growth": "0"},
    "small residuals": {"train.residual_size": "0"},
}
"""What is left out, a variant each."""

ADDED = {
    "hands inwards": {"train.hand_normal": "1"},
    "small scales": {"train.scale_size": "1", "train.scale_size_hands": "1000"},
    "one colour a hand": {"train.hand_color": "0.01"},
    "arms' lower sides": {"train.arm_color": "0.1"},
}
"""The paper's regularisers that the quick preset leaves out: added, a variant each."""


@dataclasses.dataclass(frozen=True)
class Row:
    """A variant over all subjects.

    Attributes:
        variant: its name.
        gain: metric -> subject -> what the part gives: whole minus variant, or variant minus whole for
            what is added; LPIPS with its sign turned, so that more is always better.
        cost: subject -> processor seconds that it takes, as a share of the variant without it.
    """

    variant: str
    gain: Mapping[str, Mapping[str, float]]
    cost: Mapping[str, float]


def variants(quick: bool) -> tuple[Variant, ...]:
    """The whole model, the whole with another seed, and each part's variant."""
    chosen = {name: PARTS[name] for name in ("pose heads", "LPIPS")} if quick else {**PARTS, **ADDED}
    return (
        Variant(WHOLE),
        Variant(NOISE, {"train.seed": "1"}),
        *(Variant(name, words) for name, words in chosen.items()),
    )


def row_of(variant: str, whole: Sequence[Outcome], others: Sequence[Outcome]) -> Row:
    """What a part gives and costs, from the outcomes of the same subjects with and without it."""
    sign = -1.0 if variant in ADDED else 1.0
    gain: dict[str, dict[str, float]] = {metric: {} for metric in METRICS}
    cost = {}
    for one, other in zip(whole, others, strict=True):
        for metric in METRICS:
            better = -sign if metric.startswith("lpips") else sign
            gain[metric][one.subject] = better * (one.held_out(metric) - other.held_out(metric))
        pair = (one, other) if variant not in ADDED else (other, one)
        cost[one.subject] = pair[0].cpu_seconds["train"] / pair[1].cpu_seconds["train"] - 1
    return Row(variant, gain, cost)


def main(arguments: list[str] | None = None) -> None:
    """Run what the store does not hold, print the tables and one headline line."""
    options = _options(arguments)
    subjects = options.subjects or (("mannequin_head",) if options.quick else (*MANNEQUINS, *REAL))
    words = {**BASE, **({"train.iterations": "60"} if options.quick else {})}
    print(f"{described()}; {words['train.iterations']} iterations, no subdivision")
    outcomes: dict[str, list[Outcome]] = {}
    for variant in variants(options.quick):
        for subject in subjects:
            outcomes.setdefault(variant.name, []).append(outcome_of(subject, variant, words, options.log))
        print(_line(variant.name, outcomes[variant.name]), flush=True)
    rows = [row_of(name, outcomes[WHOLE], others) for name, others in outcomes.items() if name != WHOLE]
    print(_table(rows, subjects))
    if options.json is not None:
        record = {"subjects": subjects, "words": words, "rows": [dataclasses.asdict(row) for row in rows]}
        options.json.write_text(json.dumps(record, indent=1) + "\n")
    print(_headline(rows))


def _options(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.earn", description="What each part earns.")
    parser.add_argument("--quick", action="store_true", help="one mannequin, two parts, 60 iterations")
    parser.add_argument("--subjects", nargs="+", metavar="NAME", help="whose avatars")
    parser.add_argument("--log", type=Path, metavar="FILE", help="where the stages' own lines go")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every number there")
    return parser.parse_args(arguments)


def _line(name: str, outcomes: Sequence[Outcome]) -> str:
    """A variant's absolute numbers, so that a long run can be watched."""
    cells = [
        f"{one.subject} {one.held_out('psnr'):.2f} dB {100 * one.held_out('lpips_alex'):.2f} "
        f"{one.cpu_seconds['train']:.0f} s"
        for one in outcomes
    ]
    return f"{name}: {'; '.join(cells)}"


def _table(rows: Sequence[Row], subjects: Sequence[str]) -> str:
    """Markdown: PSNR that a part gives on each subject, then its means over them and its cost."""
    head = ["part", *subjects, "PSNR dB", "inside dB", "SSIM x100", "LPIPS x100", "time"]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for row in rows:
        each = [f"{row.gain['psnr'][subject]:+.2f}" for subject in subjects]
        means = [f"{_mean(row.gain[name]) * scale:+.2f}" for name, scale in METRICS.items()]
        lines.append("| " + " | ".join([row.variant, *each, *means, f"{_mean(row.cost):+.0%}"]) + " |")
    return "\n".join(lines)


def _headline(rows: Sequence[Row]) -> str:
    """What earns most, what earns nothing."""
    noise = max(abs(value) for row in rows if row.variant == NOISE for value in row.gain["psnr"].values())
    parts = [row for row in rows if row.variant != NOISE]
    best = max(parts, key=lambda row: _mean(row.gain["psnr"]))
    idle = [row.variant for row in parts if max(row.gain["psnr"].values()) <= noise]
    return (
        f"{best.variant} earns most: {_mean(best.gain['psnr']):+.2f} dB; no more than the seed "
        f"({noise:.2f} dB) anywhere: {', '.join(idle) or 'nothing'}"
    )


def _mean(values: Mapping[str, float]) -> float:
    known = [value for value in values.values() if not math.isnan(value)]
    return statistics.fmean(known) if known else math.nan


if __name__ == "__main__":
    main()
