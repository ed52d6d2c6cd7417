"""What each part of the model and of the objective earns: ``python -m benchmarks.earn [--quick]``.

The whole model, then the same with each part left out, on mannequins and on real clips: held-out PSNR, SSIM
and LPIPS of the person, PSNR of face and hands, and processor seconds of training. A second seed of the whole
model says how large a difference must be to mean anything. With ``--json FILE`` what the file holds is not
computed again, so that an interrupted benchmark goes on where it was. Small sizes (no subdivision, few
iterations, small pictures): a part that needs a long run to pay shows less here than it is worth. With
``--long`` the sizes are those of the quick preset, one run as long as the main job's training.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from benchmarks.machine import described, prepare
from benchmarks.training import JudgedClip, trained
from pipeline.clip.frames import write_png
from pipeline.config.request import parse_request
from pipeline.metrics import Lpips
from pipeline.run.job import open_job
from pipeline.run.process import make_results
from stages.evaluate.frame_metrics import Scorer

MANNEQUINS = ("mannequin_full", "mannequin_upper", "mannequin_head")
REAL = ("smile", "oliver", "carphone", "balance")
METRICS = {"psnr": 1, "psnr_interior": 1, "ssim": 100, "lpips_alex": 100, "psnr_face": 1, "psnr_hands": 1}
"""What is compared, and the factor that tables show it with."""

WHOLE, NOISE, RESIDUALS = "whole", "another seed", "residual colours"
NEAREST = "nearest frame"  # no avatar at all: the training frame that is most like the held-out one
HELD_OUT = 8  # frames that are scored
CROP_HEIGHT = 160  # pixels of a picture of face or hand

BASE = {
    "ingest.long_side": "320",
    "train.iterations": "120",
    "train.subdivisions": "0",
    "train.lpips": "0.05",
    "train.face": "0.8",
    "auxiliary.generator": "off",
    "train.held_out_frames": "0",
}
"""The quick preset with every term of the paper's objective, small, without subdivision."""

LONG = {"auxiliary.generator": "off", "train.held_out_frames": "0"}
"""The quick preset as it is; the generated views and the curve left out."""

PARTS: Mapping[str, Mapping[str, str]] = {
    "pose heads": {"train.pose_heads_from": "1"},
    RESIDUALS: {"train.residual_from": "1"},
    "face loss": {"train.face": "0"},
    "LPIPS": {"train.lpips": "0"},
    "pose refinement": {"train.refine_poses": "false"},
    "SSIM": {"train.ssim": "0"},
    "noise on the pose": {"train.pose_noise": "0"},
    "initial colours": {"train.initial_color": "false"},
    "smooth offsets": {"train.laplacian_offset": "0", "train.laplacian_offset_face": "0"},
    "smooth scales": {"train.laplacian_scale": "0", "train.laplacian_scale_face": "0"},
    "smooth colours": {"train.laplacian_color": "0", "train.laplacian_color_hands": "0"},
    "small offsets": {"train.offset": "0", "train.offset_hands": "0", "train.offset_face": "0"},
    "small pose offsets": {"train.pose_offset": "0"},
    "scales that do not grow": {"train.scale_growth": "0"},
    "small residuals": {"train.residual_size": "0"},
}
"""What is left out, a variant each."""

ADDED: Mapping[str, Mapping[str, str]] = {
    "hands inwards": {"train.hand_normal": "1"},
    "small scales": {"train.scale_size": "1", "train.scale_size_hands": "1000"},
    "one colour a hand": {"train.hand_color": "0.01"},
    "arms' lower sides": {"train.arm_color": "0.1"},
}
"""The paper's regularisers that the quick preset leaves out: added, a variant each."""

VARIANTS: Mapping[str, Mapping[str, str]] = {
    WHOLE: {},
    NOISE: {"train.seed": "1"},
    NEAREST: {},
    **PARTS,
    **ADDED,
}
QUICK = (WHOLE, NOISE, "pose heads", "LPIPS")

