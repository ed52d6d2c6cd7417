"""The versioned store: what a stage publishes, under a key that says what it was made from.

``<root>/<subject>/<stage>/<key>/`` holds one version; it never changes once it is there. ``latest``
beside the versions is a link to the one in use. Work happens in ``.scratch-<key>`` beside them and
becomes visible by one rename, so a reader never meets half a version, whatever kills the writer.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fnmatch
import json
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import filelock

from pipeline import digest
from pipeline.errors import UserError
from pipeline.guard import require_finite_files

MANIFEST = "manifest.json"
RUN = "run.json"
LATEST = "latest"
SCRATCH = ".scratch-"
KEY_LENGTH = 16


@dataclasses.dataclass(frozen=True)
class Artifact:
    """One published version of one stage's result.

    Attributes:
        folder: where its files lie.
        manifest: what ``manifest.json`` says: stage, version, key, settings, inputs, files.
    """

    folder: Path
    manifest: Mapping[str, Any]

    @property
    def key(self) -> str:
        return str(self.manifest["key"])

    def digest_of(self, patterns: Sequence[str]) -> str:
        """The digest of the files that match any of ``patterns``, by name and content."""
        read = [
            [file["path"], file["sha256"]]
            for file in self.manifest["files"]
            if any(fnmatch.fnmatchcase(file["path"], pattern) for pattern in patterns)
        ]
        return digest.of_json(read)


@dataclasses.dataclass(frozen=True)
class Scratch:
    """Where a version is made.

    Attributes:
        output: what will be published; empty at the start of every attempt.
        work: checkpoints; survives a killed attempt and is gone after publication.
    """

    output: Path
    work: Path


@dataclasses.dataclass(frozen=True)
class Store:
    """All versions of all subjects under one folder."""

    root: Path

    def folder(self, subject: str, stage: str) -> Path:
        """Where the versions of one stage of one subject lie."""
        return self.root / subject / stage

    def find(self, subject: str, stage: str, key: str) -> Artifact | None:
        """The version with this key, or None if it is absent, incomplete or of the wrong size."""
        folder = self.folder(subject, stage) / key
        manifest = read_manifest(folder)
        if manifest is None or manifest.get("key") != key:
            return None
        artifact = Artifact(folder, manifest)
        return artifact if not wrong_sizes(artifact) else None

    def latest(self, subject: str, stage: str) -> Artifact | None:
        """The version in use, or None."""
        link = self.folder(subject, stage) / LATEST
        return self.find(subject, stage, link.resolve().name) if link.exists() else None

    def versions(self, subject: str, stage: str) -> list[Artifact]:
        """Every whole version of one stage, by key."""
        folder = self.folder(subject, stage)
        names = sorted(entry.name for entry in folder.iterdir()) if folder.is_dir() else []
        found = (
            self.find(subject, stage, name) for name in names if not name.startswith(".") and name != LATEST
        )
        return [artifact for artifact in found if artifact is not None]

    def select(self, artifact: Artifact) -> None:
        """Points ``latest`` at this version, in one step."""
        link = artifact.folder.parent / LATEST
        if link.is_symlink() and os.readlink(link) == artifact.folder.name:
            return
        fresh = link.with_name(f".{LATEST}-{os.getpid()}")
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(artifact.folder.name)
        os.replace(fresh, link)

    @contextlib.contextmanager
    def scratch(self, subject: str, stage: str, key: str, on_wait: Callable[[], None]) -> Iterator[Scratch]:
        """A place to make one version in, for one process at a time.

        Args:
            on_wait: called once if another process is making the same version.
        """
        folder = self.folder(subject, stage) / f"{SCRATCH}{key}"
        make_folder(folder.parent)
        lock = filelock.FileLock(folder.with_name(f".lock-{key}"))
        try:
            lock.acquire(timeout=0)
        except filelock.Timeout:
            on_wait()
            lock.acquire()
        try:
            scratch = Scratch(folder / "output", folder / "work")
            shutil.rmtree(scratch.output, ignore_errors=True)
            make_folder(scratch.output)
            make_folder(scratch.work)
            yield scratch
        finally:
            lock.release()

    def publish(
        self,
        scratch: Scratch,
        subject: str,
        stage: str,
        key: str,
        description: Mapping[str, Any],
        run: Mapping[str, Any],
    ) -> Artifact:
        """Makes what lies in ``scratch.output`` a version, durably and in one step.

        Args:
            description: what the manifest says besides the files: stage, version, settings, inputs.
            run: what differs between two equal runs (seconds, host, memory), for ``run.json``.
        """
        require_finite_files(scratch.output, "run the stage again, and report it if it happens again")
        files = [
            describe_file(scratch.output, path)
            for path in sorted(scratch.output.rglob("*"))
            if path.is_file()
        ]
        manifest = {**description, "key": key, "files": files}
        write_json(scratch.output / RUN, run)
        write_json(scratch.output / MANIFEST, manifest)
        flush_tree(scratch.output)
        target = self.folder(subject, stage) / key
        if target.exists():
            set_aside(target)
        os.rename(scratch.output, target)
        flush(target.parent)
        shutil.rmtree(scratch.output.parent, ignore_errors=True)
        artifact = Artifact(target, manifest)
        self.select(artifact)
        return artifact

    def prune(self, subject: str, stage: str) -> list[Path]:
        """Deletes every version but the one in use, and what killed runs left; returns what went."""
        folder = self.folder(subject, stage)
        link = folder / LATEST
        used = link.resolve() if link.is_symlink() else None
        gone = []
        for entry in sorted(folder.iterdir()) if folder.is_dir() else []:
            if entry.name == LATEST or entry.resolve() == used or in_use(entry):
                continue
            shutil.rmtree(entry) if entry.is_dir() else entry.unlink()
            gone.append(entry)
        return gone


def in_use(entry: Path) -> bool:
    """Whether a running process holds the lock of this scratch folder, or this lock."""
    key = entry.name.removeprefix(SCRATCH).removeprefix(".lock-")
    path = entry.with_name(f".lock-{key}")
    if not path.exists():
        return False
    try:
        with filelock.FileLock(path).acquire(timeout=0):
            return False
    except filelock.Timeout:
        return True


def read_manifest(folder: Path) -> dict[str, Any] | None:
    """What a version's manifest says, or None where it is absent or damaged."""
    try:
        manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return manifest if isinstance(manifest, dict) and isinstance(manifest.get("files"), list) else None


