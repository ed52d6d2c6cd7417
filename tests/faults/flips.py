"""A bit flipped in a file of each kind that each stage publishes: found, and mended by the command given."""

from __future__ import annotations

import random
from pathlib import Path

from pipeline.config.request import Request
from pipeline.store.verify import look_at, remedy
from tests.faults.project import Project


def kinds(project: Project, draw: random.Random) -> dict[str, Path]:
    """One file of each kind of each stage, by stage and kind; the records are a kind each."""
    found: dict[str, list[Path]] = {}
    for stage in project.stages:
        for folder in project.store.folders(project.subject, stage):
            for path in sorted(path for path in folder.rglob("*") if path.is_file() and path.stat().st_size):
                # What lies in the version's own folder by name, of a folder of pictures one picture.
                name = path.name if path.parent == folder else f"{path.parent.name}/*{path.suffix}"
                found.setdefault(f"{stage}/{name}", []).append(path)
    return {kind: draw.choice(paths) for kind, paths in found.items()}


def flip(path: Path, draw: random.Random) -> None:
    """Flips one random bit of a file in place."""
    with path.open("r+b") as file:
        place = draw.randrange(path.stat().st_size)
        file.seek(place)
        byte = file.read(1)[0]
        file.seek(place)
        file.write(bytes([byte ^ 1 << draw.randrange(8)]))


def unnoticed(project: Project, draw: random.Random) -> tuple[int, list[str]]:
    """Flips a bit in a file of each kind, one after the other, and puts it back.

    Returns:
        How many were flipped, and of which the message did not name the stage to rerun.
    """
    files = kinds(project, draw)
    missed = []
    for kind, path in files.items():
        whole = path.read_bytes()
        flip(path, draw)
        stage = kind.split("/")[0]
        folder = next(one for one in project.store.folders(project.subject, stage) if one in path.parents)
        damage = look_at(folder)
        if not damage.files or f"doit run {stage}:{project.subject}" not in remedy(damage, Request(), {}):
            missed.append(kind)
        path.write_bytes(whole)
    return len(files), missed


def damage_every_stage(project: Project, draw: random.Random) -> None:
    """Flips a bit in one file of each stage and leaves it so."""
    files = kinds(project, draw)
    for stage in project.stages:
        own = [path for kind, path in files.items() if kind.startswith(f"{stage}/")]
        flip(draw.choice(own), draw)
