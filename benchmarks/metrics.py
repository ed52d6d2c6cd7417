"""What metrics cost, and how far they are from others' code.

``python -m benchmarks.metrics [--quick] [--json FILE]``
One picture of 512 x 288 against another, one thread, processor milliseconds, the least of a few rounds in
turn. Agreement is the largest difference over some pairs of pictures from scikit-image (PSNR, SSIM) and
torchmetrics (SSIM in float64); that of LPIPS with its authors' package is held by
``tests/unit/test_metrics.py``.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks import machine
from pipeline.config.workspace import open_workspace
from pipeline.metrics import Lpips, interior, psnr, ssim
from pipeline.metrics.flicker import flicker
from pipeline.metrics.intervals import interval

WIDTH, HEIGHT = 512, 288
FACE = (slice(60, 180), slice(190, 310))  # a crop of 120 pixels


def main(arguments: list[str] | None = None) -> int:
    """Measure, print; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.metrics", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one round, LPIPS with AlexNet alone")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every number there")
    options = parser.parse_args(arguments)
    machine.prepare("benchmarks.metrics", 1)
    costs = measured(candidates(options.quick), 1 if options.quick else 5)
    apart = agreement(2 if options.quick else 8)
    print(machine.described())
    print(f"{'metric':28} {'ms a picture':>12}")
    for name, milliseconds in costs.items():
        print(f"{name:28} {milliseconds:12.2f}")
    for name, difference in apart.items():
        print(f"{name:40} {difference:.1e}")
    if options.json is not None:
        options.json.write_text(json.dumps({"milliseconds": costs, "agreement": apart}, indent=1) + "\n")
    vgg = (
        f", LPIPS VGG {costs['lpips_vgg'] / costs['lpips_alex']:.0f} times Alex"
        if "lpips_vgg" in costs
        else ""
    )
    lpips = (
        f" and LPIPS Alex {costs['lpips_alex'] / costs['ssim']:.1f} times SSIM"
        if "lpips_alex" in costs
        else ""
    )
    print(f"metrics: SSIM costs {costs['ssim'] / costs['psnr']:.1f} times PSNR{lpips}{vgg}")
    return 0


def pair(seed: int, height: int = HEIGHT, width: int = WIDTH) -> tuple[Tensor, Tensor]:
    """Two pictures of a soft blob on black that differ by noise, [H, W, 3] in [0, 1]."""
    random = torch.Generator().manual_seed(seed)
    y, x = torch.meshgrid(torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij")
    person = torch.sigmoid(20 * (0.6 - torch.hypot(x * 1.5, y)))[..., None]
    coarse = torch.rand(1, 3, height // 8, width // 8, generator=random)
    texture = torch.nn.functional.interpolate(coarse, (height, width), mode="bilinear")[0].permute(1, 2, 0)
    noise = 0.1 * torch.randn(height, width, 3, generator=random)
    return texture * person, ((texture + noise) * person).clamp(0, 1)


def candidates(quick: bool) -> dict[str, Callable[[], object]]:
    """Name -> what is timed."""
    image, truth = pair(0)
    mask = (truth.sum(-1) > 0.05).numpy().astype(np.uint8) * 255
    inside = interior(mask)
    scores = np.random.default_rng(0).normal(30, 1, 30)
    found: dict[str, Callable[[], object]] = {
        "psnr": lambda: psnr(image, truth),
        "psnr_interior": lambda: psnr(image, truth, interior(mask)),
        "ssim": lambda: ssim(image, truth),
        "psnr and ssim of a face": lambda: (psnr(image[FACE], truth[FACE]), ssim(image[FACE], truth[FACE])),
        "flicker": lambda: flicker(image, truth, truth, image, inside),
        "interval of 30 frames": lambda: interval(scores),
    }
    folder = open_workspace().assets / "lpips"
    for name in ("alex",) if quick else ("alex", "vgg"):
        if folder.is_dir():
            network = Lpips(folder, name)
            found[f"lpips_{name}"] = lambda network=network: _lpips(network, image, truth)
            found[f"lpips_{name} of a face"] = lambda network=network: _lpips(
                network, image[FACE], truth[FACE]
            )
    return found


@torch.no_grad()
def _lpips(network: Lpips, image: Tensor, truth: Tensor) -> object:
    """As scored: the truth's features are computed once a frame, those of the picture each time."""
    return network.distance(network.features(image), network.features(truth))


def measured(found: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """The least processor milliseconds of each, all in turn."""
    least = dict.fromkeys(found, float("inf"))
    for name in [*found, *(name for _ in range(rounds) for name in found)]:
        start = time.process_time()
        found[name]()
        least[name] = min(least[name], 1000 * (time.process_time() - start))
    return least


def agreement(pairs: int) -> dict[str, float]:
    """The largest difference from other implementations; empty where scikit-image is not installed."""
    try:
        from skimage.metrics import peak_signal_noise_ratio, structural_similarity
    except ImportError:
        return {}
    from torchmetrics.functional.image import structural_similarity_index_measure

    gaussian = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    apart = {"PSNR from scikit-image, dB": 0.0, "SSIM from scikit-image": 0.0, "SSIM from torchmetrics": 0.0}
    for seed in range(pairs):
        # On a black margin as wide as the window, for the two mirror the border differently.
        image, truth = (torch.nn.functional.pad(one, (0, 0, 11, 11, 11, 11)) for one in pair(seed, 72, 96))
        x, y = image.double().numpy(), truth.double().numpy()
        batches = [one.double().permute(2, 0, 1)[None] for one in (image, truth)]
        everywhere = structural_similarity(x, y, data_range=1, channel_axis=-1, full=True, **gaussian)[1]
        theirs = (
            psnr(image, truth) - peak_signal_noise_ratio(y, x, data_range=1),
            ssim(image, truth) - everywhere.mean(),
            ssim(image, truth) - float(structural_similarity_index_measure(*batches, data_range=1.0)),
        )
        for name, difference in zip(apart, theirs, strict=True):
            apart[name] = max(apart[name], abs(float(difference)))
    return apart


if __name__ == "__main__":
    sys.exit(main())
