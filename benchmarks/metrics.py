"""The time of each metric, and its difference from others' code.

Holds: docs/results.md, "Metrics and protocols". One picture of 512 x 288 against another, one thread,
processor milliseconds, the least of a few rounds in turn. Agreement is the largest difference over some pairs
of pictures from scikit-image (PSNR, SSIM) and torchmetrics (SSIM in float64); that of LPIPS with its authors'
package is held by ``tests/unit/test_metrics.py``.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from benchmarks import frame
from pipeline.config.workspace import open_workspace
from pipeline.metrics import Lpips, interior, psnr, ssim
from pipeline.metrics.flicker import flicker
from pipeline.metrics.intervals import interval

WIDTH, HEIGHT = 512, 288
LPIPS = {"lpips_alex": "alex", "lpips_vgg": "vgg"}
FACE = (slice(60, 180), slice(190, 310))  # a crop of 120 pixels


def measure(options: argparse.Namespace, report: frame.Report) -> str:
    """Times all and compares."""
    costs = frame.least(candidates(options.quick), 1 if options.quick else 5)
    for name, cost in costs.items():
        report.add({"metric": name, "ms a picture": cost}, "milliseconds")
    for name, difference in agreement(2 if options.quick else 8).items():
        report.add({"metric": name, "largest difference": difference}, "agreement")
    lpips = (f"{name} {costs[name] / costs['ssim']:.1f} times SSIM" for name in costs if name in LPIPS)
    return ", ".join([f"SSIM costs {costs['ssim'] / costs['psnr']:.1f} times PSNR", *lpips])


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
    """Name -> what is timed; LPIPS, which asks for weights, is left out where it is to be quick."""
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
    for name in () if quick else LPIPS:
        network = Lpips(frame.asset_folder(open_workspace(), "lpips"), LPIPS[name])
        for part, pair_of in {"": (image, truth), " of a face": (image[FACE], truth[FACE])}.items():
            found[name + part] = lambda network=network, both=pair_of: lpips_of(network, *both)
    return found


@torch.no_grad()
def lpips_of(network: Lpips, image: Tensor, truth: Tensor) -> object:
    """As scored: the truth's features are computed once a frame, those of the picture each time."""
    return network.distance(network.features(image), network.features(truth))


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


def main(arguments: list[str] | None = None) -> int:
    """Runs the benchmark."""
    return frame.run("metrics", __doc__, measure, arguments, threads=1)


if __name__ == "__main__":
    sys.exit(main())
