"""What bad masks cost, and what helps: ``python -m benchmarks.masks [--quick] [--json FILE]``.

Mannequins have true masks. Training is given worn ones instead: they bleed outwards, wobble in time and hold
a piece of furniture, as estimated masks do. Body and poses are the true ones, so that nothing else is wrong.
Every way of dealing with bad masks trains on the same and is judged by held-out frames under the true ones:

- PSNR of the person on black over the whole picture, and inside the true mask eroded by 3 pixels;
- the outline: mean difference of the avatar's alpha from the true one within 6 pixels of the silhouette;
- learnt background: the avatar's alpha farther out than that, as a share of the person's area;
- shimmer: how differently from the truth the outline changes from one held-out frame to the next.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import tempfile
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from benchmarks.machine import described, prepare
from benchmarks.training import Clip, trained
from pipeline.avatar import Avatar
from pipeline.composite import composite_frame
from pipeline.frames import read_frame, read_mask, write_png
from pipeline.job import job_from_words
from pipeline.metrics.protocol import interior
from pipeline.metrics.psnr import psnr
from pipeline.study import made

SUBJECTS = ("mannequin_upper", "mannequin_head")
BLEED, WOBBLE, SOFT = 2.5, 2.0, 1.5  # pixels: outwards, standard deviation of the edge, width of the edge
BAND = 6  # pixels on either side of the silhouette that the outline is judged in
BASE = {
    "train.iterations": "200",
    "train.held_out_frames": "0",
    "train.subdivisions": "0",
    "auxiliary.generator": "off",
}
TRUE, SOFT_MASK = "true masks", "soft alpha"
WAYS: Mapping[str, Mapping[str, str]] = {
    TRUE: {},
    "cut at one half": {},
    SOFT_MASK: {},
    "band of 2": {"train.mask_band": "2"},
    "band of 4": {"train.mask_band": "4"},
}
QUICK = (TRUE, SOFT_MASK)


@dataclasses.dataclass(frozen=True)
class Judgement:
    """How an avatar compares with the truth; see the head of this file.

    Attributes:
        subject, way: what was trained, and how.
        psnr, inside: dB.
        outline, background, shimmer: shares.
        seconds: processor time of training.
    """

    subject: str
    way: str
    psnr: float
    inside: float
    outline: float
    background: float
    shimmer: float
    seconds: float


def worn(mask: np.ndarray, edge: np.ndarray, furniture: np.ndarray) -> np.ndarray:
    """A mask as an estimator might return it.

    Args:
        mask: [H, W] uint8, the true one.
        edge: [H, W], by how many pixels its edge moves outwards.
        furniture: [H, W] bool, held besides the person.

    Returns:
        [H, W] uint8.
    """
    inside = (mask > 127).astype(np.uint8)
    distance = cv2.distanceTransform(inside, cv2.DIST_L2, 5) - cv2.distanceTransform(
        1 - inside, cv2.DIST_L2, 5
    )
    alpha = np.clip((distance + edge) / (2 * SOFT) + 0.5, 0, 1)
    return (255 * np.where(furniture, 1.0, alpha)).round().astype(np.uint8)


def wear_masks(source: Path, target: Path, cut: bool, seed: int = 0) -> None:
    """Writes worn masks of a folder's true ones; a part of the wobble stays, a part changes each frame."""
    files = sorted(source.glob("*.png"))
    masks = [read_mask(source, int(file.stem)) for file in files]
    height, width = masks[0].shape
    generator = np.random.default_rng(seed)

    def wobble() -> np.ndarray:
        noise = cv2.GaussianBlur(generator.standard_normal((height, width)).astype(np.float32), (0, 0), 8)
        return WOBBLE * noise / noise.std()

    lasting, furniture = wobble(), np.zeros((height, width), bool)
    furniture[int(0.82 * height) :, int(0.1 * width) : int(0.35 * width)] = True
    target.mkdir(parents=True)
    for file, mask in zip(files, masks, strict=True):
        one = worn(mask, BLEED + 0.7 * lasting + 0.7 * wobble(), furniture)
        write_png(target / file.name, np.where(one > 127, 255, 0).astype(np.uint8) if cut else one)


