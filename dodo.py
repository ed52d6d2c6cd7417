"""The DAG: a task a stage, a sub-task a subject. No work is done here, and nothing heavy is imported.

    doit run                                    the main job on the sample subject
    doit run subject=oliver                     all of it for one subject
    doit run fit:oliver                         one stage and what it needs
    doit run subject=me source=clip.mp4         any clip
    doit run subject=smile preset=balanced train.iterations=2000
    doit run -n 2 -P thread subject=smile,carphone
    doit run dataset=insta                      every subject of a dataset
    doit run compare dataset=insta              the paper's table, with what was measured here
    doit run batch dataset=insta cluster=auto   the same on a Ray cluster
    doit run animate subject=oliver motion=dance.bvh    the avatar in a motion that nobody filmed
    doit run animate subject=oliver motion=clip.mp4     in what somebody does in another clip
    doit run view subject=smile                 the avatar in a browser, also while it trains
    doit run ablate subject=smile               what each part of the method is worth
    doit run tradeoff subject=smile budget=20m  what accuracy costs in time

What is stale is decided by the store (``pipeline.run.job``), never by doit's own database, which is not kept.
"""

from __future__ import annotations

import contextlib
import functools
import os
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from doit import get_initial_workdir
from doit.exceptions import InvalidDodoFile, TaskFailed

from pipeline.config import assets as third_party
from pipeline.config.datasets import known_datasets, subjects_of
from pipeline.config.request import Request, parse_request
from pipeline.config.subjects import known_subjects, load_subject
from pipeline.errors import UserError
from pipeline.run.compile_ahead import kernels_ahead, start_compiling
from pipeline.run.doit_reporter import summarising
from pipeline.run.effect import VIEW, check_effect, named_tasks, running, with_what_is_viewed
from pipeline.run.job import (
    Job,
    check_footage,
    check_settings,
    lent_request,
    open_job,
    shown,
    wanted_keys,
)
from pipeline.run.stage import load_stages, usual
from pipeline.run.stage_runner import StageRunner
from pipeline.store.artifact import Store
from pipeline.store.verify import verify

DEFAULT_SUBJECT = "smile"
CARE = ("verify", "prune", VIEW)  # tasks about stored results


def chosen_subjects(request: Request) -> tuple[str, ...]:
    """The subjects that the command line is about."""
    if request.subjects or not request.datasets:
        return request.subjects or (DEFAULT_SUBJECT,)
    named = (one for name in request.datasets for one in subjects_of(request.workspace, name))
    return tuple(dict.fromkeys(named))


def read_command_line() -> tuple[Request, tuple[str, ...]]:
    """The request and its subjects, refused with one line if a name or a value is wrong.

    The NAME=VALUE words are ours; doit itself takes them out of its task names.
    """
    # Relative paths are meant from where the user stands, also with doit -f; outside of doit, from here.
    os.chdir(get_initial_workdir() or Path.cwd())
    try:
        words = [word for word in sys.argv[1:] if "=" in word and not word.startswith("-")]
        request = parse_request(words)
        check_settings(request)
        chosen = chosen_subjects(request)
        if request.source and len(chosen) > 1:
            raise UserError("source= names the footage of one subject; run the subjects one by one")
        for subject in sorted({*request.subjects, *named_subjects(request)} - kept_subjects(request)):
            about = request.about(subject)
            load_subject(request.workspace, subject, about.source, about.dataset)
        stages = load_stages(request.workspace.stages)
        tasks = named_tasks(sys.argv[1:], stages)
        if tasks is not None:
            names = [word.partition("=")[0] for word in words]
            check_effect(request, names, tasks, chosen, stages)
    except UserError as error:
        raise InvalidDodoFile(str(error)) from None
    return request, chosen


def tasks_named() -> list[tuple[str, str]]:
    """The tasks that the command line names: ``fit:oliver`` is ("fit", "oliver")."""
    words = [word.partition(":") for word in sys.argv[1:] if "=" not in word and not word.startswith("-")]
    return [(kind, subject) for kind, _, subject in words]


def named_subjects(request: Request) -> set[str]:
    """The subjects of the tasks that the command line names."""
    kinds = {*load_stages(request.workspace.stages), *CARE}
    return {subject for kind, subject in tasks_named() if kind in kinds and subject and "*" not in subject}


