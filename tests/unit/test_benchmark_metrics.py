"""Metrics against other implementations, by the benchmark that reports how far they are apart."""

from benchmarks.metrics import agreement, candidates, measured


def test_metrics_equal_independent_implementations():
    apart = agreement(3)
    assert apart.pop("PSNR from scikit-image, dB") < 1e-5
    assert set(apart) == {"SSIM from scikit-image", "SSIM from torchmetrics"}
    assert max(apart.values()) < 1e-9


def test_every_candidate_is_timed():
    cheap = {name: run for name, run in candidates(quick=True).items() if "lpips" not in name}
    assert all(0 < each < float("inf") for each in measured(cheap, 1).values()) and len(cheap) == 6
