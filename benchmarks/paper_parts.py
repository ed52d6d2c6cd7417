"""The worth of each part of the paper preset: its configuration, small, with and without the part.

Holds: docs/paper.md, "Worth of the parts". The base is ``preset=paper`` at 320 px, cut down to what a CPU
does in a minute, see ``SMALL``. Each row differs from it in the settings that ``VARIANTS`` names, and shares
footage and fit with it where it does not touch them. Scores are means over the held-out frames in their
fitted poses, on black: of the whole picture by the avatar's own alpha, PSNR also cut by the true mask as the
paper does, and of the face's crop. A row whose results lie in ``--artifacts`` is not trained again, and one
that was killed goes on from its checkpoint. ``--quick``: 10 iterations of two rows of one subject.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import math
import sys
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import torch
from torch import Tensor

from benchmarks import frame
from pipeline.avatar import load_avatar
from pipeline.clip.composite import BLACK, composite_frame, over
from pipeline.clip.fitted_clip import FittedClip, read_fitted_clip
from pipeline.clip.frames import write_png
from pipeline.config.evaluation_protocol import TRUTH
from pipeline.config.request import parse_request
from pipeline.errors import UserError
from pipeline.metrics import Lpips
from pipeline.metrics.regions import interior, region_boxes
from pipeline.orbit_cameras import orbit, visible_extent
from pipeline.run.job import Job, open_job
from pipeline.splat import Gaussians, render
from pipeline.store.artifact import Artifact
from stages.evaluate.frame_metrics import Scorer

SUBJECTS = ("mannequin_full", "oliver")
SMALL: Mapping[str, str] = {
    "preset": "paper",
    "ingest.long_side": "320",
    "ingest.mannequin_size": "320",
    "ingest.mannequin_views": "",
    "ingest.max_frames": "60",
    "ingest.test_frames": "8",
    "fit.iterations": "200",
    "auxiliary.generator": "off",
    "train.iterations": "200",
    "train.subdivisions": "0",
    "train.plane_channels": "16",
    "train.width": "64",
    "train.lpips_network": "alex",
    "train.lpips_every": "2",
    "train.lpips_crop": "96",
    "train.threads": "1",
    "train.gate_every": "3",  # of 200 what 500 is of 30,000
    "train.held_out_frames": "0",
    "train.checkpoint_every": "50",
}
"""What is smaller than the preset; no generated views, no subdivision."""

STRIDES = {"oliver": "3"}  # 60 of its 210 frames
BASE, CHANCE = "nothing", "nothing, another seed"
BALANCE = {"train.l1_renderings": "1", "train.renderings": "1"}
LOGARITHMS = {"train.scale_smoothness": "relative", "train.laplacian_scale": "4"}
NO_SCALE_CHANGE = {f"train.pose_scale{part}": "0" for part in ("", "_hands", "_face")}
LEARNT = {"train.learn_identity": "false"}
OPACITY = {"train.learn_opacity": "false"}
CORRECTIVES = {"train.correctives": "all"}
PLACES = {"train.plane_pose": "own"}
ZERO = {"train.plane_deviation": "0.01"}
RAMP = {"train.residual_ramp": "0"}
EXCHANGED = {
    "train.offset_face": "1", "train.offset_scalp": "10", "train.laplacian_offset_face": "1e5",
    "train.scale_size_face": "1",
}  # fmt: skip
VARIANTS: Mapping[str, tuple[str, Mapping[str, str]]] = {
    BASE: ("", {}),
    CHANCE: ("", {"train.seed": "1"}),
    "face loss": ("1", {"train.face": "0"}),
    "face loss and L_sface": ("1", {"fit.face": "off", "plan.face_loss": "off"}),
    "face's own weights": ("2", EXCHANGED),
    "all of 3": ("3", {**BALANCE, **LOGARITHMS, **NO_SCALE_CHANGE}),
    "all of 6": ("6", {**LEARNT, **OPACITY, **CORRECTIVES, **PLACES, **ZERO, **RAMP}),
    "scene": ("7", {"train.scene_share": "0"}),
    "pictures' balance": ("3", BALANCE),
    "scales in metres": ("3", LOGARITHMS),
    "size of pose's scales": ("3", NO_SCALE_CHANGE),
    "beta and Delta J": ("6", LEARNT),
    "opacity": ("6", OPACITY),
    "correctives of face and hands alone": ("6", CORRECTIVES),
    "open coordinates": ("6", PLACES),
    "planes of zero": ("6", ZERO),
    "residuals' ramp": ("6", RAMP),
    "psi's limit": ("4", {"fit.expressions": "1000"}),
}
"""What a row is without -> the item of issue 20 that it is, and the settings."""

HEIGHT = 240  # pixels of a strip of pictures


def measure(options: argparse.Namespace, report: frame.Report) -> str:
    """Makes every row and scores it."""
    subjects = options.subjects.split(",") if options.subjects else SUBJECTS[: 1 if options.quick else None]
    names = (
        options.variants.split(",") if options.variants else list(VARIANTS)[: 2 if options.quick else None]
    )
    unknown = [name for name in names if name not in VARIANTS]
    if unknown:
        raise UserError(f"--variants: there is no '{unknown[0]}'; there are {', '.join(VARIANTS)}")
    quick = {"train.iterations": "10", "fit.iterations": "10", "ingest.mannequin_frames": "20"}
    small = {**SMALL, **(quick if options.quick else {})}
    with frame.settings_of(options) as words, contextlib.ExitStack() as stack:
        log = stack.enter_context(options.log.open("a", encoding="utf-8")) if options.log else io.StringIO()
        for name in names:
            for subject in subjects:
                item, overrides = VARIANTS[name]
                own = {**small, "ingest.stride": STRIDES.get(subject, "1")}
                job = job_of(subject, {**own, **words, **overrides})
                with contextlib.redirect_stdout(log):
                    made = frame.made(job, "train")
                scores, strip = scored(job, made)
                report.add({"subject": subject, "item": item, "without": name, **scores})
                if options.pictures:
                    options.pictures.mkdir(parents=True, exist_ok=True)
                    write_png(options.pictures / f"{subject}_{name.replace(' ', '_')}.png", strip)
    return headline(report.tables["rows"])


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of this benchmark."""
    parser.add_argument("--subjects", metavar="NAMES", help=f"joined by commas; {','.join(SUBJECTS)} if none")
    parser.add_argument("--variants", metavar="NAMES", help="rows, joined by commas; all if none")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="write a strip of each row there")
    parser.add_argument("--log", type=Path, metavar="FILE", help="the stages' own lines go there")
    frame.stage_options(parser)


