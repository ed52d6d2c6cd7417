"""What a store looks like from outside: what is wrong in it, where a run was, and what it published."""

from __future__ import annotations

import json
import os
from pathlib import Path

from pipeline.store import digest
from pipeline.store.artifact import LATEST, LOCK, MANIFEST, RUN, SCRATCH, in_use
from pipeline.store.record_digests import SEAL
from pipeline.store.verify import damages
from tests.faults.project import Project

# What differs between two equal runs: seconds, in the run's own record and in what shows it.
TIMES = (RUN, SEAL)
SHOWS_TIMES = ("report.html",)
PHASES = ("starting", "working", "writing records", "not yet latest", "clearing", "between stages")


def wrongs(project: Project) -> list[str]:
    """Everything that a killed run must not leave; empty where all is well."""
    found = [
        f"{damage.stage}: damaged and visible: {', '.join(damage.files)}"
        for damage in damages(project.store, project.subject, project.stages)
    ]
    for stage in project.stages:
        folder = project.store.folder(project.subject, stage)
        link = folder / LATEST
        if link.is_symlink() and project.store.latest(project.subject, stage) is None:
            found.append(f"{stage}: latest names {os.readlink(link)}, which is no whole version")
        for entry in folder.iterdir() if folder.is_dir() else ():
            if entry.name.startswith(LOCK) and in_use(entry):
                found.append(f"{stage}: {entry.name} is still held")
    return found


def phase(project: Project, stage: str) -> str:
    """Where in a stage a run was when it ended."""
    folder = project.store.folder(project.subject, stage)
    scratch = list(folder.glob(f"{SCRATCH}*"))
    if project.store.folders(project.subject, stage):
        if project.store.latest(project.subject, stage) is None:
            return "not yet latest"
        return "clearing" if scratch else "between stages"
    if any((one / "output" / RUN).exists() for one in scratch):
        return "writing records"
    return "working" if scratch else "starting"


def litter(project: Project) -> list[str]:
    """What a finished run has left besides versions, ``latest`` and locks."""
    found = []
    for stage in project.stages:
        folder = project.store.folder(project.subject, stage)
        found += [
            f"{stage}/{entry.name}"
            for entry in folder.iterdir()
            if entry.name.startswith(".") and not entry.name.startswith(LOCK)
        ]
    return found


def published(project: Project) -> dict[str, str]:
    """The digest of every published file that equal runs have in common, by ``stage/key/path``."""
    found = {}
    for stage in project.stages:
        for folder in project.store.folders(project.subject, stage):
            for path in sorted(folder.rglob("*")):
                if path.is_file() and path.name not in (*TIMES, *SHOWS_TIMES):
                    name = f"{stage}/{folder.name}/{path.relative_to(folder).as_posix()}"
                    found[name] = timeless(path) if path.name == MANIFEST else digest.of_file(path)
    return found


def timeless(manifest: Path) -> str:
    """The digest of a manifest without the digests of files that show times."""
    content = json.loads(manifest.read_text())
    content["files"] = [file for file in content["files"] if file["path"] not in SHOWS_TIMES]
    return digest.of_json(content)


def differences(expected: dict[str, str], found: dict[str, str]) -> list[str]:
    """The files that only one of two runs has, or of which they have different bytes."""
    return sorted(name for name in expected.keys() | found.keys() if expected.get(name) != found.get(name))
