"""Otsu's threshold on visibility scores, and the test that it passes before anything is gated (Section 3.4).

A score v_i is the share of the frames that show vertex i (``visibility.py``). The paper's threshold is Otsu's
tau*, which is right where the scores are bimodal: never seen, nearly always seen. On other clips Otsu finds a
threshold all the same, and cuts what the clip does show. ``evidence_threshold`` tells the two apart by what
of the clip would be lost.

**The test.** A vertex of score v that is gated is missing from a share v of the frames. Averaged over
frames, the part of the visible body that goes missing is therefore ``lost = sum of the scores under tau /
sum of all scores``. A threshold is used only where

1. ``lost`` is at most ``LARGEST_LOSS``;
2. a valley lies there: scores between tau / 2 and 3 tau / 2 are at most ``LARGEST_VALLEY`` of those under
   tau. This is the paper's own argument for Otsu, that the threshold could be moved without harm;
3. at least ``LEAST_CUT`` of all vertices lie under it, else it is not worth its bookkeeping.

Where Otsu's threshold fails, Otsu's of the scores under it is tried, and so on: with three modes (legs
never, hands now and then, the face always) the first threshold may cut off the hands, and the second one
leaves them.
"""

from __future__ import annotations

import dataclasses

import numpy as np

BINS = 256
LARGEST_LOSS, LARGEST_VALLEY, LEAST_CUT = 0.01, 0.1, 0.05


@dataclasses.dataclass(frozen=True)
class Threshold:
    """A threshold on scores and what it cuts.

    Attributes:
        tau: scores below it are gated; 0 where the gate stays open.
        otsu: tau* of the whole histogram, whether it is used or not.
        separability: eta at tau*.
        low_mean: mu_0 at tau*, the mean score under it.
        cut: the share of the vertices under ``tau``, or under ``otsu`` where the gate stays open.
        lost: the part of what the frames show that goes missing with them.
        why: one sentence.
    """

    tau: float
    otsu: float
    separability: float
    low_mean: float
    cut: float
    lost: float
    why: str

    @property
    def closed(self) -> bool:
        """True where anything is gated."""
        return self.tau > 0


def histogram(scores: np.ndarray) -> np.ndarray:
    """The histogram of scores, [V] in [0, 1], over ``BINS`` equal bins: [256] int64.

    Raises:
        ValueError: there is no score, or one is no share.
    """
    if not len(scores) or not (scores.min() >= 0 and scores.max() <= 1):
        raise ValueError("scores must be numbers from 0 to 1, and at least one")
    return np.bincount(np.minimum((scores * BINS).astype(np.int64), BINS - 1), minlength=BINS)


def otsu_threshold(counts: np.ndarray) -> tuple[float, float, float]:
    """Otsu's threshold of a histogram over [0, 1].

    Where several thresholds separate equally well, which is so across every gap, the middle one is taken.

    Args:
        counts: [256], not all zero.

    Returns:
        tau*, the separability eta in [0, 1] and the mean mu_0 of the lower class; 0, 0, 0 where all
        scores lie in one bin.

    Seven vertices that are seen in a tenth of the frames, and three that nearly always are:

    >>> tau, separability, low_mean = otsu_threshold(histogram(np.array([0.1] * 7 + [0.9] * 3)))
    >>> round(tau, 2), round(separability, 2), round(low_mean, 2)
    (0.5, 1.0, 0.1)
    """
    share = counts / counts.sum()
    centres = (np.arange(len(counts)) + 0.5) / len(counts)
    low, first = np.cumsum(share)[:-1], np.cumsum(share * centres)[:-1]
    mean = float((share * centres).sum())
    variance = float((share * (centres - mean) ** 2).sum())
    inner = (low > 0) & (low < 1 - 1e-12)
    if not inner.any():
        return 0.0, 0.0, 0.0
    between = np.zeros(len(low))
    between[inner] = (mean * low[inner] - first[inner]) ** 2 / (low[inner] * (1 - low[inner]))
    best = np.flatnonzero(between >= between.max() * (1 - 1e-6))
    last = int(best[len(best) // 2])  # bin of the lower class
    return (last + 1) / len(counts), float(between.max() / variance), float(first[last] / low[last])


def evidence_threshold(scores: np.ndarray, largest_loss: float = LARGEST_LOSS) -> Threshold:
    """Otsu's threshold if it passes the test of the module's docstring; else an open gate.

    Args:
        scores: [V] in [0, 1], of every vertex of the body.
        largest_loss: see there.

    >>> scores = np.array([0.0] * 40 + [0.95] * 60)
    >>> evidence_threshold(scores).why
    '40% of the body is under 0.48, and 0.00% of what is seen goes with it'
    >>> evidence_threshold(np.linspace(0, 1, 100)).closed  # no valley: nothing is gated
    False
    """
    tau, separability, low_mean = otsu_threshold(histogram(scores))
    first = tau
    while tau > 0:
        cut, lost = share_below(scores, tau)
        if cut < LEAST_CUT:
            break
        valley = float(((scores >= tau / 2) & (scores < 1.5 * tau)).mean())
        if lost <= largest_loss and valley <= LARGEST_VALLEY * cut:
            why = f"{cut:.0%} of the body is under {tau:.2f}, and {lost:.2%} of what is seen goes with it"
            return Threshold(tau, first, separability, low_mean, cut, lost, why)
        tau = otsu_threshold(histogram(scores[scores < tau]))[0]
    cut, lost = share_below(scores, first)
    return Threshold(0.0, first, separability, low_mean, cut, lost, _why_open(first, cut, lost))


def _why_open(tau: float, cut: float, lost: float) -> str:
    if tau == 0:
        return "all of the body is seen equally often"
    if cut < LEAST_CUT:
        return f"only {cut:.1%} of the body is seen less often than the rest"
    return f"a line at {tau:.2f} would take {lost:.1%} of what is seen, and there is no valley under it"


def plain_threshold(scores: np.ndarray) -> Threshold:
    """Otsu's threshold as it is, whatever it takes (Section 3.4); an open gate where all scores are equal."""
    tau, separability, low_mean = otsu_threshold(histogram(scores))
    cut, lost = share_below(scores, tau)
    why = f"{cut:.0%} of the body is under {tau:.2f}" if tau else "all of the body is seen equally often"
    return Threshold(tau, tau, separability, low_mean, cut, lost, why)


def fixed_threshold(scores: np.ndarray, tau: float) -> Threshold:
    """A threshold set by hand."""
    first, separability, low_mean = otsu_threshold(histogram(scores))
    return Threshold(tau, first, separability, low_mean, *share_below(scores, tau), "set by hand")


def share_below(scores: np.ndarray, tau: float) -> tuple[float, float]:
    """The share of vertices under a threshold, and the part of what is seen that goes missing with them."""
    under, total = scores < tau, float(scores.sum())
    return float(under.mean()), float(scores[under].sum()) / total if total else 0.0
