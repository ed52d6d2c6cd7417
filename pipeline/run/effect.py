"""Words on the command line that would do nothing, or name what is not there: refused before anything runs.

A word acts on the tasks that are asked for. ``source=`` is the footage of a subject that ``subject=`` names,
a setting belongs to a stage that runs, and ``cluster=`` to a study that runs on one. What a stage cannot use
under its other settings it declares itself (``Stage.idle``).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from pipeline.config.request import Request
from pipeline.config.subjects import Subject, known_subjects
from pipeline.errors import UserError
from pipeline.run.job import Job, open_job
from pipeline.run.stage import Stage, upstream_first, usual

STUDIES = ("batch", "ablate", "tradeoff", "compare")
"""Tasks that run all usual stages, of the chosen subjects."""

VIEW = "view"
"""The task that shows an avatar; with ``motion=`` it shows what animate made of that."""

_OF_TASKS = {
    "cluster": ("batch",), "cpus": ("batch",), "gpus": ("batch",), "budget": ("tradeoff",),
    "scale": ("ablate", "tradeoff"), "port": ("view",), "host": ("view",),
}  # fmt: skip


def named_tasks(words: Sequence[str], stages: Collection[str]) -> list[str] | None:
    """The tasks that ``doit run``'s words name, options left out; empty: the default ones.

    Returns:
        None where another command than run is given, which is about no words of ours.
    """
    plain = [word for word in words if "=" not in word and not word.startswith("-")]
    known = {*stages, *STUDIES, VIEW, "verify", "prune", "assets"}
    tasks = [word for word in plain if word.partition(":")[0] in known]
    if plain and plain[0] != "run" and plain[0] not in tasks:
        return None
    return tasks


def check_effect(
    request: Request,
    words: Collection[str],
    tasks: Sequence[str],
    chosen: Sequence[str],
    stages: Mapping[str, Stage],
) -> None:
    """Refuse a word that does nothing.

    Args:
        request: the command line.
        words: the names that stand on it, also with their defaults.
        tasks: those that it names, such as ``fit`` or ``fit:oliver``; empty: the default ones.
        chosen: the subjects that it is about.
        stages: all, upstream first.

    Raises:
        UserError: says which, and what to write.
    """
    _check_footage(request, tasks)
    _check_subjects(request, tasks, stages)
    _check_study_words(words, tasks)
    tasks = with_what_is_viewed(request, tasks)
    _check_stages(request, tasks, chosen, stages)
    run = running(tasks, stages)
    if not request.overrides and request.source is None:
        return
    for subject in subjects_of_tasks(tasks, chosen):
        try:
            job = open_job(subject, request)
        except UserError:
            continue  # the stage itself reports it
        check_settings_act(job, run)
        check_paths_exist(job, run)


def with_what_is_viewed(request: Request, tasks: Sequence[str]) -> list[str]:
    """The tasks, with animate for view where a motion is to be seen: it is made first."""
    moved = "animate.motion" in request.overrides
    return ["animate" if task == VIEW and moved else task for task in tasks]


def subjects_of_tasks(tasks: Sequence[str], chosen: Sequence[str]) -> list[str]:
    """The subjects that tasks are about: those they name, and the chosen ones where one names none."""
    named = [task.partition(":")[2] for task in tasks if ":" in task and not task.startswith("assets:")]
    return list(dict.fromkeys([*named, *(() if tasks and len(named) == len(tasks) else chosen)]))


def _check_footage(request: Request, tasks: Sequence[str]) -> None:
    if request.source is None or request.subjects:
        return
    named = sorted({task.partition(":")[2] for task in tasks} - {""})
    name = named[0] if len(named) == 1 else "NAME"
    raise UserError(
        f"source={request.source} is the footage of a subject and none is named: add subject={name}"
    )


def _check_subjects(request: Request, tasks: Sequence[str], stages: Mapping[str, Stage]) -> None:
    """``subject=`` and ``dataset=`` beside tasks that say themselves whom they are about."""
    words = [f"subject={name}" for name in request.subjects]
    words += [f"dataset={name}" for name in request.datasets]
    own = [task for task in tasks if ":" in task and not task.startswith("assets:")]
    for task in tasks:
        base = task.partition(":")[0]
        if words and task in stages and not stages[task].on_request:
            whom = request.subjects[0] if request.subjects else "SUBJECT"
            raise UserError(
                f"{words[0]} has no effect on '{task}', which means every subject: write {base}:{whom}"
            )
    if not own or len(own) < len(tasks):
        return
    about = {task.partition(":")[2] for task in own}
    idle = [name for name in request.subjects if name not in about]
    if idle:
        base = own[0].partition(":")[0]
        raise UserError(f"subject={idle[0]} has no effect on {', '.join(own)}: write {base}:{idle[0]}")
    if request.datasets and not request.subjects:
        subject = sorted(about)[0]
        on = ", ".join(own)
        raise UserError(f"{words[0]} has no effect on {on}: add subject={subject}, or leave it out")


def _check_study_words(words: Collection[str], tasks: Sequence[str]) -> None:
    for word, users in _OF_TASKS.items():
        if word in words and not set(users) & set(tasks):
            raise UserError(
                f"{word}= has no effect but on {' and '.join(users)}: doit run {users[0]} {word}=..."
            )


def running(tasks: Sequence[str], stages: Mapping[str, Stage]) -> list[str]:
    """The stages that some tasks run or look at, upstream first."""
    wanted: set[str] = set() if tasks else {usual(stages)[-1]}
    for task in tasks:
        base = task.partition(":")[0]
        if base in stages:
            wanted.add(base)
        elif base in STUDIES:
            wanted.update(usual(stages))
        elif base == "verify":
            wanted.update(stages)
    return upstream_first(stages, wanted)


def _check_stages(
    request: Request, tasks: Sequence[str], chosen: Sequence[str], stages: Mapping[str, Stage]
) -> None:
    run, who = running(tasks, stages), chosen[0] if chosen else "SUBJECT"
    for setting, value in request.overrides.items():
        stage, _, name = setting.partition(".")
        if stage in run or stage not in stages:
            continue
        asked = f"{stage} subject={who}" if stages[stage].on_request else f"{stage}:{who}"
        word = name if name in stages[stage].words else setting
        what, words = ", ".join(run) if run else "no stage", f"doit run {asked} {word}={value}"
        raise UserError(f"{word}={value} has no effect, for this runs {what}: {words}")


def check_settings_act(job: Job, run: Collection[str]) -> None:
    """Refuse what the command line says of a stage that cannot use it under its other settings."""
    subject: Subject = job.subject
    for name in run:
        stage, settings = job.stages[name], job.settings[name]
        if stage.idle is None:
            continue
        for setting, remedy in stage.idle(settings).items():
            if f"{name}.{setting}" in job.request.overrides:
                raise UserError(f"{name}.{setting} has no effect on '{subject.name}': {remedy}")
    made_up = run and not any(job.stages[name].demands(job.settings[name]).source for name in run)
    # A subject without a file must be given footage, even if its settings then make it up.
    if job.request.source is not None and made_up and subject.name in known_subjects(job.workspace):
        raise UserError(
            f"source={job.request.source} has no effect on '{subject.name}', which is made up and not filmed "
            "(ingest.mannequin): name another subject"
        )


def check_paths_exist(job: Job, run: Collection[str]) -> None:
    """Refuse a file or folder that the command line names for a stage and that is not there.

    The stage would say so itself, the last of them after the avatar was trained. Stages on request take
    more than paths.
    """
    for name in run:
        if job.stages[name].on_request:
            continue
        for setting in job.stages[name].path_settings:
            value = getattr(job.settings[name], setting)
            named = f"{name}.{setting}" in job.request.overrides and ("/" in value or Path(value).suffix)
            if named and not Path(value).exists():
                raise UserError(f"{name}.{setting}={value}: there is no such file or folder")
