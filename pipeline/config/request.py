"""The command line, parsed once: which subjects, under which settings, where.

What follows ``doit run`` and ``python -m pipeline`` is a list of ``NAME=VALUE`` words. A word with a dot is a
setting, ``train.seed=3``; some stages let a setting of theirs stand without the stage's name (``motion=``).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Field, Strict
from pydantic.dataclasses import dataclass

from pipeline.config.settings import SETTINGS, near, read_fields, schemas
from pipeline.config.workspace import Workspace, open_workspace
from pipeline.errors import UserError
from pipeline.run.stage import Stage, load_stages

ORIGIN = "the command line"
DEFAULT_PRESET = "quick"

FIELDS = {
    "subject": "subjects", "dataset": "datasets", "source": "source", "preset": "preset", "verify": "verify",
    "cluster": "cluster", "cpus": "cpus", "gpus": "gpus", "budget": "budget", "scale": "scale",
    "port": "port", "host": "host",
}  # fmt: skip
"""Word -> the field of the request; the words of ``PLACES`` make its workspace."""

PLACES = {
    "data": "data", "artifacts": "artifacts", "assets": "assets", "body": "body_file", "stages": "stages",
}  # fmt: skip
"""Word -> the field of the workspace."""

Processors = Annotated[float, Field(ge=0, le=10_000)]
Port = Annotated[int, Field(ge=0, le=65535)]
Footage = Annotated[Path, Strict(False), AfterValidator(Path.absolute)]


@dataclass(frozen=True, config=SETTINGS)
class Request:
    """What a command line asks for.

    Attributes:
        subjects: those that ``subject=`` names; empty: none is named.
        datasets: those that ``dataset=`` names: whose subjects are meant, or the named subject's dataset.
        source: the named subject's footage, in place of what its file says.
        preset: a file of data/presets.
        overrides: setting, such as ``train.seed`` -> its text.
        workspace: where things lie.
        verify: believe no version in the store before all of it was read.
        cluster: of ``doit run batch``: ``auto``, ``local`` or an address.
        cpus, gpus: what a subject is given there; None: what the preset asks for.
        budget: the time that a study may take, such as ``20m``; None: its own.
        scale: the size of a study's runs.
        port: of ``doit run view``, where its page is served; 0: any that is free.
        host: of the same, the address that it listens on; nothing but this machine reaches 127.0.0.1.
    """

    subjects: tuple[str, ...] = ()
    datasets: tuple[str, ...] = ()
    source: Footage | None = None
    preset: str = DEFAULT_PRESET
    overrides: dict[str, str] = dataclasses.field(default_factory=dict)
    workspace: Workspace = dataclasses.field(default_factory=open_workspace)
    verify: bool = False
    cluster: str = "auto"
    cpus: Processors | None = None
    gpus: Processors | None = None
    budget: str | None = None
    scale: str = "preset"
    port: Port = 8321
    host: str = "127.0.0.1"

    @property
    def dataset(self) -> str | None:
        """The dataset of the subject that is named; None: what its file says."""
        return self.datasets[0] if self.subjects and self.datasets else None

    def about(self, subject: str) -> Request:
        """The same for one subject: footage and dataset are only those of a subject that is named."""
        if subject in self.subjects:
            return dataclasses.replace(self, subjects=(subject,))
        return dataclasses.replace(self, subjects=(), datasets=(), source=None)

    def override(self, overrides: Mapping[str, str]) -> Request:
        """The same with these settings on top."""
        return dataclasses.replace(self, overrides={**self.overrides, **overrides})

    def words(self) -> dict[str, str]:
        """The words that ask for the same; what has its default is left out."""
        default = Request()
        given = {word: getattr(self, field) for word, field in FIELDS.items()}
        words = {
            word: _text(value) for word, value in given.items() if value != getattr(default, FIELDS[word])
        }
        usual = {**dict.fromkeys(PLACES, open_workspace(self.workspace.data)), "data": default.workspace}
        places = {
            word: str(getattr(self.workspace, field))
            for word, field in PLACES.items()
            if getattr(self.workspace, field) != getattr(usual[word], field)
        }
        return {**words, **places, **self.overrides}


def _text(value: object) -> str:
    if isinstance(value, tuple):
        return ",".join(value)
    return str(value).lower() if isinstance(value, bool) else str(value)


def parse_request(words: Iterable[str] | Mapping[str, str], subject: str = "") -> Request:
    """Reads a command line. Settings are checked where they are resolved (:mod:`pipeline.run.job`).

    Args:
        words: ``["subject=oliver", "train.seed=3"]``, or the same as a mapping.
        subject: who it is about, in place of ``subject=``.

    Raises:
        UserError: a word is not of the form NAME=VALUE, unknown (the near names are shown), there twice,
            empty or wrong.
    """
    pairs = dict(words) if isinstance(words, Mapping) else _pairs(words)
    pairs |= {"subject": subject} if subject else {}
    for name, text in pairs.items():
        if "." not in name and name in (*FIELDS, *PLACES) and not text.strip(" ,"):
            raise UserError(f"{ORIGIN}: {name}= names nothing; leave it out, or say what is meant")
    if "data" in pairs and not Path(pairs["data"]).is_dir():
        raise UserError(f"{ORIGIN}: data={pairs['data']} is no folder; make it first, or leave data= out")
    workspace = open_workspace(**{name: pairs[name] for name in PLACES if name in pairs})
    stages = load_stages(workspace.stages)
    pairs = _with_stage_names(pairs, stages)
    _check_names(pairs, stages)
    fields = {FIELDS[name]: text for name, text in pairs.items() if name in FIELDS}
    overrides = {name: text for name, text in pairs.items() if "." in name}
    values = read_fields(Request, fields, ORIGIN)
    request = Request(**values, workspace=workspace, overrides=overrides)
    if request.subjects and len(request.datasets) > 1:
        raise UserError(f"{ORIGIN}: dataset= names one dataset where subject= says who")
    return request


def _pairs(words: Iterable[str]) -> dict[str, str]:
    pairs: dict[str, str] = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not equals:
            raise UserError(f"'{word}' is not of the form NAME=VALUE")
        if name in pairs:
            raise UserError(f"{ORIGIN}: {name}= stands twice, {pairs[name]} and {value}: leave one out")
        pairs[name] = value
    return pairs


def _with_stage_names(pairs: Mapping[str, str], stages: Mapping[str, Stage]) -> dict[str, str]:
    """The pairs with the stage's name before those settings that may stand without it."""
    full = {word: f"{name}.{word}" for name, stage in stages.items() for word in stage.words}
    twice = [word for word in pairs if full.get(word) in pairs]
    if twice:
        raise UserError(f"{ORIGIN}: {twice[0]} and {full[twice[0]]} are the same setting")
    return {full.get(word, word): value for word, value in pairs.items()}


def _check_names(pairs: Mapping[str, str], stages: Mapping[str, Stage]) -> None:
    known = [*FIELDS, *PLACES, *(word for stage in stages.values() for word in stage.words)]
    known += [f"{name}.{field}" for name, stage in stages.items() for field in schemas(stage.settings)]
    for word in pairs:
        if "." not in word and word not in (*FIELDS, *PLACES):
            raise UserError(f"{ORIGIN}: there is no '{word}'{near(word, known)}")
