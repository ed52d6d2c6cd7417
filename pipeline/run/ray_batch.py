"""Many subjects on a Ray cluster: ``doit run batch dataset=insta cluster=auto``.

Ray is the scheduler and there is no other: a subject's way through the stages is one Ray task, with the CPUs
and GPUs that its preset asks for. The task starts each stage as a process, as doit does, over the data folder
that all machines share under one path. What is done is in the store, so a task that Ray starts again because
its machine was lost begins with the stage that was lost.

``cluster=auto`` joins the cluster that runs here, or starts a local Ray; ``local`` always starts one, which
listens on the loopback interface alone; anything else is a cluster's address.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import socket
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic.dataclasses import dataclass

from pipeline.config import assets as third_party
from pipeline.config.request import Processors, Request
from pipeline.config.settings import SETTINGS, read_fields, read_toml
from pipeline.config.workspace import REPOSITORY
from pipeline.errors import UserError
from pipeline.run.doit_reporter import Outcome, summary_lines
from pipeline.run.job import Job, open_job, preset_path
from pipeline.run.process import run_stage_process
from pipeline.run.stage import Stage, usual

RETRIES = 5  # how often a subject is begun again because its machine was lost
WAIT_SECONDS = 10.0  # between lines that say what is still running
LOCAL = "127.0.0.1"


@dataclass(frozen=True, config=SETTINGS)
class Resources:
    """What a subject is given.

    Attributes:
        cpus, gpus: whole machines' worth of none; a GPU may be shared, 0.5.
    """

    cpus: Processors = 1.0
    gpus: Processors = 0.0


def resources_of(request: Request) -> Resources:
    """What the preset asks for; ``cpus=`` and ``gpus=`` on the command line replace it.

    Raises:
        UserError: there is no such preset, or its numbers make no sense.
    """
    path = preset_path(request.workspace, request.preset)
    asked = read_fields(Resources, read_toml(path).get("resources", {}), str(path), "resources.")
    given = {"cpus": request.cpus, "gpus": request.gpus}
    return Resources(**{**asked, **{name: value for name, value in given.items() if value is not None}})


def run_subject(subject: str, request: Request) -> Outcome:
    """Everything that a subject lacks, a stage after the other; runs wherever Ray puts it."""
    start = time.monotonic()
    at = ""
    try:
        for at in way(open_job(subject, request).stages):
            # A job of its own: what it has looked at is remembered, and changes when a stage is done.
            if is_current(open_job(subject, request), at):
                continue
            reason = run_stage_process(at, subject, request)
            if reason:
                return Outcome(subject, at, reason, time.monotonic() - start)
    except UserError as error:
        return Outcome(subject, at or "settings", str(error), time.monotonic() - start)
    return Outcome(subject, seconds=time.monotonic() - start)


def way(stages: Mapping[str, Stage]) -> list[str]:
    """The stages that the last one needs, upstream first, and itself: what ``doit run`` runs."""
    wanted = {usual(stages)[-1]}
    for name in reversed(list(stages)):
        wanted.update(stages[name].needs if name in wanted else ())
    return [name for name in stages if name in wanted]


def is_current(job: Job, stage: str) -> bool:
    """Whether the store holds the stage's result; what is wrong is left for the stage to report."""
    try:
        return job.is_current(stage)
    except (UserError, OSError):
        return False


