"""Metrics against other implementations, by the benchmark that reports how far they are apart."""

from benchmarks.frame import least
from benchmarks.metrics import agreement, candidates


def test_metrics_equal_independent_implementations():
    apart = agreement(3)
    assert apart.pop("PSNR from scikit-image, dB") < 1e-5
    assert set(apart) == {"SSIM from scikit-image", "SSIM from torchmetrics"}
    assert max(apart.values()) < 1e-9


def test_every_candidate_is_timed():
    times = least(candidates(quick=True), 1)
    assert len(times) == 6 and all(0 < each < float("inf") for each in times.values())
