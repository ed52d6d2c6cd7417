"""The context that a stage is given, over folders of a test."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.run.stage import Context
from tests.made.body import BODY_FILE, BODY_FOLDER


@dataclasses.dataclass(frozen=True)
class RecordedContext(Context):
    """The runner's own context; ``logged`` keeps the lines that the stage said."""

    logged: list[str] = dataclasses.field(default_factory=list)

    def log(self, message: str) -> None:
        self.logged.append(message)
        super().log(message)


def stage_context(
    stage: str,
    settings: Any,
    output: Path,
    inputs: Mapping[str, Path] | None = None,
    work: Path | None = None,
    **more: Any,
) -> RecordedContext:
    """A context that writes to ``output``, and to a folder beside it unless ``work`` is given.

    Args:
        stage, settings, inputs: as of ``Context``.
        output, work: are made.
        more: other fields of ``Context``.
    """
    work = work or output.with_name(f"{output.name}-work")
    for made in (output, work):
        made.mkdir(parents=True, exist_ok=True)
    usual = {"subject": "someone", "assets": {}, "source": None, "body": BODY_FOLDER, "body_file": BODY_FILE}
    return RecordedContext(
        settings=settings, inputs=inputs or {}, output=output, work=work, stage=stage, **(usual | more)
    )