def run_batch(subjects: Sequence[str], request: Request) -> list[Outcome]:
    """Runs subjects on a cluster and says on this terminal how it goes.

    Args:
        subjects: who.
        request: the command line's.

    Returns:
        An outcome a subject, in their order.

    Raises:
        UserError: Ray is not installed, there is no such cluster, it cannot give what the preset asks
            for, or an asset cannot be fetched.
    """
    ray = import_ray(request.cluster)
    fetch_assets(subjects, request)
    with connected(ray, request.cluster):
        asked = fitting(ray, resources_of(request))
        each = f"{asked.cpus:g} CPUs and {asked.gpus:g} GPUs"
        print(f"batch: {len(subjects)} subjects, {each} each, {shape(ray)}", flush=True)
        task = ray.remote(
            num_cpus=asked.cpus, num_gpus=asked.gpus, max_retries=RETRIES, scheduling_strategy="SPREAD"
        )(run_subject)
        pending = {task.options(name=subject).remote(subject, request): subject for subject in subjects}
        outcomes = collect(ray, pending)
    ordered = [outcomes[subject] for subject in subjects]
    print("\n".join(["", *summary_lines(ordered)]), flush=True)
    return ordered


def on_loopback(cluster: str) -> bool:
    """Whether the cluster is this machine's own, which is only reached through the loopback interface."""
    address = cluster
    if cluster == "auto":
        known = Path(os.environ.get("RAY_TMPDIR", "/tmp")) / "ray" / "ray_current_cluster"
        address = os.environ.get("RAY_ADDRESS") or (known.read_text() if known.is_file() else "local")
    host = address.removeprefix("ray://").rpartition(":")[0]
    return address == "local" or host in ("localhost", LOCAL, "[::1]")