def stored_subjects(request: Request) -> tuple[str, ...]:
    """The subjects that the store holds something of."""
    return Store(request.workspace.artifacts).subjects(load_stages(request.workspace.stages))


def kept_subjects(request: Request) -> set[str]:
    """Those of whom only stored results are asked for: to check and delete these no footage is needed."""
    cares = sys.argv[1:2] == ["clean"] or any(kind in CARE for kind, _ in tasks_named())
    return set(stored_subjects(request)) if cares else set()


def borrowed_clips(request: Request, chosen: tuple[str, ...]) -> dict[str, Request]:
    """The clips that are subjects only because a stage reads them: name -> the request that makes it.

    ``motion=clip.mp4`` is one: its ingest and fit are made first, under the clip's name.
    """
    found = {}
    for kind, named in tasks_named():
        stage = load_stages(request.workspace.stages).get(kind)
        for subject in ([named] if named else chosen) if stage and stage.on_request else ():
            try:
                job = open_job(subject, request)
                loans = stage.demands(job.settings[kind]).loans
            except UserError:
                continue  # the stage itself reports it
            try:
                for loan in loans:
                    check_footage(loan, request)
            except UserError as error:
                raise InvalidDodoFile(str(error)) from None
            found |= {loan.subject: lent_request(loan, request) for loan in loans if loan.source}
    return {subject: its for subject, its in found.items() if subject not in chosen}


REQUEST, CHOSEN = read_command_line()
BORROWED = borrowed_clips(REQUEST, CHOSEN)
WORKSPACE = REQUEST.workspace
STAGES = load_stages(WORKSPACE.stages)
RUNNER = StageRunner(REQUEST, BORROWED)
MADE = {*known_subjects(WORKSPACE), *CHOSEN, *BORROWED}  # what others are lent of these is made first
SUBJECTS = tuple(sorted({*MADE, *stored_subjects(REQUEST)}))
ON_REQUEST = [name for name, stage in STAGES.items() if stage.on_request]
# "doit clean" deletes what the default tasks made: all of it, also what is only made when asked for.
DEFAULT = [usual(STAGES)[-1], *(ON_REQUEST if "clean" in sys.argv[1:2] else ())]

DOIT_CONFIG = {
    "default_tasks": [f"{stage}:{subject}" for stage in DEFAULT for subject in CHOSEN],
    # doit's database lives as long as the run: on disk it would be one more file that a kill, a full disk or
    # a second run at the same time can leave half-written, and doit then asks for it to be deleted.
    "backend": "sqlite3",
    "dep_file": ":memory:",
    "verbosity": 2,
    "reporter": summarising(CHOSEN, list(STAGES)),
    "continue": True,
    "action_string_formatting": "new",
}


@functools.cache
def job_of(subject: str) -> Job:
    """The job of a subject, read when its first task is looked at."""
    return open_job(subject, BORROWED.get(subject, REQUEST))


def is_current(stage: str, subject: str) -> bool:
    """Whether the store holds the stage's result; what is wrong is left for the stage to report."""
    try:
        return job_of(subject).is_current(stage)
    except (UserError, OSError):
        return False


@functools.cache
def compile_once(functions: tuple[str, ...]) -> None:
    """Starts to compile kernels, unless that was done before."""
    start_compiling(functions)


def run_stage(stage: str, subject: str) -> TaskFailed | None:
    """Runs a stage in a process of its own, which writes to this terminal itself.

    Beside it, the kernels of later stages are compiled where they never were, and their code is loaded.
    """
    following: list[str] = []
    with contextlib.suppress(UserError, OSError):  # the stage itself reports it
        asked = running(named_tasks(sys.argv[1:], STAGES) or (), STAGES)
        compile_once(kernels_ahead(job_of(subject), asked, stage))
        if len(CHOSEN) == 1 and stage in asked and subject in CHOSEN:
            later = asked[asked.index(stage) + 1 :]
            following = [STAGES[one].run for one in later if job_of(subject).find(one) is None]
    with ended_in_silence():
        reason = RUNNER.run(stage, subject, following)
    return TaskFailed(reason) if reason else None


