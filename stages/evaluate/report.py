"""``report.html``: one file with everything in it, readable on a phone and without a network."""

from __future__ import annotations

import base64
import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import jinja2
import numpy as np
from markupsafe import Markup

from stages.evaluate.omissions import Omission
from stages.evaluate.pictures import Comparison
from stages.evaluate.plan_table import PlanRow
from stages.evaluate.records import StageRecord
from stages.evaluate.scoring import AVATAR, HELD_OUT
from stages.evaluate.summary import LABELS, METRIC_LABELS, best, lower_is_better, number, rows

LARGEST_VIDEO = 24 * 2**20
"""Bytes of a video that is still embedded; browsers choke on much longer data URIs."""

_JPEG_QUALITY = 92


@dataclasses.dataclass(frozen=True)
class Material:
    """Everything that the report shows.

    Attributes:
        summary: what ``summary.json`` holds.
        clip: one sentence on the footage.
        cover: pictures of the person, [H, W, 3] uint8 RGB, in two pairs of one size each.
        comparisons: truth, render and error of a few frames.
        error_gain: what the error was multiplied by.
        turntable: the turn, MP4.
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
    """

    summary: Mapping[str, Any]
    clip: str
    cover: Sequence[np.ndarray]
    comparisons: Sequence[Comparison]
    error_gain: float
    turntable: Path
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
    return {
        "subject": summary["subject"],
        "summary": summary,
        "clip": material.clip,
        "cover": [picture_uri(picture) for picture in material.cover],
        "cover_columns": " ".join(f"{one.shape[1] / one.shape[0]:.4f}fr" for one in material.cover),
        "table": _table(summary["means"], summary["metrics"]),
        "comparisons": [_comparison(one) for one in material.comparisons],
        "held_out": HELD_OUT in summary["means"],
        "error_gain": f"{material.error_gain:g}",
        "turntable": video_uri(material.turntable),
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
    }


def _table(means: Mapping[str, Any], metrics: Sequence[str]) -> dict[str, Any]:
    winners = {metric: best(means, metric) for metric in metrics}
    body = []
    for split, method, row in rows(means):
        wins = [split == HELD_OUT and winners[name] == method for name in metrics]
        cells = [(number(name, row[name]), win) for name, win in zip(metrics, wins, strict=True)]
        main = (split, method) == (HELD_OUT, AVATAR)
        body.append({"label": LABELS[split, method], "cells": cells, "main": main})
    head = [(METRIC_LABELS[name], "↓" if lower_is_better(name) else "↑") for name in metrics]
    return {"head": head, "rows": body}


def _comparison(one: Comparison) -> dict[str, Any]:
    truth, render, error = (picture_uri(picture) for picture in one.pictures)
    return {"frame": one.frame, "psnr": f"{one.psnr:.2f}", "truth": truth, "render": render, "error": error}


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


def picture_uri(image: np.ndarray) -> str:
    """[H, W, 3] uint8 RGB as a data URI."""
    stored = np.ascontiguousarray(image[..., ::-1])
    encoded = cv2.imencode(".jpg", stored, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1]
    return _uri("image/jpeg", encoded.tobytes())


def video_uri(path: Path) -> str:
    """An MP4 file as a data URI."""
    return _uri("video/mp4", path.read_bytes())


def _uri(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"
