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

from pipeline.clip.plan import Decision
from pipeline.viewer.page import script_hash, viewer_fragment, viewer_script
from stages.evaluate.report import tables
from stages.evaluate.report.omissions import Omission
from stages.evaluate.report.pictures import Closeup, Comparison
from stages.evaluate.scores import HELD_OUT
from stages.evaluate.turned import Turned
from stages.evaluate.upstream import StageRecord

LARGEST_VIDEO = 24 * 2**20
"""Bytes of a video that is still embedded; browsers choke on much longer data URIs."""

_JPEG_QUALITY, _SLIDER_QUALITY = 92, 85
_SCRIPT = "slider.js"


@dataclasses.dataclass(frozen=True)
class ReportContents:
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
        training_plots: of the training curve, SVG.
        registration_plots: of what accuracy cost the registration, SVG.
        visibility_plots: of the visibility scores, SVG; none where nothing was counted.
        visibility_picture: the body coloured by score, where it exists.
        plan: what the scene called for, a decision an effect.
        gate: the gate's own sentence.
        refinement_cost: what refining the test poses took; empty where they were not.
        omissions: what was left out.
        stages: upstream first.
        versions: what made the result, name -> version.
        turned: the avatar from all sides, where it was looked at.
        packed: the avatar for the interactive part, as ``pipeline.viewer.packed`` writes it.
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
    training_plots: Sequence[str]
    registration_plots: Sequence[str]
    visibility_plots: Sequence[str]
    visibility_picture: Path
    plan: Sequence[Decision]
    gate: str
    refinement_cost: str
    omissions: Sequence[Omission]
    stages: Sequence[StageRecord]
    versions: Mapping[str, str]
    turned: Turned | None = None
    packed: bytes | None = None


def write_report(path: Path, contents: ReportContents) -> None:
    """Writes the report."""
    # The template stands beside this module; nothing of it is fetched from anywhere.
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    environment = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined)
    environment.trim_blocks = environment.lstrip_blocks = True
    environment.filters |= {"picture_uri": picture_uri, "video_uri": video_uri}
    template = environment.get_template("report.html.jinja")
    path.write_text(template.render(_template_values(contents)), encoding="utf-8")


def _template_values(contents: ReportContents) -> dict[str, Any]:
    """The contents by their names, what is embedded of them, and the tables that the summary fills."""
    summary, stages = contents.summary, contents.stages
    scripts = [(Path(__file__).parent / _SCRIPT).read_text(encoding="utf-8")]
    scripts += [] if contents.packed is None else [viewer_script()]
    return {
        **vars(contents),
        "held_out": HELD_OUT in summary["means"],
        "cover_columns": " ".join(f"{one.shape[1] / one.shape[0]:.4f}fr" for one in contents.cover),
        "slider_quality": _SLIDER_QUALITY,
        "closeup_names": {"face": "Face", "hands": "Hand"},
        "table": tables.main_table(summary),
        "composites": tables.composite_table(summary),
        "regions": tables.region_tables(summary),
        "consistency": tables.consistency_table(summary),
        "cameras": tables.camera_table(summary),
        "motion": _embedded([contents.motion]),
        "overlay": _embedded(contents.overlay),
        "visibility_picture": _embedded([contents.visibility_picture]),
        "total": sum(stage.seconds or 0.0 for stage in stages),
        "peak": max((stage.memory for stage in stages if stage.memory), default=None),
        "viewer": "" if contents.packed is None else viewer_fragment(contents.packed),
        "scripts": scripts,
        "script_hashes": [script_hash(one) for one in scripts],
    }


def _embedded(candidates: Sequence[Path]) -> dict[str, str] | None:
    """The first that exists and is not too large: a video, else a picture."""
    for path in candidates:
        if path.is_file() and path.stat().st_size <= LARGEST_VIDEO:
            if path.suffix == ".mp4":
                return {"kind": "video", "uri": video_uri(path)}
            return {"kind": "picture", "uri": _uri("image/png", path.read_bytes())}
    return None


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
