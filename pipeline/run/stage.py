"""What a stage is: its declaration, what it asks for and what it is given.

A stage is declared in ``stages/<name>/__init__.py`` as ``STAGE`` and found there by its name, so that
this package needs no import of any stage.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import pkgutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.errors import UserError
from pipeline.run.progress import Progress


@dataclasses.dataclass(frozen=True)
class Loan:
    """Files of another subject that a stage reads.

    Attributes:
        subject: whose.
        stage: whose result they are part of.
        files: patterns of their names; their digests enter the key.
        source: the subject's footage, where the subject is nothing but a clip that is named; None for one
            that is there anyway.
    """

    subject: str
    stage: str
    files: tuple[str, ...]
    source: Path | None = None

    def described(self) -> dict[str, Any]:
        """What of it enters a key: not where the footage lies."""
        return {"subject": self.subject, "stage": self.stage, "files": self.files}


@dataclasses.dataclass(frozen=True)
class Demands:
    """What a stage asks for besides its upstream stages, under the settings of one job.

    Attributes:
        assets: names in data/assets.toml.
        source: the footage.
        body: the body model and its landmarks.
        paths: the files and folders that settings name, by setting.
        loans: what is read of other subjects.
    """

    assets: tuple[str, ...]
    source: bool
    body: bool
    paths: Mapping[str, Path]
    loans: tuple[Loan, ...] = ()


@dataclasses.dataclass(frozen=True)
class Stage:
    """The declaration of a stage.

    Attributes:
        name: the folder under ``stages`` and the name in the store.
        version: raised by hand when the same inputs would give another result.
        settings: a frozen pydantic dataclass; its defaults are the ``quick`` preset's.
        run: ``"module:function"``, imported only in the stage's own process.
        needs: upstream stage -> patterns of its files that this stage reads. Only those files'
            digests enter the key, so a change to any other does not make this stage stale.
        assets: the names in data/assets.toml that must be on disk.
        reads_source: whether it reads the footage.
        reads_body: whether it reads the body model and its landmarks.
        path_settings: the settings that may name a file or a folder, whose content then enters the key.
        path_words: values of theirs that are words, also where a file or folder has that name.
        on_request: whether it is run only by its name, and is no part of what ``doit run`` does.
        words: settings that may stand on the command line without the stage's name before them.
        loans: what it reads of other subjects.
        idle: of a settings object, the settings that it cannot use: name -> what to write instead. Naming one
            on the command line is an error.
        compile_ahead: ``"module:function"`` that calls the stage's kernels once, so that numba compiles
            them, see ``pipeline.run.compile_ahead``; empty for none.

    ``assets``, ``reads_source``, ``reads_body``, ``loans`` and ``compile_ahead`` may be functions of the
    settings object, so that a stage asks only for what these settings call for.
    """

    name: str
    version: int
    settings: type
    run: str
    needs: Mapping[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)
    assets: tuple[str, ...] | Callable[[Any], tuple[str, ...]] = ()
    reads_source: bool | Callable[[Any], bool] = False
    reads_body: bool | Callable[[Any], bool] = False
    path_settings: tuple[str, ...] = ()
    path_words: tuple[str, ...] = ()
    on_request: bool = False
    words: tuple[str, ...] = ()
    loans: tuple[Loan, ...] | Callable[[Any], tuple[Loan, ...]] = ()
    idle: Callable[[Any], Mapping[str, str]] | None = None
    compile_ahead: str | Callable[[Any], str] = ""

    def kernels_of(self, settings: Any) -> str:
        """The function that compiles the stage's kernels under these settings; empty for none."""
        return self.compile_ahead(settings) if callable(self.compile_ahead) else self.compile_ahead

    def demands(self, settings: Any) -> Demands:
        """What the stage asks for under these settings."""

        def under(value: Any) -> Any:
            return value(settings) if callable(value) else value

        return Demands(
            assets=under(self.assets),
            source=under(self.reads_source),
            body=under(self.reads_body),
            paths=self.named_paths(settings),
            loans=under(self.loans),
        )

    def named_paths(self, settings: Any) -> dict[str, Path]:
        """The files and folders that settings other than the defaults name."""
        values = {name: getattr(settings, name) for name in self.path_settings}
        words = {"", *self.path_words}
        given = {
            name: Path(value)
            for name, value in values.items()
            if value not in words and value != getattr(self.settings, name)
        }
        return {name: path for name, path in given.items() if path.exists()}


def load_stages(package: str = "stages") -> dict[str, Stage]:
    """Every stage declared in the sub-packages of ``package``, upstream before downstream.

    Raises:
        UserError: a stage needs one that does not exist, or two need each other.
    """
    folder = importlib.import_module(package)
    names = sorted(module.name for module in pkgutil.iter_modules(folder.__path__) if module.ispkg)
    found: dict[str, Stage] = {}
    for name in names:
        stage = importlib.import_module(f"{package}.{name}").STAGE
        found[stage.name] = stage
    ordered: dict[str, Stage] = {}
    while len(ordered) < len(found):
        ready = [
            stage for name, stage in found.items() if name not in ordered and set(stage.needs) <= set(ordered)
        ]
        if not ready:
            raise UserError(
                f"{package}: need each other or what does not exist: {sorted(set(found) - set(ordered))}"
            )
        ordered.update((stage.name, stage) for stage in ready)
    return ordered


def upstream_first(stages: Mapping[str, Stage], wanted: Iterable[str]) -> list[str]:
    """Some stages and all that they need, in the order in which they run."""
    found = set(wanted)
    for name in reversed(list(stages)):
        found |= set(stages[name].needs) if name in found else set()
    return [name for name in stages if name in found]


def usual(stages: Mapping[str, Stage]) -> list[str]:
    """The stages that are run without being asked for by name, upstream first."""
    return [name for name, stage in stages.items() if not stage.on_request]


@dataclasses.dataclass(frozen=True)
class Context:
    """What a stage's ``run`` is given.

    Attributes:
        subject: the subject's name.
        settings: this stage's settings object.
        inputs: upstream stage -> folder of its published files; read only.
        assets: asset name -> its folder.
        source: the footage, for a stage that reads it.
        body: the folder of the open body and the landmarks.
        body_file: the body model in use.
        output: what is written here is published.
        work: for checkpoints: it survives a killed run and is never published.
        timings: filled by ``timing``; goes to run.json.
        loans: stage -> folder of another subject's published files; read only.
    """

    subject: str
    settings: Any
    inputs: Mapping[str, Path]
    assets: Mapping[str, Path]
    source: Path | None
    body: Path
    body_file: Path
    output: Path
    work: Path
    stage: str = ""
    timings: dict[str, Any] = dataclasses.field(default_factory=dict)
    loans: Mapping[str, Path] = dataclasses.field(default_factory=dict)

    @contextlib.contextmanager
    def progress(self, total: int, label: str, costs: Sequence[float] | None = None) -> Iterator[Progress]:
        """A progress display for ``total`` steps; ``costs`` are their relative costs, equal if None."""
        progress = Progress(total, f"{self.stage}:{self.subject} {label}", costs)
        try:
            yield progress
        finally:
            progress.close()

    def log(self, message: str) -> None:
        """One line to the terminal."""
        print(f"{self.stage}:{self.subject} {message}", flush=True)

    def timing(self, name: str, value: Any) -> None:
        """Notes something that differs between two equal runs (seconds, memory), for run.json."""
        self.timings[name] = value
