"""Where a study's own measurements lie, and what they are taken on."""

from __future__ import annotations

from collections.abc import Mapping

from pipeline.assets import require
from pipeline.config.request import parse_request
from pipeline.job import open_job
from pipeline.metrics import Lpips
from pipeline.studies.clip import Clip
from pipeline.studies.notes import Notes
from pipeline.studies.run import stage_words
from pipeline.study import Outcome
from pipeline.workspace import Workspace


def notes_of(workspace: Workspace, subject: str) -> Notes:
    """A subject's notes; both kinds of study share them."""
    return Notes(workspace.data / "studies" / "measured" / subject)


def clip_of(base: Outcome, words: Mapping[str, str], workspace: Workspace) -> Clip:
    """The clip of the base, on the background that evaluate composites on."""
    own = open_job(base.subject, parse_request(stage_words(words), base.subject))
    background = getattr(own.settings["evaluate"], "background", "black")
    return Clip(
        ingest=base.folders["ingest"],
        body_file=workspace.body_file,
        background=background if background in ("black", "white") else "black",
        lpips=Lpips(require(workspace, "lpips"), "alex"),
    )