def job_of(subject: str, words: Mapping[str, str]) -> Job:
    """The job of a row; ``source`` among the words is that of the subject that is no mannequin."""
    made_up = subject.startswith("mannequin")
    kept = {name: text for name, text in words.items() if not (made_up and name == "source")}
    return open_job(subject, parse_request(kept, subject))


@torch.no_grad()
def scored(job: Job, made: Mapping[str, Artifact]) -> tuple[dict[str, Any], np.ndarray]:
    """The scores of an avatar and processor seconds of its training; a strip of pictures.

    The strip is a held-out frame, the avatar in it, and the avatar before a camera in front and at its left:
    [H, W, 3] uint8.
    """
    clip = read_fitted_clip(made["ingest"].folder, made["fit"].folder, job.workspace.body_file)
    avatar = load_avatar(made["train"].folder / "avatar.safetensors", clip.body)
    networks = {"alex": Lpips(frame.asset_folder(job.workspace, "lpips"), "alex")}
    posed = {n: avatar.gaussians(clip.pose(n), clip.seconds.get(n)) for n in clip.split.test}
    rows = [frame_scores(networks, clip, number, gaussians) for number, gaussians in posed.items()]
    record = json.loads((made["train"].folder / "run.json").read_text(encoding="utf-8"))
    cpu = record["timings"]["curve_seconds"][-1][2]
    means = pd.DataFrame(rows).mean().to_dict()
    scores = {name: means.get(name, math.nan) for name in ("psnr", "cut", "ssim", "lpips", *FACE)}
    middle = clip.split.test[len(clip.split.test) // 2]
    truth = composite_frame(clip.colors(middle), clip.mask(middle))
    views = [clip.cameras[middle], *orbit(visible_extent(posed[middle]), HEIGHT, HEIGHT, 4)[:2]]
    shown = [truth, *(render(posed[middle], camera).color for camera in views)]
    strip = np.concatenate([as_high(picture) for picture in shown], axis=1)
    return {**scores, "Gaussians": len(posed[middle].means), "processor s": cpu}, strip


FACE = ("face psnr", "face ssim", "face lpips")


def frame_scores(
    networks: Mapping[str, Lpips], clip: FittedClip, number: int, gaussians: Gaussians
) -> dict[str, float]:
    """PSNR, SSIM and LPIPS x100 of one held-out frame, PSNR cut by the true mask, and those of the face."""
    rendering, mask = render(gaussians, clip.cameras[number]), clip.mask(number)
    picture = partial(over, rendering.color.float(), rendering.alpha.float())
    scorer, cutting = Scorer(networks), Scorer({}, BLACK, TRUTH)
    shown, truth = scorer.picture(picture(BLACK)), scorer.picture(composite_frame(clip.colors(number), mask))
    values = scorer.values(shown, truth, interior(mask))
    cut = cutting.values(cutting.cut(picture, mask), truth, interior(mask))
    scores = {"psnr": values["psnr"], "cut": cut["psnr"], "ssim": values["ssim"]}
    scores["lpips"] = 100 * values["lpips_alex"]
    camera, points = clip.cameras[number], clip.keypoints.whole_body[clip.keypoints.frames == number]
    boxes = region_boxes(points[0], camera.width, camera.height).get("face", []) if len(points) else []
    if not boxes:
        return scores
    face = scorer.crop_values("face", scorer.crops(shown, boxes), scorer.crops(truth, boxes))
    found = (face["psnr_face"], face["ssim_face"], 100 * face["lpips_alex_face"])
    return scores | dict(zip(FACE, found, strict=True))


def as_high(picture: Tensor) -> np.ndarray:
    """A picture [H, W, 3] in [0, 1] as high as the strip, uint8."""
    found = (picture.clamp(0, 1) * 255).round().byte().numpy()
    width = round(found.shape[1] * HEIGHT / found.shape[0])
    return cv2.resize(found, (width, HEIGHT), interpolation=cv2.INTER_AREA)


def headline(rows: list[dict[str, Any]]) -> str:
    """The row that costs most against the base in the mean, and the difference of another seed, dB."""
    base = {row["subject"]: row["psnr"] for row in rows if row["without"] == BASE}
    worth: dict[str, list[float]] = {}
    for row in rows:
        if row["subject"] in base and row["without"] != BASE:
            worth.setdefault(row["without"], []).append(base[row["subject"]] - row["psnr"])
    means = {name: sum(values) / len(values) for name, values in worth.items()}
    others = {name: value for name, value in means.items() if name != CHANCE}
    chance = f"another seed differs by {abs(means[CHANCE]):.2f} dB" if CHANCE in means else "chance unknown"
    if not others:
        return f"{len(rows)} rows; {chance}"
    most = max(others, key=lambda name: others[name])
    return f"of {len(others)} parts '{most}' is worth most, {others[most]:+.2f} dB; {chance}"


if __name__ == "__main__":
    sys.exit(frame.run("paper_parts", __doc__, measure, threads=1, options=add_options))