@contextlib.contextmanager
def ended_in_silence() -> Iterator[None]:
    """Whoever stops what runs within this by Ctrl-C gets the shell's exit status for it, and no traceback."""
    try:
        yield
    except KeyboardInterrupt:
        raise SystemExit(130) from None


def needed_assets(stage: str, subject: str) -> list[str]:
    """The assets that a stage needs under the subject's settings, its footage's included."""
    try:
        return job_of(subject).needed_assets(stage)
    except UserError:
        return []  # the stage itself reports it


def needed_of_others(stage: str, subject: str) -> list[str]:
    """The tasks whose results of other subjects a stage reads.

    Where nothing but what reads a clip is asked for, the subject's other stages wait for the clip, too: one
    that cannot be used then ends the run before an avatar is trained for it.
    """
    readers = {stage}
    if subject in CHOSEN and BORROWED:
        asked = with_what_is_viewed(REQUEST, named_tasks(sys.argv[1:], STAGES) or ())
        kinds = {task.partition(":")[0] for task in asked}
        readers |= kinds if kinds <= {*ON_REQUEST} else set()
    try:
        loans = [loan for one in readers for loan in STAGES[one].demands(job_of(subject).settings[one]).loans]
    except UserError:
        return []  # the stage itself reports it
    return [f"{loan.stage}:{loan.subject}" for loan in loans if loan.subject in MADE]


def remove_versions(stage: str, subject: str) -> None:
    """Deletes every version of one stage of one subject."""
    folder = Store(WORKSPACE.artifacts).folder(subject, stage)
    if folder.exists():
        print(f"deleting {shown(folder)}")
        shutil.rmtree(folder)


def stage_task(stage: str, subject: str) -> dict:
    """One stage for one subject."""
    return {
        "basename": stage,
        "name": subject,
        "doc": f"{stage} of {subject}",
        "task_dep": [
            *needed_of_others(stage, subject),
            *(f"{upstream}:{subject}" for upstream in STAGES[stage].needs),
            *(f"assets:{name}" for name in needed_assets(stage, subject)),
        ],
        "uptodate": [functools.partial(is_current, stage, subject)],
        "actions": [(run_stage, [stage, subject])],
        "clean": [(remove_versions, [stage, subject])],
    }


def task_stages():
    """A task a stage, a sub-task a subject."""
    for stage in STAGES:
        yield {"basename": stage, "name": None, "doc": f"stage {stage}: a sub-task a subject"}
        # "doit run animate subject=oliver" names the whole group; it is meant for the chosen subjects. Other
        # stages keep the tasks of all subjects, which the stages after them name.
        for subject in CHOSEN if stage in ON_REQUEST and stage in sys.argv[1:] else SUBJECTS:
            yield stage_task(stage, subject)


def fetch_asset(name: str) -> TaskFailed | None:
    """Fetches one asset, with pip's progress on this terminal."""
    try:
        third_party.fetch(WORKSPACE, third_party.find_asset(WORKSPACE, name))
    except UserError as error:
        return TaskFailed(str(error))
    except OSError as error:
        return TaskFailed(f"{WORKSPACE.assets}: {error}; choose another folder: assets=FOLDER")
    return None


def task_assets():
    """Third-party weights and sample clips, fetched once."""
    for name, asset in third_party.load_assets(WORKSPACE).items():
        yield {
            "name": name,
            "doc": asset.title,
            "uptodate": [functools.partial(third_party.is_ready, WORKSPACE, asset)],
            "actions": [(fetch_asset, [name])],
        }


def verify_subject(subject: str) -> TaskFailed | None:
    """Reads every byte of a subject's versions."""
    store = Store(WORKSPACE.artifacts)
    try:
        count = verify(store, subject, STAGES, REQUEST.about(subject), wanted(subject))
    except UserError as error:
        return TaskFailed(str(error))
    print(f"{subject}: {count} version(s) whole")
    return None


def wanted(subject: str) -> dict[str, str]:
    """The keys of the versions that the command line calls for, as far as they can be told."""
    try:
        return wanted_keys(job_of(subject))
    except UserError:
        return {}


def task_verify():
    """Reads every published byte of a subject and compares digests."""
    for subject in SUBJECTS:
        yield {
            "name": subject,
            "doc": f"check every file of {subject}",
            "actions": [(verify_subject, [subject])],
        }


