"""One subject's way through the stages: settings, keys, what is there, and running what is not."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib
import os
import platform
import sys
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pipeline.config import assets as third_party
from pipeline.config.request import Request
from pipeline.config.settings import Layer, as_dict, command_line_layer, near, read_toml, resolve
from pipeline.config.subjects import Subject, known_subjects, load_subject, require_footage
from pipeline.config.workspace import Workspace
from pipeline.errors import UserError
from pipeline.run.stage import Context, Loan, Stage, load_stages, upstream_first
from pipeline.store import digest
from pipeline.store.artifact import Artifact, Store, clear

NOT_SETTINGS = ("title", "resources")  # what a preset's file holds besides settings

Found = dict[str, Artifact | None]


@dataclasses.dataclass(frozen=True)
class Job:
    """One subject with everything decided.

    Attributes:
        request: the command line that asks for it, about this subject alone.
        stages: every stage, upstream first.
        subject: who, and the footage.
        settings: stage name -> its settings object.
    """

    request: Request
    stages: Mapping[str, Stage]
    subject: Subject
    settings: Mapping[str, Any]

    @property
    def workspace(self) -> Workspace:
        return self.request.workspace

    @property
    def store(self) -> Store:
        return Store(self.workspace.artifacts, self.request.verify)

    @functools.cached_property
    def source_digest(self) -> str:
        return self.digest_of(require_footage(self.workspace, self.subject))

    @functools.cached_property
    def body_digest(self) -> str:
        if not self.workspace.body_file.is_file():
            raise UserError(
                f"{self.workspace.body_file}: there is no body model; leave out body= for the open one"
            )
        files = [self.workspace.body_file, *sorted(self.workspace.body.glob("landmarks_*.npz"))]
        return digest.of_json([self.digest_of(file) for file in files])

    def digest_of(self, path: Path) -> str:
        """The digest of a file or folder outside the store, remembered beside the store."""
        return digest.of_source(path, self.workspace.artifacts / ".digests.json")

    def description(self, name: str, found: Found | None = None) -> dict[str, Any]:
        """What the key of a stage's result is made from; also the head of its manifest.

        Args:
            found: what this look at the store has found so far.

        Raises:
            UserError: an upstream result is not there, or the footage is not.
        """
        stage = self.stages[name]
        inputs, who = {}, self.subject.name
        for upstream, patterns in stage.needs.items():
            artifact = self.find(upstream, found)
            if artifact is None:
                raise UserError(f"{name} of '{who}' needs {upstream}: doit run {upstream}:{who}")
            inputs[upstream] = {"files": list(patterns), "sha256": artifact.digest_of(patterns)}
        demands = stage.demands(self.settings[name])
        pins = third_party.load_assets(self.workspace) if demands.assets else {}
        lent = {loan: self.lent(name, loan).digest_of(loan.files) for loan in demands.loans}
        loans = {"loans": [{**loan.described(), "sha256": digest} for loan, digest in lent.items()]}
        return {
            "stage": name,
            "version": stage.version,
            "settings": as_dict(self.settings[name]),
            "inputs": inputs,
            "assets": {asset: pins[asset].identity for asset in demands.assets},
            "source": self.source_digest if demands.source else None,
            "body": self.body_digest if demands.body else None,
            "paths": {setting: self.digest_of(path) for setting, path in demands.paths.items()},
            **(loans if lent else {}),  # no word of it for the others, whose keys stay as they were
        }

    def lent(self, name: str, loan: Loan) -> Artifact:
        """The result of another subject that a stage reads: what is asked for here, else the latest.

        Raises:
            UserError: there is none.
        """
        check_footage(loan, self.request)
        own = loan.subject == self.subject.name
        artifact, reason = None, ""
        try:
            lender = self if own else open_job(loan.subject, lent_request(loan, self.request))
            artifact = lender.find(loan.stage)
        except (
            UserError
        ) as error:  # no such subject, or its footage is not there any more; its results may be
            reason = f" ({error})"
        artifact = artifact or self.store.latest(loan.subject, loan.stage)
        if artifact is None:
            footage = "" if loan.source is None else f" subject={loan.subject} source={loan.source}"
            raise UserError(
                f"{name} of '{self.subject.name}' needs {loan.stage} of '{loan.subject}': "
                f"doit run {loan.stage}:{loan.subject}{footage}{reason}"
            )
        return artifact

    def find(self, name: str, found: Found | None = None) -> Artifact | None:
        """The stage's result under the present settings and inputs, if the store holds it.

        Args:
            found: what this look at the store has found so far, so that each stage is looked at once.

        Raises:
            UserError: the footage is not there, or what is read of another subject.
        """
        found = {} if found is None else found
        if name not in found:
            whole = all(self.find(upstream, found) is not None for upstream in self.stages[name].needs)
            found[name] = (
                self.store.find(self.subject.name, name, key_of(self.description(name, found)))
                if whole
                else None
            )
        return found[name]

    def is_current(self, name: str) -> bool:
        """Whether nothing needs to run; if so, ``latest`` is pointed at the result."""
        artifact = self.find(name)
        if artifact is not None:
            self.store.settle(artifact)
        return artifact is not None

    def upstream_first(self, wanted: Iterable[str]) -> list[str]:
        """Some stages and all that they need, in the order in which they run."""
        return upstream_first(self.stages, wanted)

    def needed_assets(self, name: str) -> list[str]:
        """The assets that a stage needs, its footage's included."""
        demands = self.stages[name].demands(self.settings[name])
        footage = [self.subject.asset] if demands.source and self.subject.asset else []
        return [*demands.assets, *footage]