def judge(avatar: Avatar, ingest: Path, fit: Path) -> dict[str, float]:
    """Compares an avatar with a mannequin's held-out frames and true masks."""
    clip = Clip.read(ingest, fit, most=10**6)  # every frame: shimmer is a difference of neighbours
    found: dict[str, list[float]] = {}
    last: Tensor | None = None
    for frame in clip.test:
        mask, shown = read_mask(ingest / "masks", frame), clip.render(avatar, frame)
        truth, image = composite_frame(read_frame(ingest / "frames", frame), mask), shown.color.clamp(0, 1)
        true_alpha, inside = torch.from_numpy(mask).float() / 255, interior(mask)
        element = np.ones((2 * BAND + 1, 2 * BAND + 1), np.uint8)
        near = torch.from_numpy(cv2.dilate(mask, element) - cv2.erode(mask, element) > 127)
        outside = ~near & (true_alpha < 0.5)
        wrong = shown.alpha.clamp(0, 1) - true_alpha
        values = {
            "psnr": psnr(image, truth),
            "inside": psnr(image, truth, inside),
            "outline": float(wrong[near].abs().mean()),
            "background": float(wrong[outside].sum() / true_alpha.sum()),
        }
        if last is not None:
            values["shimmer"] = float((wrong - last)[near].abs().mean())
        last = wrong
        for name, value in values.items():
            found.setdefault(name, []).append(value)
    return {name: float(np.mean(values)) for name, values in found.items()}


def try_way(subject: str, way: str, words: Mapping[str, str], folder: Path) -> Judgement:
    """Trains one way on one mannequin's worn masks, and judges it."""
    job = job_from_words(subject, {**words, **WAYS[way]})
    truth, given, fit = made(job, ["ingest"])["ingest"].folder, folder / "ingest", folder / "fit"
    for place in (given, fit):
        place.mkdir(parents=True)
    for entry in truth.iterdir():
        if entry.name != "masks" or way == TRUE:
            (given / entry.name).symlink_to(entry)
    (fit / "identity.safetensors").symlink_to(truth / "truth_identity.safetensors")
    (fit / "poses.parquet").symlink_to(truth / "truth_poses.parquet")
    if way != TRUE:
        wear_masks(truth / "masks", given / "masks", way == "cut at one half")
    done = trained(job, ingest=given, fit=fit)
    return Judgement(subject, way, **judge(done.avatar, truth, fit), seconds=done.seconds)


def main(arguments: list[str] | None = None) -> None:
    """Train every way, print a table and one headline line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.masks", description="What bad masks cost.")
    parser.add_argument("--quick", action="store_true", help="one mannequin, two ways, 60 iterations")
    parser.add_argument("--subjects", nargs="+", metavar="NAME", help="which mannequins")
    parser.add_argument("--ways", nargs="+", metavar="NAME", choices=list(WAYS), help="which ways")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every number there")
    options = parser.parse_args(arguments)
    if arguments is None:
        prepare("benchmarks.masks", 1)
    words = {**BASE, **({"train.iterations": "60"} if options.quick else {})}
    print(f"{described()}; {words['train.iterations']} iterations")
    print(
        "| subject | masks | PSNR | inside | outline % | background % | shimmer % | cpu s |\n"
        + "|---" * 8
        + "|"
    )
    judgements = []
    for subject in options.subjects or (SUBJECTS[:1] if options.quick else SUBJECTS):
        for way in options.ways or (QUICK if options.quick else tuple(WAYS)):
            with tempfile.TemporaryDirectory() as folder:
                one = try_way(subject, way, words, Path(folder))
            judgements.append(one)
            print(_row(one), flush=True)
    if options.json is not None:
        options.json.write_text(json.dumps([dataclasses.asdict(one) for one in judgements], indent=1) + "\n")
    print(_headline(judgements))


def _row(one: Judgement) -> str:
    shares = " | ".join(f"{100 * value:.2f}" for value in (one.outline, one.background, one.shimmer))
    return f"| {one.subject} | {one.way} | {one.psnr:.2f} | {one.inside:.2f} | {shares} | {one.seconds:.0f} |"


def _headline(judgements: list[Judgement]) -> str:
    """The way that follows the true outline best, against soft masks as they are."""
    means: dict[str, list[Judgement]] = {}
    for one in judgements:
        if one.way != TRUE:
            means.setdefault(one.way, []).append(one)
    outline = {way: float(np.mean([one.outline for one in some])) for way, some in means.items()}
    best = min(outline, key=lambda way: outline[way])
    ratio = outline[SOFT_MASK] / outline[best]
    return f"best outline from worn masks: {best}, {ratio:.2f} times better than soft alpha"


if __name__ == "__main__":
    main()
