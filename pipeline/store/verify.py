"""Reading every published byte again: what is damaged, and how it is put right."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Iterable, Mapping
from pathlib import Path

from pipeline.config.request import Request
from pipeline.errors import UserError
from pipeline.store.artifact import MANIFEST, Artifact, Store, damaged_files, read_manifest


@dataclasses.dataclass(frozen=True)
class Damage:
    """A version that is not what was published.

    Attributes:
        folder: the version's.
        files: which of its files are damaged, by name.
    """

    folder: Path
    files: tuple[str, ...]

    @property
    def stage(self) -> str:
        return self.folder.parent.name

    @property
    def subject(self) -> str:
        return self.folder.parent.parent.name


def look_at(folder: Path) -> Damage:
    """What of a version is missing or not as it was published; reads every byte."""
    manifest = read_manifest(folder)
    if manifest is None or manifest["key"] != folder.name:
        return Damage(folder, (MANIFEST,))
    return Damage(folder, tuple(damaged_files(Artifact(folder, manifest))))


def damages(store: Store, subject: str, stages: Iterable[str]) -> list[Damage]:
    """Every damaged version of a subject, upstream first."""
    looked_at = (look_at(folder) for stage in stages for folder in store.folders(subject, stage))
    return [damage for damage in looked_at if damage.files]


def remedy(damage: Damage, request: Request, wanted: Mapping[str, str]) -> str:
    """What is damaged, and the command that makes it again.

    Args:
        damage: a damaged version.
        request: the command line's, which the command repeats.
        wanted: stage -> the key of the version that is asked for, where that is known.
    """
    others = f" and {len(damage.files) - 1} more of its files" if len(damage.files) > 1 else ""
    said = f"{damage.folder / damage.files[0]}{others}: damaged"
    stage, subject = damage.stage, damage.subject
    if wanted.get(stage, damage.folder.name) != damage.folder.name:
        return (
            f"{said}; made by {stage} under other settings: rerun it with those and verify=true, "
            f"or delete the version: doit run prune:{subject}"
        )
    words = dataclasses.replace(request, verify=True).words()
    line = " ".join(shlex.quote(f"{name}={value}") for name, value in words.items())
    return f"{said}; rerun the stage: doit run {stage}:{subject} {line}"


def verify(
    store: Store,
    subject: str,
    stages: Iterable[str],
    request: Request | None = None,
    wanted: Mapping[str, str] | None = None,
) -> int:
    """Reads every byte of a subject's versions; returns how many there are.

    Args:
        request, wanted: as of ``remedy``.

    Raises:
        UserError: versions are damaged; a line each names the file, the stage to rerun and the command.
    """
    stages = tuple(stages)
    found = damages(store, subject, stages)
    if found:
        raise UserError("\n".join(remedy(damage, request or Request(), wanted or {}) for damage in found))
    return sum(len(store.folders(subject, stage)) for stage in stages)
