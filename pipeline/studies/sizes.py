"""What a study's numbers hang on, in a sentence, and which versions they were made with."""

from __future__ import annotations

import importlib.metadata
import json
import platform
from collections.abc import Mapping

from pipeline.artifact import MANIFEST, RUN
from pipeline.config.request import parse_request
from pipeline.job import open_job
from pipeline.studies.knobs import mesh_of
from pipeline.study import Outcome

LIBRARIES = ("torch", "numba", "numpy")


def sizes_of(words: Mapping[str, str], outcome: Outcome) -> str:
    """How large and how long the runs were.

    Args:
        words: the study's own.
        outcome: of one of its runs.
    """
    settings = open_job(outcome.subject, parse_request(words, outcome.subject)).settings
    train, ingest = settings["train"], settings["ingest"]
    side = ingest.mannequin_size if ingest.mannequin else ingest.long_side
    own = f"{train.iterations:,} iterations, {mesh_of(train, settings['plan'])}, pictures of {side} px"
    small = (
        ""
        if train.iterations >= 1000
        else "; small: a part that needs a long run shows less than it is worth"
    )
    return f"Sizes: {own}{small}."


def versions_of(outcome: Outcome) -> dict[str, str]:
    """Stages, libraries and machine of a run, for the page."""
    found = {}
    for stage, folder in outcome.folders.items():
        manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        found[stage] = f"version {manifest.get('version', '?')}"
    found |= {name: importlib.metadata.version(name) for name in LIBRARIES}
    record = json.loads((outcome.folders["train"] / RUN).read_text(encoding="utf-8"))
    cores, machine = record.get("cores"), record.get("machine")
    return {**found, "Python": platform.python_version(), "machine": f"{cores} cores, {machine}"}
