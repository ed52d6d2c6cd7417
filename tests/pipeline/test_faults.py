"""What can happen to a run: it is killed, runs twice at once, finds its clock set back."""

import itertools
import json
import os
import signal
import subprocess
import sys
import time

import pytest

from pipeline.__main__ import main
from pipeline.config.workspace import REPOSITORY
from pipeline.run.job import open_job, run_stage
from pipeline.run.ray_batch import run_subject
from pipeline.store.artifact import LATEST, Store
from pipeline.store.verify import damages
from tests.faults.runs import alive

STAGES = ("gather", "bend", "paint")
LINUX = pytest.mark.skipif(sys.platform != "linux", reason="how Linux ends and watches processes")


def start(toy, *words):
    """``doit run``, started in a session of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "doit", "run", *toy.words(), *words], cwd=REPOSITORY, env=toy.environment(),
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
    )  # fmt: skip


def wait_until(there, seconds=60.0):
    until = time.monotonic() + seconds
    while not there():
        assert time.monotonic() < until, "it never came"
        time.sleep(0.01)


def painting(toy, subject="ann"):
    """Whether the last stage is in its middle."""
    return any(
        int(path.read_text() or 0) >= 3
        for path in (toy.store / subject / "paint").glob(".scratch-*/work/count.txt")
    )


def hidden(toy, subject="ann"):
    """What lies beside the versions, locks aside."""
    entries = (toy.store / subject).glob("*/.*")
    return sorted(entry.name for entry in entries if not entry.name.startswith(".lock-"))


def make(toy, stage, *words):
    return run_stage(open_job("ann", toy.request(*words)), stage)


# Kills


@pytest.mark.slow
@LINUX
def test_a_stage_does_not_outlive_the_doit_that_was_killed(toy):
    words = ("subject=ann", "paint.iterations=40", "paint.rate=0.05")
    run = start(toy, *words)
    wait_until(lambda: painting(toy))
    os.kill(run.pid, signal.SIGKILL)
    wait_until(lambda: not alive(run.pid), seconds=10)
    run.communicate()
    assert toy.published("paint", "ann") == []
    again = toy.doit(*words)
    assert again.returncode == 0, again.stderr
    assert (toy.store / "ann" / "paint" / LATEST / "painted.txt").read_text() == "ann 1.0" * 40
    began = [int(line) for line in (toy.data / "began.log").read_text().split()]
    assert len(began) == 2 and began[1] >= 3  # it went on, and nobody else was at it


def test_a_run_killed_between_publishing_and_latest_is_put_right_by_the_same_command(toy, monkeypatch):
    make(toy, "gather")

    def killed(store, artifact):
        raise SystemExit("kill -9")

    with monkeypatch.context() as patch, pytest.raises(SystemExit):
        patch.setattr(Store, "select", killed)
        make(toy, "bend")
    folder = toy.store / "ann" / "bend"
    assert len(toy.published("bend", "ann")) == 1 and not (folder / LATEST).exists()
    assert [name[:9] for name in hidden(toy)] == [".scratch-"]
    toy.ran()
    assert toy.doit("bend:ann").returncode == 0
    assert toy.ran() == [] and hidden(toy) == []
    assert (folder / LATEST / "bent.txt").read_text() == "ann 1.0"


def test_a_subject_that_the_system_kills_does_not_stop_the_others(toy):
    toy.subject("cat", '[source]\npath = "sources/ann.txt"\n[bend]\nfail = "killed"\n')
    run = toy.doit("subject=cat,bob")
    assert run.returncode != 0 and "paint:bob" in toy.ran()
    last = run.stdout.strip().splitlines()[-3:]
    assert last[0] == "1 of 2 subjects done, 1 failed" and last[2].split() == ["bob", "done"]
    assert "cat  failed at bend: killed by signal 9 (SIGKILL)" in last[1] and "memory runs out" in last[1]


def test_a_batch_goes_on_without_a_subject_that_the_system_kills(toy):
    outcome = run_subject("ann", toy.request("bend.fail=killed"))  # what Ray runs, wherever it is put
    assert outcome.stage == "bend" and "killed by signal 9 (SIGKILL)" in outcome.reason
    assert run_subject("ann", toy.request()).stage == ""
    assert toy.ran() == ["gather:ann", "bend:ann", "bend:ann", "paint:ann"]


def test_memory_that_runs_out_in_a_stage_is_one_line(toy):
    run = toy.doit("subject=ann", "bend.fail=memory")
    assert run.returncode != 0 and "memory ran out" in run.stderr and "Traceback" not in run.stderr


def test_a_dangling_latest_is_put_right(made):
    link = made.store / "ann" / "paint" / LATEST
    version = os.readlink(link)
    link.unlink()
    link.symlink_to("0000000000000000")
    assert Store(made.store).latest("ann", "paint") is None
    made.ran()
    assert made.doit("subject=ann").returncode == 0 and made.ran() == []
    assert os.readlink(link) == version


def test_a_latest_that_is_no_link_is_named(toy):
    toy.doit("gather:ann")
    link = toy.store / "ann" / "gather" / LATEST
    link.unlink()
    link.mkdir()
    run = toy.doit("gather:ann")
    assert run.returncode != 0 and f"{link}: is not a link" in run.stderr and "Traceback" not in run.stderr


def test_what_killed_runs_left_is_pruned(made):
    folder = made.store / "ann" / "bend"
    (folder / ".latest-1a2b").symlink_to(os.readlink(folder / LATEST))
    (folder / ".latest-3c4d").symlink_to("0000000000000000")
    (folder / ".damaged-0-1").mkdir()
    (folder / ".scratch-0").mkdir()
    assert made.doit("prune:ann").returncode == 0
    assert hidden(made) == [] and len(made.published("bend", "ann")) == 1


# Two at once


@pytest.mark.slow
def test_the_same_subject_twice_at_once(toy):
    words = ("subject=ann", "paint.iterations=40", "paint.rate=0.05")
    both = [start(toy, *words) for _ in range(2)]
    said = [process.communicate(timeout=120)[0] for process in both]
    assert [process.returncode for process in both] == [0, 0], said
    assert sorted(toy.ran()) == sorted(f"{stage}:ann" for stage in STAGES)  # each was made once
    assert any("another process is making the same result; waiting for it" in text for text in said)
    assert (toy.store / "ann" / "paint" / LATEST / "painted.txt").read_text() == "ann 1.0" * 40
    assert damages(Store(toy.store), "ann", STAGES) == [] and hidden(toy) == []


@pytest.mark.slow
def test_two_runs_share_no_file_that_one_could_find_half_written(toy):
    assert toy.doit("subject=ann").returncode == 0
    beside = {path.name for path in toy.root.iterdir()} | {path.name for path in toy.data.iterdir()}
    assert not [name for name in beside if name.startswith(".doit")]


# Clocks


def set_times(root, seconds):
    for path in root.rglob("*"):
        os.utime(path, (seconds, seconds), follow_symlinks=False)


def test_nothing_is_stale_by_its_times(made):
    for moment in (4102444800, 86400):  # the year 2100, and 1970
        set_times(made.data, moment)
        assert made.doit("subject=ann").returncode == 0 and made.ran() == []
    (made.data / "sources" / "ann.txt").write_text("eve ")  # of the same size
    set_times(made.data, 86400)
    assert made.doit("subject=ann").returncode == 0
    assert made.ran() == ["gather:ann", "bend:ann", "paint:ann"]


def test_seconds_are_right_though_the_clock_is_set_back(toy, monkeypatch):
    moments = itertools.count(2_000_000_000, -1_000_000)
    monkeypatch.setattr(time, "time", lambda: float(next(moments)))
    artifact = make(toy, "gather")
    record = json.loads((artifact.folder / "run.json").read_text())
    assert 0 <= record["seconds"] < 60 and record["cpu_seconds"] >= 0


def test_a_stage_says_what_is_wrong_with_its_store(toy, monkeypatch, capsys):
    def refuse(*arguments, **options):
        raise OSError(30, "Read-only file system", str(toy.store / "ann"))

    monkeypatch.setattr("pathlib.Path.mkdir", refuse)
    assert main(["gather", "--subject", "ann", *toy.words()]) == 1
    said = capsys.readouterr().err
    assert f"{toy.store / 'ann'}: cannot be written (Read-only file system)" in said
    assert "artifacts=FOLDER" in said
