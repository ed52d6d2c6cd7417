"""``report.html``: one file with everything in it, readable on a phone and without a network."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import jinja2
import numpy as np
from markupsafe import Markup

from stages.evaluate import tables
from stages.evaluate.omissions import Omission
from stages.evaluate.pictures import Closeup, Comparison
from stages.evaluate.plan_table import PlanRow
from stages.evaluate.records import StageRecord
from stages.evaluate.scoring import HELD_OUT

LARGEST_VIDEO = 24 * 2**20
"""Bytes of a video that is still embedded; browsers choke on much longer data URIs."""

_JPEG_QUALITY, _SLIDER_QUALITY = 92, 85
_SCRIPT = "slider.js"


@dataclasses.dataclass(frozen=True)
class Material:
    """Everything that the report shows.

    Attributes:
        summary: what ``summary.json`` holds.
        clip: one sentence on the footage.
        cover: pictures of the person, [H, W, 3] uint8 RGB, in two pairs of one size each.
        comparisons: truth, render and error of some frames, for the slider.
        closeups: faces and hands.
        error_gain: what the error was multiplied by.
        turntable: the turn, MP4.
        motion: a motion that was never filmed, MP4; where it exists.
        overlay: the fit drawn over the clip, MP4, and the same as one picture; whichever exists.
        curve: drawings of the training curve, SVG.
        fit_curve: drawings of what accuracy cost the registration, SVG.
        plan: what the scene called for, a row an effect.
        scores: drawing of the visibility scores, SVG; none where nothing was counted.
        gate: the gate's own sentence.
        refinement: what refining the test poses took; empty where they were not.
        score_picture: the body coloured by score, where it exists.
        omissions: what was left out.
        stages: upstream first.
        versions: what made the result, name -> version.
    """

    summary: Mapping[str, Any]
    clip: str
    cover: Sequence[np.ndarray]
    comparisons: Sequence[Comparison]
    closeups: Sequence[Closeup]
    error_gain: float
    turntable: Path
    motion: Path
    overlay: Sequence[Path]
    curve: Sequence[str]
    fit_curve: Sequence[str]
    plan: Sequence[PlanRow]
    scores: Sequence[str]
    gate: str
    refinement: str
    score_picture: Path
    omissions: Sequence[Omission]
    stages: Sequence[StageRecord]
    versions: Mapping[str, str]


def write_report(path: Path, material: Material) -> None:
    """Writes the report."""
    # The template stands beside this module; nothing of it is fetched from anywhere.
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    environment = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined)
    environment.trim_blocks = environment.lstrip_blocks = True
    template = environment.get_template("report.html.jinja")
    path.write_text(template.render(_contents(material)), encoding="utf-8")


def _contents(material: Material) -> dict[str, Any]:
    summary = material.summary
    script = (Path(__file__).parent / _SCRIPT).read_text(encoding="utf-8")
    return {
        "subject": summary["subject"],
        "summary": summary,
        "clip": material.clip,
        "cover": [picture_uri(picture) for picture in material.cover],
        "cover_columns": " ".join(f"{one.shape[1] / one.shape[0]:.4f}fr" for one in material.cover),
        "table": tables.main_table(summary),
        "composites": tables.composite_table(summary),
        "regions": tables.region_tables(summary),
        "likeness": tables.likeness_table(summary),
        "cameras": tables.camera_table(summary),
        "closeups": [_closeup(one) for one in material.closeups],
        "comparisons": [_comparison(one, _SLIDER_QUALITY) for one in material.comparisons],
        "held_out": HELD_OUT in summary["means"],
        "error_gain": f"{material.error_gain:g}",
        "turntable": video_uri(material.turntable),
        "motion": _overlay([material.motion]),
        "overlay": _overlay(material.overlay),
        "curve": [Markup(drawing) for drawing in material.curve],
        "fit_curve": [Markup(drawing) for drawing in material.fit_curve],
        "plan": material.plan,
        "scores": [Markup(drawing) for drawing in material.scores],
        "gate": material.gate,
        "refinement": material.refinement,
        "score_picture": _overlay([material.score_picture]),
        "omissions": material.omissions,
        "stages": material.stages,
        "total": _total(material.stages),
        "peak": max((stage.memory for stage in material.stages if stage.memory), default=None),
        "versions": material.versions,
        "script": Markup(script),
        "script_hash": script_hash(script),
    }


def script_hash(script: str) -> str:
    """What the page's policy admits: this script and no other."""
    return "sha256-" + base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")


def _comparison(one: Comparison, quality: int = _JPEG_QUALITY) -> dict[str, Any]:
    truth, render, error = (picture_uri(picture, quality) for picture in one.pictures)
    return {"frame": one.frame, "psnr": f"{one.psnr:.2f}", "truth": truth, "render": render, "error": error}


def _closeup(one: Closeup) -> dict[str, Any]:
    name = "Face" if one.region == "face" else "Hand"
    return {"name": name, **_comparison(one.comparison, _SLIDER_QUALITY)}


def _overlay(candidates: Sequence[Path]) -> dict[str, str] | None:
    """The first that exists and is not too large: a video, else a picture."""
    for path in candidates:
        if path.is_file() and path.stat().st_size <= LARGEST_VIDEO:
            if path.suffix == ".mp4":
                return {"kind": "video", "uri": video_uri(path)}
            return {"kind": "picture", "uri": _uri("image/png", path.read_bytes())}
    return None


def _total(stages: Sequence[StageRecord]) -> float | None:
    seconds = [stage.seconds for stage in stages if stage.seconds is not None]
    return sum(seconds) if seconds else None


def picture_uri(image: np.ndarray, quality: int = _JPEG_QUALITY) -> str:
    """[H, W, 3] uint8 RGB as a data URI."""
    stored = np.ascontiguousarray(image[..., ::-1])
    encoded = cv2.imencode(".jpg", stored, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return _uri("image/jpeg", encoded.tobytes())


def video_uri(path: Path) -> str:
    """An MP4 file as a data URI."""
    return _uri("video/mp4", path.read_bytes())


def _uri(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"
