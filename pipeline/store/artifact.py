"""The versioned store: what a stage publishes, under a key that says what it was made from.

``<root>/<subject>/<stage>/<key>/`` holds one version; it never changes once it is there. ``latest``
beside the versions is a link to the one in use. Every byte of a version is covered by a digest: its files by
``manifest.json``, that and ``run.json`` by ``SHA256SUMS``. Work happens in ``.scratch-<key>`` beside them and
becomes visible by one rename, so a reader never meets half a version, whatever kills the writer.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fnmatch
import json
import os
import secrets
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import filelock

from pipeline.errors import UserError, is_disk_full
from pipeline.files.json_files import write_json
from pipeline.finite import require_finite_files
from pipeline.store import digest
from pipeline.store import record_digests as seal

MANIFEST = "manifest.json"
RUN = "run.json"
LATEST = "latest"
SCRATCH = ".scratch-"
LOCK = ".lock-"
DAMAGED = ".damaged-"
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
    """All versions of all subjects under one folder.

    Attributes:
        root: the folder.
        thorough: believe a version only after reading every byte of it, not its sizes alone.
    """

    root: Path
    thorough: bool = False

    def folder(self, subject: str, stage: str) -> Path:
        """Where the versions of one stage of one subject lie."""
        return self.root / subject / stage

    def subjects(self, stages: Iterable[str]) -> tuple[str, ...]:
        """The subjects with a folder of any of these stages, sorted."""
        folders = sorted(self.root.iterdir()) if self.root.is_dir() else []
        return tuple(one.name for one in folders if any((one / stage).is_dir() for stage in stages))

    def find(self, subject: str, stage: str, key: str) -> Artifact | None:
        """The version with this key, or None if it is absent, incomplete or damaged.

        Damaged is what has the wrong size, and in a thorough store what has the wrong content.
        """
        folder = self.folder(subject, stage) / key
        manifest = read_manifest(folder)
        if manifest is None or manifest["key"] != key:
            return None
        artifact = Artifact(folder, manifest)
        wrong = damaged_files(artifact) if self.thorough else wrong_sizes(artifact)
        return artifact if not wrong else None

    def latest(self, subject: str, stage: str) -> Artifact | None:
        """The version in use, or None."""
        link = self.folder(subject, stage) / LATEST
        return self.find(subject, stage, link.resolve().name) if link.exists() else None

    def versions(self, subject: str, stage: str) -> list[Artifact]:
        """Every whole version of one stage, by key."""
        found = (self.find(subject, stage, folder.name) for folder in self.folders(subject, stage))
        return [artifact for artifact in found if artifact is not None]

    def folders(self, subject: str, stage: str) -> list[Path]:
        """The folder of every version of one stage, whole or damaged, by key."""
        folder = self.folder(subject, stage)
        entries = sorted(folder.iterdir()) if folder.is_dir() else []
        return [entry for entry in entries if not entry.name.startswith(".") and entry.name != LATEST]

    def select(self, artifact: Artifact) -> None:
        """Points ``latest`` at this version, in one step.

        Raises:
            UserError: something else is in the link's place.
        """
        link = artifact.folder.parent / LATEST
        if link.is_symlink() and os.readlink(link) == artifact.folder.name:
            return
        if link.exists() and not link.is_symlink():
            raise UserError(f"{link}: is not a link (was the store copied without links?); delete it")
        fresh = link.with_name(f".{LATEST}-{secrets.token_hex(4)}")
        fresh.symlink_to(artifact.folder.name)
        os.replace(fresh, link)

    def settle(self, artifact: Artifact) -> None:
        """Points ``latest`` at this version, and clears what a run killed after publishing it left."""
        self.select(artifact)
        if not leftovers(artifact.folder):
            return
        with contextlib.suppress(OSError, filelock.Timeout), lock_of(artifact.folder).acquire(timeout=0):
            clear(leftovers(artifact.folder))

    @contextlib.contextmanager
    def scratch(self, subject: str, stage: str, key: str, on_wait: Callable[[], None]) -> Iterator[Scratch]:
        """A place to make one version in, for one process at a time.

        Args:
            on_wait: called once if another process is making the same version.
        """
        folder = self.folder(subject, stage) / f"{SCRATCH}{key}"
        make_folder(folder.parent)
        lock = lock_of(folder.with_name(key))
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
        except BaseException as error:
            if is_disk_full(error):  # half a result is of no use, and its room is wanted
                shutil.rmtree(scratch.output, ignore_errors=True)
            raise
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
        seal.write_seal(scratch.output, (MANIFEST, RUN))
        flush_tree(scratch.output)
        target = self.folder(subject, stage) / key
        if target.exists():  # it is damaged, or this would not have been made again
            os.rename(target, target.with_name(f"{DAMAGED}{key}-{secrets.token_hex(4)}"))
        os.rename(scratch.output, target)
        flush(target.parent)
        artifact = Artifact(target, manifest)
        self.select(artifact)
        clear(leftovers(target))
        return artifact

    def prune(self, subject: str, stage: str) -> list[Path]:
        """Deletes every version but the one in use, and what killed runs left; returns what went."""
        folder = self.folder(subject, stage)
        link = folder / LATEST
        used = link.resolve() if link.is_symlink() else None
        gone = []
        for entry in sorted(folder.iterdir()) if folder.is_dir() else []:
            if entry.name == LATEST or (entry.resolve() == used and not entry.is_symlink()) or in_use(entry):
                continue
            clear([entry])
            gone.append(entry)
        return gone


def lock_of(version: Path) -> filelock.BaseFileLock:
    """The lock that whoever makes this version holds."""
    return filelock.FileLock(version.with_name(f"{LOCK}{version.name}"))


def leftovers(version: Path) -> list[Path]:
    """What runs that were killed while they published this version left beside it."""
    parent, key = version.parent, version.name
    scratch = parent / f"{SCRATCH}{key}"
    return [*([scratch] if scratch.exists() else []), *parent.glob(f"{DAMAGED}{key}-*")]


def clear(entries: Sequence[Path]) -> None:
    """Deletes folders, files and links."""
    for entry in entries:
        if entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry, ignore_errors=True)
        else:
            entry.unlink(missing_ok=True)


def in_use(entry: Path) -> bool:
    """Whether a running process holds the lock of this scratch folder, or this lock."""
    version = entry.with_name(entry.name.removeprefix(SCRATCH).removeprefix(LOCK))
    if not version.with_name(f"{LOCK}{version.name}").exists():
        return False
    try:
        with lock_of(version).acquire(timeout=0):
            return False
    except filelock.Timeout:
        return True


def read_manifest(folder: Path) -> dict[str, Any] | None:
    """What a version's manifest says, or None where it is absent or damaged."""
    try:
        manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return manifest if isinstance(manifest, dict) and is_manifest(manifest) else None


def is_manifest(manifest: Mapping[str, Any]) -> bool:
    """Whether a key and the files are there as they should be."""
    fields = {"path": str, "size": int, "sha256": str}
    files = manifest.get("files")
    return (
        isinstance(manifest.get("key"), str)
        and isinstance(files, list)
        and all(
            isinstance(file, dict) and all(isinstance(file.get(name), kind) for name, kind in fields.items())
            for file in files
        )
    )


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
    for file in artifact.manifest["files"]:
        if file["path"] not in wrong and digest_of(artifact.folder / file["path"]) != file["sha256"]:
            wrong.add(file["path"])
    return sorted(wrong)


def damaged_files(artifact: Artifact) -> list[str]:
    """The files of a version, its own records included, that are not as they were published."""
    return [*seal.broken(artifact.folder, (MANIFEST, RUN)), *wrong_digests(artifact)]


def digest_of(path: Path) -> str:
    """A file's digest; empty where the disk does not give its bytes."""
    try:
        return digest.of_file(path)
    except OSError:
        return ""


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