def prune_subject(subject: str) -> None:
    """Deletes the versions of a subject that are not in use."""
    for stage in STAGES:
        for path in Store(WORKSPACE.artifacts).prune(subject, stage):
            print(f"deleted {shown(path)}")


def task_prune():
    """Deletes a subject's versions that are not in use."""
    for subject in SUBJECTS:
        yield {
            "name": subject,
            "doc": f"keep only {subject}'s latest versions",
            "actions": [(prune_subject, [subject])],
        }


def view_subject() -> TaskFailed | None:
    """Shows the chosen subject's avatar until it is told to stop."""
    if len(CHOSEN) > 1:
        return TaskFailed("view shows one subject: name one, subject=NAME")
    from pipeline.viewer.view import view

    try:
        view(CHOSEN[0], REQUEST)
    except (UserError, OSError) as error:
        return TaskFailed(str(error))
    return None


def task_view():
    """The avatar in a browser, to be turned and moved: subject=, motion=, port=, host=."""
    moved = "animate.motion" in REQUEST.overrides
    return {
        "actions": [(view_subject, [])],
        "task_dep": [f"animate:{subject}" for subject in CHOSEN] if moved else [],
    }


def run_studies(studies: Iterable[Callable[[Request], object]]) -> TaskFailed | None:
    """Makes studies one after the other; one that fails does not stop the others."""
    reasons = []
    for study in studies:
        try:
            with ended_in_silence():
                study(REQUEST)
        except (UserError, OSError) as error:
            reasons.append(str(error))
    return TaskFailed("; ".join(reasons)) if reasons else None


def compare_datasets() -> TaskFailed | None:
    """Makes the tables of the chosen datasets."""
    from pipeline.studies.compare import compare

    if not REQUEST.datasets:
        known = ", ".join(known_datasets(WORKSPACE))
        return TaskFailed(f"compare needs a dataset: doit run compare dataset=NAME; there are {known}")
    return run_studies(functools.partial(compare, name) for name in REQUEST.datasets)


def task_compare():
    """The paper's table of a dataset, with what was measured here beside it."""
    return {"actions": [(compare_datasets, [])]}


def batch_subjects() -> TaskFailed | None:
    """Runs the chosen subjects on a Ray cluster."""
    from pipeline.run.ray_batch import run_batch

    try:
        outcomes = run_batch(CHOSEN, REQUEST)
    except (UserError, OSError) as error:
        return TaskFailed(str(error))
    failed = [one.subject for one in outcomes if one.stage]
    return TaskFailed(f"failed: {', '.join(failed)}") if failed else None


def task_batch():
    """Many subjects at once on a Ray cluster: cluster=auto, local or an address."""
    return {"actions": [(batch_subjects, [])]}


def ablate_subjects() -> TaskFailed | None:
    """Makes the ablation of each dataset, or of each subject."""
    from pipeline.studies.ablation import ablate

    named = () if REQUEST.subjects else REQUEST.datasets
    groups = {name: subjects_of(WORKSPACE, name) for name in named} or {one: (one,) for one in CHOSEN}
    return run_studies(functools.partial(ablate, name, group) for name, group in groups.items())


def tradeoff_subjects() -> TaskFailed | None:
    """Makes the study of what accuracy costs of each subject."""
    from pipeline.studies.tradeoff import tradeoff

    return run_studies(functools.partial(tradeoff, subject) for subject in CHOSEN)


def studied_assets() -> list[str]:
    """The tasks that fetch what the chosen subjects' stages need, and what studies measure with."""
    needed = {
        "lpips",
        *(asset for subject in CHOSEN for stage in STAGES for asset in needed_assets(stage, subject)),
    }
    return [f"assets:{name}" for name in sorted(needed & set(third_party.load_assets(WORKSPACE)))]


def task_ablate():
    """The paper's ablation tables of a subject or a dataset."""
    return {"actions": [(ablate_subjects, [])], "task_dep": studied_assets()}


def task_tradeoff():
    """What accuracy costs in time: budget=20m, and any settings to start from."""
    return {"actions": [(tradeoff_subjects, [])], "task_dep": studied_assets()}
