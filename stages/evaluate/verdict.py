"""The verdict: how good the avatar is and what limits it, in sentences made from the numbers.

Each limit is told in the decibels that it takes, measured on this clip:

- **masks**: the truth itself scores no more than the ceiling under a second mask;
- **poses**: refining held-out poses on their own images gains so much;
- **generalisation**: frames that were learnt from score so much more than held-out ones;
- **face, hands**: their crops score so much less than the person as a whole.

What the clip never showed of the body costs no held-out frame anything, and an avatar everything once it
turns; it is said apart.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from pipeline.clip.fit_quality import FitQuality
from pipeline.clip.plan import AZIMUTH_STEP
from stages.evaluate.methods import AVATAR, BASELINES, CEILING, MESH, NEAREST, REFINED
from stages.evaluate.scores import HELD_OUT, TRAINING

LEVEL = 1.0  # dB within which an interval about zero means that there is no difference
CLEAR = 1.0  # dB under which a cause is not worth naming
NEAR_CEILING = 2.0  # dB between avatar and ceiling, under which masks are what is measured
PARTS = 3.0  # dB by which a part must be worse than the whole person to be named
NAMED = 2  # causes
HOLES = 0.5  # percent of the silhouette, from which holes are named
SPECKLE = 1.2  # of guessed over seen surface, from which it is named

_OVER = {NEAREST: "copying the nearest training frame", MESH: "the textured mesh"}


@dataclasses.dataclass(frozen=True)
class ClipCoverage:
    """The parts of the person that the clip shows, and how well the body fits it.

    Attributes:
        unmodelled: the share of the body's vertices that carry no Gaussians.
        azimuths: degrees of the directions from which no training frame saw the person; 0 is its front.
        fit_pixels: mean reprojection error of the fit on trusted keypoints; None where not known.
        quality: how well the fit says that it is on the person; None where not known.
    """

    unmodelled: float
    azimuths: tuple[float, ...]
    fit_pixels: float | None
    quality: FitQuality | None = None


def verdict(summary: Mapping[str, Any], coverage: ClipCoverage) -> list[str]:
    """Two to five sentences.

    Args:
        summary: what ``summary.json`` holds.
        coverage: of the person by the clip.
    """
    return [
        sentence
        for sentence in (
            off_the_person(coverage),
            quality(summary),
            limits(summary, coverage),
            turned(coverage),
            worst_side(summary.get("turned")),
        )
        if sentence
    ]


def off_the_person(coverage: ClipCoverage) -> str:
    """The sentence on frames in which the body is not on the person; empty where there are none."""
    fit = coverage.quality
    if fit is None or bool(fit.passed.all()):
        return ""
    failed, total = int((~fit.passed).sum()), len(fit.frames)
    if bool((~fit.passed & fit.accepted).any()):
        return (
            f"The fitted body is not on the person in {failed} of {total} frames, used all the same "
            f"(fit.accept=any), so nothing below says much: {fit.figures()}."
        )
    return f"{failed} of {total} frames were left out: the fitted body is not on the person there."


def quality(summary: Mapping[str, Any]) -> str:
    """The avatar on frames that it never saw, against what needs no avatar."""
    means = summary["means"].get(HELD_OUT, {})
    if AVATAR not in means:
        psnr = summary["means"].get(TRAINING, {}).get(AVATAR, {}).get("psnr")
        known = f": {psnr:.1f} dB on those it was trained on" if psnr is not None else ""
        return f"No frame was held out, so nothing says how good it is on new ones{known}."
    rival, gain = _best_baseline(summary)
    score = f"{means[AVATAR]['psnr']:.1f} dB on frames it never saw"
    if rival is None or gain is None:
        return f"{score[0].upper()}{score[1:]}."
    span = f"{100 * summary['confidence']:.0f}% interval {gain['low']:+.1f} to {gain['high']:+.1f}"
    if gain["low"] > 0:
        verb = f"{gain['mean']:.1f} dB better than {_OVER[rival]} ({span})"
    elif gain["high"] < 0:
        verb = f"{-gain['mean']:.1f} dB worse than {_OVER[rival]} ({span})"
    elif max(-gain["low"], gain["high"]) < LEVEL:
        verb = f"Level with {_OVER[rival]} ({gain['mean']:+.1f} dB, {span})"
    else:
        few = f"which {summary['frames'][HELD_OUT]} held-out frames do not settle"
        verb = f"{gain['mean']:+.1f} dB against {_OVER[rival]}, {few} ({span})"
    return f"{verb}: {score}{_sharpness(means, rival)}."


def limits(summary: Mapping[str, Any], coverage: ClipCoverage) -> str:
    """The causes that take the most decibels."""
    found = causes(summary)
    worth = sorted(((cost, text) for cost, text in found if cost >= CLEAR), reverse=True)[:NAMED]
    fit = fit_sentence(coverage)
    if worth:
        return f"What limits it most: {'; then '.join(text for _, text in worth)}.{fit}"
    ceiling = summary["means"].get(HELD_OUT, {}).get(CEILING, {}).get("psnr")
    allowed = f"; masks would allow {ceiling:.1f} dB" if ceiling is not None else ""
    return f"No single limit stands out{allowed}.{fit}" if found else fit.strip()


def fit_sentence(coverage: ClipCoverage) -> str:
    """The sentence on how far the fit is off; begins with a space, empty where it is not known."""
    if coverage.fit_pixels is None:
        return ""
    used = coverage.quality and coverage.quality.of(coverage.quality.frames[coverage.quality.accepted])
    judged = f": in the median frame {used.figures()}" if used else ""
    return f" The fit is off by {coverage.fit_pixels:.1f} px{judged}."


def causes(summary: Mapping[str, Any]) -> list[tuple[float, str]]:
    """The decibels that each cause takes, and its sentence; only of what was measured."""
    means, found = summary["means"].get(HELD_OUT, {}), []
    avatar = means.get(AVATAR, {}).get("psnr")
    if avatar is None:
        return []
    ceiling = means.get(CEILING, {}).get("psnr")
    if ceiling is not None:
        margin = ceiling - avatar
        text = f"masks (the truth itself scores {ceiling:.1f} dB under a second mask)"
        # A score at the ceiling can hardly rise, whatever else is mended.
        found.append((100.0 if margin < NEAR_CEILING else 0.0, text))
    gain = summary["differences"].get(REFINED, {}).get("psnr")  # on the frames that were refined
    if gain is not None:
        found.append((-gain["mean"], f"poses (refining them gains {-gain['mean']:.1f} dB)"))
    trained = summary["means"].get(TRAINING, {}).get(AVATAR, {}).get("psnr")
    if trained is not None:
        text = f"new frames ({trained - avatar:.1f} dB below those it learnt from)"
        found.append((trained - avatar, text))
    whole = means[AVATAR].get("psnr_person")
    for part in ("face", "hands"):
        value = means[AVATAR].get(f"psnr_{part}")
        if value is not None and whole is not None and whole - value > PARTS:
            found.append(
                (whole - value - PARTS, f"the {part} ({value:.1f} dB against {whole:.1f} of the person)")
            )
    return found


def turned(coverage: ClipCoverage) -> str:
    """The sentence on what the avatar shows when it is turned; empty where nothing is missing."""
    hollow = (
        f"{100 * coverage.unmodelled:.0f}% of the body was hardly ever in the picture and has no Gaussians"
    )
    behind = [azimuth for azimuth in coverage.azimuths if 90 < azimuth % 360 < 270]
    if len(coverage.azimuths) and behind:
        count = f"{len(coverage.azimuths)} of {360 // AZIMUTH_STEP} directions"
        back = f"{count} were never filmed, the back among them: there it is a guess"
        return f"Turned: {back}; {hollow}." if coverage.unmodelled >= 0.01 else f"Turned: {back}."
    return f"{hollow}." if coverage.unmodelled >= 0.01 else ""


def worst_side(numbers: Mapping[str, Any] | None) -> str:
    """The worst of what is wrong where the avatar is turned; empty where nothing is, or nobody looked.

    Args:
        numbers: those of ``stages.evaluate.turned.Turned``.
    """
    if numbers is None:
        return ""
    if numbers["face_behind"]:
        return "Turned round, a face is found where the back of the head is."
    holes, speckle = 100 * numbers["holes"], numbers["speckle"]
    if holes >= HOLES:
        return f"Turned round, it has holes: {holes:.1f}% of its silhouette lets light through."
    if speckle is not None and speckle >= SPECKLE:
        return f"Turned round, what no frame showed is {speckle:.1f} times as speckled as the rest."
    return ""


def _best_baseline(summary: Mapping[str, Any]) -> tuple[str | None, Mapping[str, float] | None]:
    """The baseline that comes nearest to the avatar, and what the avatar has over it."""
    over = summary["differences"]
    known = [
        (over[name]["psnr"]["mean"], name)
        for name in BASELINES
        if name in _OVER and "psnr" in over.get(name, {})
    ]
    if not known:
        return None, None
    name = min(known)[1]
    return name, over[name]["psnr"]


def _sharpness(means: Mapping[str, Any], rival: str) -> str:
    """A remark where LPIPS says otherwise than PSNR."""
    metric = next((name for name in means[AVATAR] if name in ("lpips_vgg", "lpips_alex")), None)
    if metric is None or means[rival].get(metric) is None:
        return ""
    own, other = 100 * means[AVATAR][metric], 100 * means[rival][metric]
    if own <= other:
        return ""
    return f", but less sharp (LPIPS x100 {own:.1f} against {other:.1f})"
