"""Who there is to reconstruct, and from which footage.

A subject is one file, ``data/subjects/<name>.toml``::

    title = "A man, head and shoulders"
    dataset = "samples"             # optional: one of data/datasets, for settings that its subjects share
    [source]
    asset = "smile"                 # footage that assets.toml can fetch ...
    file = "single_face.mp4"
    # path = "sources/oliver.mp4"   # ... or a file or folder of the user's, relative to data/
    # obtain = "where to get it"    (without [source], the ingest settings say what is made up)
    [ingest]                        # any setting of any stage
    test_frames = 30

or none at all: ``doit run subject=me source=clip.mp4``.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.config.datasets import known_datasets, load_dataset
from pipeline.config.settings import Layer, near, read_toml
from pipeline.config.workspace import Workspace
from pipeline.errors import UserError

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")
LONGEST = 100  # letters of a name, which is a folder's


@dataclasses.dataclass(frozen=True)
class Subject:
    """One person and one recording.

    Attributes:
        name: as in ``subject=NAME`` and in the store.
        title: one line for people.
        asset: the asset that holds the footage, or None.
        source: the footage, a video file or a folder; None where nothing says where it is.
        obtain: what to do when it is not there.
        layers: the dataset's and the subject's settings.
    """

    name: str
    title: str
    asset: str | None
    source: Path | None
    obtain: str
    layers: tuple[Layer, ...]


def known_subjects(workspace: Workspace) -> tuple[str, ...]:
    """The subjects that data/subjects names, sorted."""
    return tuple(sorted(path.stem for path in (workspace.definitions("subjects")).glob("*.toml")))


def load_subject(
    workspace: Workspace, name: str, source: Path | None = None, dataset: str | None = None
) -> Subject:
    """Reads a subject's file, if it has one.

    Args:
        source: the command line's footage, which replaces the file's.
        dataset: the command line's dataset, which replaces the file's.

    Raises:
        UserError: no such subject, or its file is wrong.
    """
    if not NAME.fullmatch(name):
        raise UserError(f"subject={name[:60]}: a name is made of letters, digits, '.', '_' and '-'")
    if len(name) > LONGEST:
        raise UserError(f"subject={name[:60]}...: a name has at most {LONGEST} letters, not {len(name)}")
    path = workspace.definitions("subjects") / f"{name}.toml"
    if not path.is_file():
        if source is None:
            raise UserError(
                f"subject={name}: there is no {path} and no footage; name a clip: "
                f"doit run subject={name} source=CLIP.mp4{near(name, known_subjects(workspace))}"
            )
        layers = (load_dataset(workspace, dataset).layer,) if dataset else ()
        return Subject(name, name, None, source, "", layers)
    content = read_toml(path)
    return parse_subject(workspace, path, {**content, "dataset": dataset} if dataset else content, source)


def parse_subject(
    workspace: Workspace, path: Path, content: Mapping[str, Any], source: Path | None
) -> Subject:
    """The subject that a file's content describes."""
    tables = {name: value for name, value in content.items() if name not in ("title", "dataset", "source")}
    footage = content.get("source", {})
    if not isinstance(footage, dict) or not all(isinstance(text, str) for text in footage.values()):
        raise UserError(f"{path}: [source] is a table of texts: 'asset' and 'file', or 'path' and 'obtain'")
    unknown = set(footage) - {"asset", "file", "path", "obtain"}
    if unknown:
        raise UserError(
            f"{path}: [source] takes 'asset' and 'file', or 'path' and 'obtain', not {sorted(unknown)}"
        )
    layers, obtain = [Layer(str(path), tables)], str(footage.get("obtain", ""))
    if "dataset" in content:
        known = known_datasets(workspace)
        if content["dataset"] not in known:
            named = str(content["dataset"])[:60]
            raise UserError(
                f"{path}: there is no dataset={named}, only {', '.join(known)}{near(named, known)}"
            )
        dataset = load_dataset(workspace, content["dataset"])
        layers.insert(0, dataset.layer)
        obtain = obtain or dataset.obtain
    asset = footage.get("asset") if source is None else None
    return Subject(
        name=path.stem,
        title=str(content.get("title", path.stem)),
        asset=asset,
        source=find_footage(workspace, footage, asset, source),
        obtain=obtain,
        layers=tuple(layers),
    )


def find_footage(
    workspace: Workspace, footage: Mapping[str, str], asset: str | None, source: Path | None
) -> Path | None:
    """Where the footage should lie, whether or not it is there."""
    if source is not None:
        return source
    if asset is not None:
        return workspace.assets / asset / footage.get("file", "")
    return workspace.data / footage["path"] if "path" in footage else None


def require_footage(workspace: Workspace, subject: Subject) -> Path:
    """The footage's path.

    Raises:
        UserError: it is not there; says what to fetch from where, and names a subject that runs now.
    """
    if subject.source is not None and (subject.source.is_file() or subject.source.is_dir()):
        return subject.source
    if subject.source is not None and (subject.source.exists() or subject.source.is_symlink()):
        raise UserError(
            f"{subject.source} is neither a file nor a folder, or a link to nothing: give a video or a folder"
        )
    if subject.asset is not None:
        raise UserError(f"{subject.source}: not fetched yet; fetch it: doit run assets:{subject.asset}")
    remedy = (subject.obtain or "name it: source=CLIP.mp4").rstrip(".")
    raise UserError(
        f"{subject.source or subject.name}: the footage of '{subject.name}' is not there; {remedy}. "
        "A subject that runs now: doit run subject=smile"
    )
