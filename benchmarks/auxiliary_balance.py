"""The back of a real person: ``python -m benchmarks.auxiliary_balance [--quick] [--json FILE]``.

``balance`` was filmed by four calibrated cameras. The body is fitted and the avatar trained on camera 1
(front) alone, with and without auxiliary views, and rendered into cameras 3 and 4 (back), whose own masks
cut the person out. Front and back are scored in the box around the person, on black. What a fit from one
camera gets wrong in depth shifts the back views by tens of pixels, so the pictures are also compared after
the best shift.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
import torch

from benchmarks import machine
from benchmarks.auxiliary import _made, box_of
from benchmarks.held_out_views import _job
from pipeline.avatar import Avatar, load_avatar
from pipeline.body import load_body, read_poses
from pipeline.clip.composite import composite_frame
from pipeline.clip.frames import read_frame, read_mask, spread_from_start, write_png
from pipeline.clip.records import read_cameras
from pipeline.errors import UserError
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


def main(arguments: list[str] | None = None) -> int:
    """Run the stages, compare, print; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.auxiliary_balance", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="every tenth frame, 100 iterations")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every row there")
    parser.add_argument("--sheet", type=Path, metavar="FILE", help="write pictures there; never commit them")
    parser.add_argument("--artifacts", type=Path, metavar="DIR", help="keep the stages' results there")
    parser.add_argument("words", nargs="*", metavar="NAME=VALUE", help="settings")
    options = parser.parse_intermixed_args(arguments)
    machine.prepare("benchmarks.auxiliary_balance", 1)
    with contextlib.ExitStack() as stack:
        folder = options.artifacts or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        words = {
            "artifacts": str(folder),
            "auxiliary.texture_guidance": "false",
            "train.held_out_frames": "0",
        }
        if options.quick:
            words |= {"ingest.stride": "10", "fit.iterations": "100", "train.iterations": "100"}
        words |= dict(word.split("=", 1) for word in options.words)
        try:
            rows, sheet = _compared(words)
        except UserError as error:
            print(f"auxiliary_balance: {error}", file=sys.stderr)
            return 1
    print(machine.described())
    print(f"{'contestant':10} {'camera':>6} {'PSNR':>6} {'shifted':>8}")
    for row in rows:
        print(f"{row.contestant:10} {row.camera:6} {row.psnr:6.2f} {row.shifted:8.2f}")
    if options.json is not None:
        options.json.write_text(json.dumps([dataclasses.asdict(row) for row in rows], indent=1) + "\n")
    if options.sheet is not None:
        write_png(options.sheet, sheet)
    print(_headline(rows))
    return 0


def _compared(words: dict[str, str]) -> tuple[list[Row], np.ndarray]:
    """All rows, and a picture: truth, then a line a contestant."""
    seen = {number: _made(_job(words, number), "ingest") for number in CAMERAS}
    rows, lines, top = [], [], []
    for name, generator in CONTESTANTS.items():
        job = _job({**words, "auxiliary.generator": generator}, 1)
        made = {
            stage: _made(job, stage) for stage in ("fit", "plan", "auxiliary", "train") if stage in job.stages
        }
        avatar = load_avatar(made["train"].folder / "avatar.safetensors", load_body(job.workspace.body_file))
        line: list[np.ndarray] = []
        top = []
        for number in CAMERAS:
            scores = _scored(avatar.eval(), seen[number], made["fit"], line, top)
            rows.append(Row(name, number, *scores))
        lines.append(np.concatenate(line, axis=1))
    return rows, np.concatenate([np.concatenate(top, axis=1), *lines])


@torch.no_grad()
def _scored(
    avatar: Avatar, seen: Artifact, fit: Artifact, line: list[np.ndarray], top: list[np.ndarray]
) -> tuple[float, float]:
    """Mean PSNR in one camera as it is and after the best shift."""
    poses, cameras = read_poses(fit.folder / "poses.parquet"), read_cameras(seen.folder / "cameras.parquet")
    common = sorted(set(poses.frames) & set(cameras))
    plain, shifted = [], []
    for place, frame in enumerate(spread_from_start(common, FRAMES)):
        image, mask = read_frame(seen.folder / "frames", frame), read_mask(seen.folder / "masks", frame)
        target = composite_frame(image, mask)
        gaussians = avatar.gaussians(poses.pose(frame))
        made = render(gaussians, cameras[frame]).color.clamp(0, 1)
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


def _headline(rows: list[Row]) -> str:
    """The gain in the back cameras and what it cost in front."""
    found = {(row.contestant, row.camera): row for row in rows}
    gains = [
        f"camera {number} {found['texture', number].psnr - found['none', number].psnr:+.2f} dB"
        f" (shifted {found['texture', number].shifted - found['none', number].shifted:+.2f})"
        for number in CAMERAS
    ]
    return "auxiliary views on balance, texture over none: " + ", ".join(gains)


if __name__ == "__main__":
    sys.exit(main())