Numbers = dict[str, float]
Table = dict[str, dict[str, Numbers]]
"""Variant -> subject -> metric, or ``seconds`` -> value."""


def numbers_of(subject: str, variant: str, words: Mapping[str, str], pictures: Path | None) -> Numbers:
    """Trains one variant on one subject and scores it."""
    job = open_job(subject, parse_request(words, subject))
    folders = {name: one.folder for name, one in make_results(job, job.stages["train"].needs).items()}
    clip = JudgedClip.read(folders["ingest"], folders["fit"], job.workspace.body_file, HELD_OUT)
    scorer = Scorer({"alex": Lpips(job.workspace.assets / "lpips", "alex")})
    if variant == NEAREST:
        return with_hands(clip.nearest_scores(scorer)) | {"seconds": 0.0}
    done = trained(job)
    scores = with_hands(clip.scores(done.avatar, scorer))
    if pictures is not None:
        write_crops(pictures, clip, done.avatar)
    return scores | {"seconds": done.seconds}


def with_hands(scores: Mapping[str, float]) -> Numbers:
    """The metrics that are compared, both hands as one."""
    hands = [scores[name] for name in ("psnr_left_hand", "psnr_right_hand") if name in scores]
    both = {**scores, "psnr_hands": statistics.fmean(hands) if hands else math.nan}
    return {name: both.get(name, math.nan) for name in METRICS}