def wrong_sizes(artifact: Artifact) -> list[str]:
    """The files of a version that are missing or not of the size that its manifest says."""
    return [
        file["path"]
        for file in artifact.manifest["files"]
        if size_of(artifact.folder / file["path"]) != file["size"]
    ]


def wrong_digests(artifact: Artifact) -> list[str]:
    """The files of a version whose content is not what its manifest says; reads every byte."""
    wrong = set(wrong_sizes(artifact))
    whole = (file for file in artifact.manifest["files"] if file["path"] not in wrong)
    return sorted(
        wrong
        | {file["path"] for file in whole if digest.of_file(artifact.folder / file["path"]) != file["sha256"]}
    )


def verify(artifacts: Iterable[Artifact]) -> None:
    """Reads every byte of the versions.

    Raises:
        UserError: a file is damaged; names it and the stage to rerun.
    """
    for artifact in artifacts:
        damaged = wrong_digests(artifact)
        if damaged:
            stage, subject = artifact.folder.parent.name, artifact.folder.parent.parent.name
            raise UserError(
                f"{artifact.folder / damaged[0]}: damaged ({len(damaged)} file(s) of this version); "
                f"delete {artifact.folder} and rerun the stage: doit run {stage}:{subject}"
            )


def size_of(path: Path) -> int:
    """A file's size in bytes, or -1 where there is none."""
    try:
        return path.stat().st_size
    except OSError:
        return -1


def describe_file(root: Path, path: Path) -> dict[str, Any]:
    """A manifest's line for one file."""
    return {
        "path": path.relative_to(root).as_posix(),
        "size": path.stat().st_size,
        "sha256": digest.of_file(path),
    }


def write_json(path: Path, value: Mapping[str, Any]) -> None:
    """Writes JSON for people and programs: sorted, indented, refusing NaN."""
    path.write_text(json.dumps(value, indent=1, sort_keys=True, allow_nan=False) + "\n", encoding="utf-8")


def make_folder(folder: Path) -> None:
    """Makes a folder of the store.

    Raises:
        UserError: the store cannot be written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (PermissionError, FileExistsError, NotADirectoryError) as error:
        raise UserError(
            f"{folder}: cannot be made ({error.strerror}); choose another store: artifacts=FOLDER"
        ) from error


def set_aside(folder: Path) -> None:
    """Moves a damaged version out of the way under a name that no reader looks at, then deletes it."""
    aside = folder.with_name(f".damaged-{folder.name}-{os.getpid()}")
    os.rename(folder, aside)
    shutil.rmtree(aside, ignore_errors=True)


def flush_tree(folder: Path) -> None:
    """Forces a folder's files and entries to the disk, the deepest first."""
    for parent, _, names in os.walk(folder, topdown=False):
        for name in names:
            flush(Path(parent) / name)
        flush(Path(parent))


def flush(path: Path) -> None:
    """Forces one file or one folder's entries to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
