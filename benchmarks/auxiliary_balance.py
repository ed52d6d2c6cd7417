"""The worth of auxiliary views on the back of a real person.

Holds: docs/results.md, "Auxiliary views", and issue 18's goal for balance's back cameras. ``balance`` was
filmed by four calibrated cameras. The body is fitted and the avatar trained on camera 1 (front) alone, with
and without auxiliary views, and rendered into cameras 3 and 4 (back), whose own masks cut the person out.
Front and back are scored in the box around the person, on black. What a fit from one camera gets wrong in
depth shifts the back views by tens of pixels, so the pictures are also compared after the best shift.
``--quick``: every tenth frame, 100 iterations.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from benchmarks import frame
from benchmarks.auxiliary import box_of, trained_avatar
from benchmarks.held_out_views import job_of
from pipeline.avatar import Avatar
from pipeline.body import read_poses
from pipeline.clip.composite import composite_frame
from pipeline.clip.frames import read_frame, read_mask, spread_from_start, write_png
from pipeline.clip.records import read_cameras
from pipeline.metrics import psnr
from pipeline.splat import render
from pipeline.store.artifact import Artifact

CAMERAS = (1, 3, 4)
FRAMES = 4  # that are scored in each camera
REACH = 40  # pixels, of the best shift
CONTESTANTS = {"none": "off", "texture": "texture"}


@dataclasses.dataclass(frozen=True)
class Row:
    """One contestant in one camera; means over frames, dB."""

    contestant: str
    camera: int
    psnr: float
    shifted: float


def measure(options: argparse.Namespace, report: frame.Report) -> str:
    """Runs the stages and compares."""
    defaults = {"auxiliary__texture_guidance": "false", "train__held_out_frames": "0"}
    if options.quick:
        defaults |= {"ingest__stride": "10", "fit__iterations": "100", "train__iterations": "100"}
    lines, top = [], []
    with frame.settings_of(options, **defaults) as words:
        seen = {number: frame.made(job_of(words, number), "ingest")["ingest"] for number in CAMERAS}
        for name, generator in CONTESTANTS.items():
            job = job_of({**words, "auxiliary.generator": generator}, 1)
            avatar, fit = trained_avatar(job), frame.made(job, "fit")["fit"]
            line: list[np.ndarray] = []
            top = []
            for number in CAMERAS:
                report.add(Row(name, number, *_scored(avatar, seen[number], fit, line, top)))
            lines.append(np.concatenate(line, axis=1))
    if options.sheet is not None:
        write_png(options.sheet, np.concatenate([np.concatenate(top, axis=1), *lines]))
    return headline(report.tables["rows"])


def add_options(parser: argparse.ArgumentParser) -> None:
    """The options of this benchmark."""
    parser.add_argument("--sheet", type=Path, metavar="FILE", help="write pictures there; never commit them")
    frame.stage_options(parser)


@torch.no_grad()
def _scored(
    avatar: Avatar, seen: Artifact, fit: Artifact, line: list[np.ndarray], top: list[np.ndarray]
) -> tuple[float, float]:
    """Mean PSNR in one camera as it is and after the best shift."""
    poses, cameras = read_poses(fit.folder / "poses.parquet"), read_cameras(seen.folder / "cameras.parquet")
    common = sorted(set(poses.frames) & set(cameras))
    plain, shifted = [], []
    for place, number in enumerate(spread_from_start(common, FRAMES)):
        image, mask = read_frame(seen.folder / "frames", number), read_mask(seen.folder / "masks", number)
        target = composite_frame(image, mask)
        gaussians = avatar.gaussians(poses.pose(number))
        made = render(gaussians, cameras[number]).color.clamp(0, 1)
        part = box_of(mask).slices
        plain.append(psnr(made[part], target[part]))
        shifted.append(psnr(_moved(made, target)[part], target[part]))
        if place in (0, 2):
            line.append(_small(made))
            top.append(_small(target))
    return float(np.mean(plain)), float(np.mean(shifted))


def _moved(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """The image after the whole-pixel shift within ``REACH`` that correlates best with the target."""
    wide = np.pad(target.numpy(), ((REACH, REACH), (REACH, REACH), (0, 0)))
    found = cv2.matchTemplate(wide, image.numpy(), cv2.TM_CCORR)
    y, x = np.unravel_index(int(found.argmax()), found.shape)
    return torch.from_numpy(np.roll(image.numpy(), (y - REACH, x - REACH), (0, 1)).copy())


def _small(image: torch.Tensor) -> np.ndarray:
    picture = (image * 255).round().byte().numpy()
    return cv2.resize(picture, (picture.shape[1] // 2, picture.shape[0] // 2), interpolation=cv2.INTER_AREA)


def headline(rows: list[dict[str, Any]]) -> str:
    """The gain in the back cameras and its cost in front."""
    found = {(row["contestant"], row["camera"]): row for row in rows}

    def gain(number: int, column: str) -> float:
        return found["texture", number][column] - found["none", number][column]

    gains = [f"camera {n} {gain(n, 'psnr'):+.2f} dB (shifted {gain(n, 'shifted'):+.2f})" for n in CAMERAS]
    return "texture over none: " + ", ".join(gains)


def main(arguments: list[str] | None = None) -> int:
    """Runs the benchmark."""
    return frame.run("auxiliary_balance", __doc__, measure, arguments, threads=1, options=add_options)


if __name__ == "__main__":
    sys.exit(main())