def import_ray(cluster: str) -> Any:
    """Ray, told to be quiet, and to stay on the loopback interface where the cluster is there.

    Raises:
        UserError: it is not installed.
    """
    if on_loopback(cluster):  # else Ray takes 127.0.0.1 for the machine's address in the network
        os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
    # Ray leaves out lines that several subjects print; here every subject's lines count.
    os.environ.setdefault("RAY_DEDUP_LOGS", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
    except ImportError:
        raise UserError("batch needs Ray, which is not installed: pip install -e '.[cluster]'") from None
    return ray


def fetch_assets(subjects: Sequence[str], request: Request) -> None:
    """Fetches what the subjects need once, before any machine asks for it."""
    workspace = request.workspace
    wanted: set[str] = set()
    for subject in subjects:
        try:
            job = open_job(subject, request)
            wanted.update(name for stage in way(job.stages) for name in job.needed_assets(stage))
        except UserError:
            continue  # the subject itself reports it
    for name in sorted(wanted):
        third_party.fetch(workspace, third_party.find_asset(workspace, name))


@contextlib.contextmanager
def connected(ray: Any, cluster: str) -> Iterator[None]:
    """Joins a cluster, or starts a local one, and leaves it again.

    Raises:
        UserError: there is none at the address, or a local one does not start.
    """
    path = os.pathsep.join(part for part in (str(REPOSITORY), os.environ.get("PYTHONPATH", "")) if part)
    options = {"logging_level": "ERROR", "runtime_env": {"env_vars": {"PYTHONPATH": path}}}
    with contextlib.ExitStack() as stack:
        stack.callback(ray.shutdown)
        if cluster == "local" or not joined(ray, cluster, options):
            stack.enter_context(without_dashboard())
            try:
                ray.init(address="local", include_dashboard=False, _node_ip_address=LOCAL, **options)
            except Exception as error:  # Ray raises bare exceptions
                raise UserError(
                    f"cluster={cluster}: Ray does not start here ({first_line(error)})"
                ) from error
        yield


def joined(ray: Any, address: str, options: Mapping[str, Any]) -> bool:
    """Whether this process is part of the cluster now; false where ``auto`` finds none."""
    try:
        if address != "auto":
            answer(address)
        ray.init(address=address, **options)
    except (OSError, ValueError, RuntimeError) as error:
        if address != "auto":
            raise UserError(f"cluster={address}: there is no Ray cluster ({first_line(error)})") from None
        print("batch: no Ray cluster runs here, so a local one is started", flush=True)
        return False
    return True


def answer(address: str) -> None:
    """Raises an error where nothing listens at HOST:PORT: Ray itself would try for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not host or not port.isdigit():
        raise ValueError("an address is HOST:PORT")
    socket.create_connection((host, int(port)), timeout=10).close()


@contextlib.contextmanager
def without_dashboard() -> Iterator[None]:
    """Lets Ray's processes start here as if the dashboard's packages were not installed.

    Where they are, Ray loads them, and they ask for a newer protobuf than MediaPipe can live with: the
    node then never comes up. Ray does without them when one of them, opencensus, is not there.
    """
    hidden = {name: sys.modules.get(name) for name in ("opencensus", "ray.dashboard.optional_deps")}
    before = os.environ.get("PYTHONPATH")
    with tempfile.TemporaryDirectory(prefix="flexiavatar-ray-") as folder:
        stand_in = "raise ModuleNotFoundError('left out', name='opencensus')\n"
        (Path(folder) / "opencensus.py").write_text(stand_in, encoding="ascii")
        os.environ["PYTHONPATH"] = os.pathsep.join(part for part in (folder, before) if part)
        sys.modules["opencensus"] = None  # type: ignore[assignment]  # an import of it fails
        sys.modules.pop("ray.dashboard.optional_deps", None)
        try:
            yield
        finally:
            os.environ.pop("PYTHONPATH")
            os.environ.update({} if before is None else {"PYTHONPATH": before})
            for name, module in hidden.items():
                sys.modules.pop(name, None)
                sys.modules.update({} if module is None else {name: module})


def fitting(ray: Any, asked: Resources) -> Resources:
    """What is asked for, at most the CPUs of the largest machine.

    Raises:
        UserError: no machine has the GPUs.
    """
    machines = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    cpus = max((one.get("CPU", 0.0) for one in machines), default=0.0)
    gpus = max((one.get("GPU", 0.0) for one in machines), default=0.0)
    if asked.gpus > gpus:
        raise UserError(
            f"the preset asks for {asked.gpus:g} GPUs a subject, no machine of the cluster has more than "
            f"{gpus:g}: choose another preset, or gpus=0 to run on CPUs"
        )
    if asked.cpus > cpus:
        print(f"batch: no machine has {asked.cpus:g} CPUs; each subject is given {cpus:g}")
    return dataclasses.replace(asked, cpus=min(asked.cpus, cpus))


def shape(ray: Any) -> str:
    """The cluster in words."""
    machines = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    cpus, gpus = (sum(one.get(name, 0.0) for one in machines) for name in ("CPU", "GPU"))
    return f"{len(machines)} machine(s) with {cpus:g} CPUs and {gpus:g} GPUs together"


def collect(ray: Any, pending: Mapping[Any, str]) -> dict[str, Outcome]:
    """Waits for all tasks; a line whenever one ends, and now and then what is left."""
    left, outcomes, start = dict(pending), {}, time.monotonic()
    while left:
        done, _ = ray.wait(list(left), num_returns=1, timeout=WAIT_SECONDS)
        for reference in done:
            subject = left.pop(reference)
            outcomes[subject] = outcome = result(ray, reference, subject)
            said = f"failed at {outcome.stage}: {outcome.reason}" if outcome.stage else "done"
            count = f"{len(outcomes)} of {len(pending)}"
            print(f"batch: {count}, {subject} {said} ({outcome.seconds:.0f} s)", flush=True)
        if not done:
            spent = time.monotonic() - start
            guess = f", about {spent / len(outcomes) * len(left):.0f} s left" if outcomes else ""
            print(f"batch: {len(outcomes)} of {len(pending)} after {spent:.0f} s{guess}", flush=True)
    return outcomes


def result(ray: Any, reference: Any, subject: str) -> Outcome:
    """A task's outcome; what Ray could not finish counts as failed."""
    try:
        outcome: Outcome = ray.get(reference)
    except ray.exceptions.RayError as error:
        return Outcome(subject, "cluster", f"Ray gave it up: {first_line(error)}")
    return outcome


def first_line(error: Exception) -> str:
    """The first line of an error's text."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