def lent_request(loan: Loan, request: Request) -> Request:
    """The request that makes what is lent: of a clip it is about a subject of that footage."""
    if loan.source is None:
        return request
    return dataclasses.replace(request, subjects=(loan.subject,), datasets=(), source=loan.source)


def check_footage(loan: Loan, request: Request) -> None:
    """Refuses a clip whose name is that of a subject with other footage.

    Raises:
        UserError: says which, and what to do.
    """
    if loan.source is None:
        return
    name, workspace = loan.subject, request.workspace
    remedy = f"rename the clip, or write subject:{name} for that subject's motion"
    known = load_subject(workspace, name).source if name in known_subjects(workspace) else None
    if name in known_subjects(workspace) and not (known and known.exists() and known.samefile(loan.source)):
        raise UserError(f"{loan.source}: there is a subject '{name}' with other footage: {remedy}")
    artifact = Store(workspace.artifacts).latest(name, loan.stage)
    made = artifact.manifest.get("source") if artifact else None
    if made and loan.source.exists():
        if made != digest.of_source(loan.source, workspace.artifacts / ".digests.json"):
            raise UserError(
                f"{loan.source}: the store's '{name}' was made from other footage: {remedy}, or delete it: "
                f"doit clean subject={name}"
            )


def key_of(description: Mapping[str, Any]) -> str:
    """The key of a version: a digest of what it is made from."""
    return digest.of_json(description)[:16]


def wanted_keys(job: Job) -> dict[str, str]:
    """The key that each stage's result has under the present settings, where its inputs are in the store.

    Whole inputs, that is: a damaged manifest would lead to another key.
    """
    keys, job = {}, dataclasses.replace(job, request=dataclasses.replace(job.request, verify=True))
    for name in job.stages:
        with contextlib.suppress(UserError):
            keys[name] = key_of(job.description(name))
    return keys


def preset_layer(workspace: Workspace, name: str) -> Layer:
    """The settings of a preset.

    Raises:
        UserError: there is no such preset; shows which there are.
    """
    path = preset_path(workspace, name)
    tables = {key: value for key, value in read_toml(path).items() if key not in NOT_SETTINGS}
    return Layer(str(path), tables)