def write_crops(path: Path, clip: JudgedClip, avatar) -> None:
    """Writes face and hands of the held-out frames, as filmed above the avatar's."""
    rows: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    for frame in clip.test[:: max(1, len(clip.test) // 3)]:
        filmed = clip.clip.frame(frame)
        shown = (255 * clip.render(avatar, frame).color.clamp(0, 1)).byte().numpy()
        for box in clip.crops(frame).values():
            for row, image in zip(rows, (filmed, shown), strict=True):
                width = max(1, round(CROP_HEIGHT * image[box].shape[1] / image[box].shape[0]))
                row.append(cv2.resize(image[box], (width, CROP_HEIGHT), interpolation=cv2.INTER_CUBIC))
    if rows[0]:
        write_png(path, np.vstack([np.hstack(row) for row in rows]))


def gains(variant: str, table: Table, metric: str, subjects: Iterable[str]) -> Numbers:
    """What a part gives to a metric on each subject; more is better for all, LPIPS's sign is turned.

    The whole model less the variant, or for what is added the variant less the whole.
    """
    sign = (-1 if variant in ADDED else 1) * (-1 if metric.startswith("lpips") else 1)
    whole, other = table[WHOLE], table[variant]
    return {one: sign * (whole[one][metric] - other[one][metric]) for one in subjects if one in other}


def costs(variant: str, table: Table, subjects: Iterable[str]) -> Numbers:
    """How much longer training takes with a part than without it, as a share."""
    if variant == NEAREST:
        return {}
    pair = (variant, WHOLE) if variant in ADDED else (WHOLE, variant)
    seconds = [{one: table[name][one]["seconds"] for one in table[name]} for name in pair]
    return {one: seconds[0][one] / seconds[1][one] - 1 for one in subjects if one in table[variant]}


def main(arguments: list[str] | None = None) -> None:
    """Train every variant on every subject, print a table and one headline line."""
    options = _options(arguments)
    if arguments is None:
        prepare("benchmarks.earn", 1)
    subjects = options.subjects or (MANNEQUINS[2:] if options.quick else (*MANNEQUINS, *REAL))
    variants = options.variants or (QUICK if options.quick else tuple(VARIANTS))
    words = LONG if options.long else {**BASE, **({"train.iterations": "40"} if options.quick else {})}
    small = f"{words.get('train.iterations')} iterations, no subdivision, {words.get('ingest.long_side')} px"
    sizes = "the quick preset's sizes" if options.long else small
    print(f"{described()}; {sizes}")
    table: Table = _read(options.json)
    for variant in dict.fromkeys((WHOLE, *variants)):
        for subject in subjects:
            done = table.setdefault(variant, {})
            if subject not in done:
                wanted = options.pictures and variant in (WHOLE, RESIDUALS)
                picture = options.pictures / f"{subject}_{variant}.png" if wanted else None
                done[subject] = numbers_of(subject, variant, {**words, **VARIANTS[variant]}, picture)
                _write(options.json, table)
        print(_line(variant, table[variant]), flush=True)
    shown = [
        name for name in VARIANTS if name in table and name != WHOLE and set(subjects) & set(table[name])
    ]
    print(_markdown(shown, table, subjects))
    print(_headline(shown, table, subjects))


def _options(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.earn", description="What each part earns.")
    parser.add_argument("--quick", action="store_true", help="one mannequin, two parts, 40 iterations")
    parser.add_argument("--long", action="store_true", help="the quick preset's sizes")
    parser.add_argument("--subjects", nargs="+", metavar="NAME", help="whose avatars")
    parser.add_argument("--variants", nargs="+", choices=list(VARIANTS), metavar="NAME", help="which parts")
    parser.add_argument("--pictures", type=Path, metavar="FOLDER", help="write crops of face and hands there")
    parser.add_argument("--json", type=Path, metavar="FILE", help="every number; read first if it is there")
    return parser.parse_args(arguments)


def _read(path: Path | None) -> Table:
    return json.loads(path.read_text()) if path is not None and path.is_file() else {}


def _write(path: Path | None, table: Table) -> None:
    if path is not None:
        path.write_text(json.dumps(table, indent=1) + "\n")


def _line(name: str, subjects: Mapping[str, Numbers]) -> str:
    """A variant's absolute numbers, so that a long run can be watched."""
    cells = [
        f"{subject} {one['psnr']:.2f} dB {100 * one['lpips_alex']:.2f} {one['seconds']:.0f} s"
        for subject, one in subjects.items()
    ]
    return f"{name}: {'; '.join(cells)}"


def _markdown(variants: Sequence[str], table: Table, subjects: Sequence[str]) -> str:
    """PSNR that a part gives on each subject, then each metric's mean over them, and what it costs."""
    head = [
        "part",
        *subjects,
        *(f"{name} x{scale}" if scale > 1 else name for name, scale in METRICS.items()),
    ]
    lines = ["| " + " | ".join([*head, "time"]) + " |", "|" + "---|" * (len(head) + 1)]
    for variant in variants:
        psnr = gains(variant, table, "psnr", subjects)
        cells = [f"{psnr[one]:+.2f}" if one in psnr else "" for one in subjects]
        for metric, scale in METRICS.items():
            cells.append(f"{scale * _mean(gains(variant, table, metric, subjects)):+.2f}")
        cells.append(f"{_mean(costs(variant, table, subjects)):+.0%}")
        lines.append("| " + " | ".join([variant, *cells]) + " |")
    return "\n".join(lines)


def _headline(variants: Sequence[str], table: Table, subjects: Sequence[str]) -> str:
    """What earns most, and what earns no more anywhere than another seed does."""
    psnr = {name: gains(name, table, "psnr", subjects) for name in variants}
    noise = max((abs(value) for value in psnr.pop(NOISE, {}).values()), default=math.nan)
    psnr.pop(NEAREST, None)
    best = max(psnr, key=lambda name: _mean(psnr[name]))
    idle = [name for name, each in psnr.items() if max(each.values()) <= noise]
    return (
        f"{best} earns most: {_mean(psnr[best]):+.2f} dB; nowhere more than another seed "
        f"({noise:.2f} dB): {', '.join(idle) or 'none'}"
    )


def _mean(values: Mapping[str, float]) -> float:
    known = [value for value in values.values() if not math.isnan(value)]
    return statistics.fmean(known) if known else math.nan


if __name__ == "__main__":
    main()
