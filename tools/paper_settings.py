"""Writes the tables of settings in docs/paper.md anew from the presets: run it when a setting has changed.

The reasons in the first table are kept; a setting that is new there gets an empty one, to be filled in.
"""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

from pipeline.config.settings import Layer, read_toml, resolve
from pipeline.config.workspace import REPOSITORY
from pipeline.run.stage import load_stages

PAGE = REPOSITORY / "docs" / "paper.md"
STAGES = ("ingest", "fit", "plan", "auxiliary", "train", "evaluate")
HEADING = "## Settings that differ from quick"
ROW = re.compile(r"^\| `(\w+\.\w+)` \| `[^`]*` \| `[^`]*` \| (.*) \|$", re.MULTILINE)
INTRODUCTION = f"""{HEADING}

`python -m tools.paper_settings` writes this section and the next; a test compares them with the presets.

| setting | `quick` | `paper` | the paper, or why |
|---|---|---|---|
"""
OTHERS = """
## All other settings

The same in `quick` and `paper`.
"""


def resolved(preset: str) -> dict[str, Any]:
    """Every setting of a preset by its name, as JSON holds it."""
    file = REPOSITORY / "data" / "presets" / f"{preset}.toml"
    kinds = {name: stage.settings for name, stage in load_stages().items() if name in STAGES}
    tables = {name: table for name, table in read_toml(file).items() if name in kinds}
    found = resolve(kinds, [Layer(str(file), tables)])
    return {
        f"{stage}.{field.name}": json.loads(json.dumps(getattr(found[stage], field.name)))
        for stage in STAGES
        for field in dataclasses.fields(found[stage])
    }


def written(page: str) -> str:
    """The page with both sections as the presets are now.

    Args:
        page: as it is; its reasons are kept.
    """
    before, _, sections = page.partition(HEADING)
    reasons = dict(ROW.findall(sections))
    quick, paper = resolved("quick"), resolved("paper")
    text = before + INTRODUCTION
    for name, value in paper.items():
        if quick[name] != value:
            values = f"`{json.dumps(quick[name])}` | `{json.dumps(value)}`"
            text += f"| `{name}` | {values} | {reasons.get(name, '')} |\n"
    text += OTHERS
    for stage in STAGES:
        own = [name for name in paper if name.startswith(f"{stage}.") and quick[name] == paper[name]]
        text += "\n" + ", ".join(f"`{name} = {json.dumps(paper[name])}`" for name in own) + ".\n"
    return text


def main(page: Path = PAGE) -> None:
    """Rewrites the page."""
    page.write_text(written(page.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