def preset_path(workspace: Workspace, name: str) -> Path:
    """A preset's file; UserError where there is none."""
    path = workspace.definitions("presets") / f"{name}.toml"
    if not path.is_file():
        known = sorted(file.stem for file in (workspace.definitions("presets")).glob("*.toml"))
        raise UserError(
            f"preset={name}: there is no such preset; there are {', '.join(known)}{near(name, known)}"
        )
    return path


def setting_layers(request: Request, subject: Subject | None) -> list[Layer]:
    """The layers of settings, the weakest first."""
    layers = [preset_layer(request.workspace, request.preset)]
    return [*layers, *(subject.layers if subject else ()), command_line_layer(request.overrides)]


def check_settings(request: Request) -> None:
    """Refuses wrong settings of preset and command line before anything runs.

    Raises:
        UserError: says which, and shows the near names or the range.
    """
    stages = load_stages(request.workspace.stages)
    resolve({name: stage.settings for name, stage in stages.items()}, setting_layers(request, None))


def open_job(subject: str, request: Request) -> Job:
    """The job of one subject.

    Args:
        subject: whose.
        request: the command line's; its footage and dataset count where it names the subject.

    Raises:
        UserError: a name, a value or a file is wrong.
    """
    request = request.about(subject)
    stages = load_stages(request.workspace.stages)
    who = load_subject(request.workspace, subject, request.source, request.dataset)
    kinds = {name: stage.settings for name, stage in stages.items()}
    return Job(request, stages, who, resolve(kinds, setting_layers(request, who)))


def run_stage(job: Job, name: str) -> Artifact:
    """Makes a stage's result unless the store holds it, and publishes it.

    Raises:
        UserError: an input is not there, or the stage's own reasons.
    """
    description = job.description(name)
    key = key_of(description)
    subject = job.subject.name

    def say_waiting() -> None:
        print(f"{name}:{subject} another process is making the same result; waiting for it", flush=True)

    with job.store.scratch(subject, name, key, say_waiting) as scratch:
        already = job.store.find(subject, name, key)
        if already is not None:
            job.store.select(already)
            clear([scratch.output.parent])
            return already
        stage, demands = job.stages[name], job.stages[name].demands(job.settings[name])
        upstream = {other: job.find(other) for other in stage.needs}
        context = Context(
            subject=subject,
            settings=job.settings[name],
            inputs={other: artifact.folder for other, artifact in upstream.items() if artifact is not None},
            assets={asset: third_party.require(job.workspace, asset) for asset in demands.assets},
            source=require_footage(job.workspace, job.subject) if demands.source else None,
            body=job.workspace.body,
            body_file=job.workspace.body_file,
            output=scratch.output,
            work=scratch.work,
            stage=name,
            loans={loan.stage: job.lent(name, loan).folder for loan in demands.loans},
        )
        start = time.monotonic()
        entry_point(stage)(context)
        seconds = time.monotonic() - start
        artifact = job.store.publish(scratch, subject, name, key, description, run_record(context, seconds))
        context.log(f"done in {seconds:.1f} s: {shown(artifact.folder)}")
        return artifact


def entry_point(stage: Stage) -> Any:
    """The stage's ``run`` function, imported now."""
    module, _, function = stage.run.partition(":")
    return getattr(importlib.import_module(module), function)


def run_record(context: Context, seconds: float) -> dict[str, Any]:
    """What differs between two equal runs: time, memory, machine."""
    return {
        "seconds": round(seconds, 3),
        "cpu_seconds": round(time.process_time(), 3),  # of all threads, with what it imported itself
        "peak_memory_mib": peak_memory(),
        "host": platform.node(),
        "machine": platform.machine(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "finished": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "timings": context.timings,
    }


def peak_memory() -> float:
    """The most memory that this process has had at once, MiB; 0 where the platform does not say."""
    try:
        import resource
    except ImportError:  # Windows
        return 0.0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // (1 if sys.platform != "darwin" else 1024)
    return round(peak / 1024, 1)


def shown(path: Path) -> str:
    """A path as a user would type it: relative to the present folder where that is shorter."""
    try:
        return str(path.relative_to(Path.cwd()))
    except ValueError:
        return str(path)
