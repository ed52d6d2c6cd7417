"""Studies on toy stages: what variants share is made once, failures are named, a killed study goes on."""

import os
import signal
import subprocess
import sys
import time

import pytest

from pipeline.artifact import Store
from pipeline.config.request import parse_request
from pipeline.errors import UserError
from pipeline.job import open_job
from pipeline.studies.explore import seconds_of
from pipeline.studies.knobs import CHANCE, knobs_of
from pipeline.studies.notes import Notes
from pipeline.studies.run import Failure, base_words, run_variants
from pipeline.study import Outcome, Variant
from pipeline.workspace import REPOSITORY

VARIANTS = (
    Variant("base"),
    Variant("longer", {"paint.iterations": "4"}),
    Variant("bent", {"bend.angle": "2"}),
)


def words_of(toy, **more):
    return {"data": str(toy.data), "stages": "tests.pipeline.toy_stages", **more}


def run(toy, variants=VARIANTS, **more):
    said = []
    endings = run_variants("ann", variants, words_of(toy, **more), toy.root / "log.txt", say=said.append)
    return endings, said


def test_what_variants_share_is_made_once_and_never_again(toy):
    endings, said = run(toy)
    assert sorted(toy.ran()) == ["bend:ann"] * 2 + ["gather:ann"] + ["paint:ann"] * 3
    assert [ending.variant for ending in endings] == ["base", "longer", "bent"] and len(said) == 3
    assert endings[0].folders["bend"] == endings[1].folders["bend"] != endings[2].folders["bend"]
    again, _ = run(toy)
    assert toy.ran() == []
    assert [ending.folders for ending in again] == [ending.folders for ending in endings]
    assert all(set(ending.seconds) == {"gather", "bend", "paint"} for ending in again)


def test_a_failing_variant_is_named_and_stops_no_other(toy):
    broken = Variant("broken", {"bend.fail": "user"})
    wrong = Variant("wrong", {"paint.iterations": "many"})
    crashed = Variant("crashed", {"bend.fail": "bug"})
    endings, said = run(toy, (VARIANTS[0], broken, wrong, crashed, VARIANTS[2]))
    assert [type(ending) for ending in endings] == [Outcome, Failure, Failure, Failure, Outcome]
    assert "clip.mp4: is not a clip; name another" in endings[1].reason
    assert "whole number" in endings[2].reason and "ZeroDivisionError" in endings[3].reason
    assert "broken: failed" in said[1]


def test_what_was_in_use_stays_in_use(toy):
    assert toy.doit("subject=ann", "bend.angle=7").returncode == 0
    store = Store(toy.store)
    before = {stage: store.latest("ann", stage).folder for stage in ("gather", "bend", "paint")}
    run(toy)
    assert {stage: store.latest("ann", stage).folder for stage in before} == before


STUDY = """
import sys
from pathlib import Path
from pipeline.studies.run import run_variants
from pipeline.study import Variant
data, log = sys.argv[1:]
words = {"data": data, "stages": "tests.pipeline.toy_stages", "paint.iterations": "40", "paint.rate": "0.05"}
run_variants("ann", [Variant("one"), Variant("two", {"bend.angle": "2"})], words, Path(log))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
def test_a_study_killed_outright_goes_on_where_it_was(toy):
    line = [sys.executable, "-c", STUDY, str(toy.data), str(toy.root / "log.txt")]
    first = subprocess.Popen(line, cwd=REPOSITORY, env=toy.environment(), stdout=subprocess.DEVNULL)
    counts = toy.store / "ann" / "paint"
    deadline = time.monotonic() + 60
    while not any(counts.glob(".*/**/count.txt")) and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(0.3)
    os.kill(first.pid, signal.SIGKILL)
    first.wait()
    time.sleep(0.3)  # the kernel ends the stage's process too
    toy.ran()
    done = subprocess.run(line, cwd=REPOSITORY, env=toy.environment(), capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    assert toy.ran() == ["paint:ann", "bend:ann", "paint:ann"]
    began = [int(line) for line in (toy.data / "began.log").read_text().split()]
    assert began[0] == 0 and began[1] > 0 and began[2] == 0


def test_words_of_a_study_are_the_command_lines_on_top_of_its_scale(toy):
    words = {"subject": "smile", "budget": "3m", "scale": "small", "train.subdivisions": "1"}
    own = base_words("smile", words)
    assert own["train.subdivisions"] == "1" and own["train.iterations"] == "200"
    assert own["train.held_out_every"] == "40" and own["evaluate.turntable_frames"] == "2"
    assert not {"subject", "budget", "scale"} & set(own)
    assert (
        base_words("smile", {**words, "evaluate.turntable_frames": "9"})["evaluate.turntable_frames"] == "9"
    )
    assert base_words("ann", words_of(toy)) == words_of(toy)  # stages without such settings
    assert "dataset" not in base_words("smile", {"dataset": "samples"})
    assert base_words("smile", {"subject": "smile", "dataset": "samples"})["dataset"] == "samples"
    with pytest.raises(UserError, match="scale=huge"):
        base_words("smile", {"scale": "huge"})


@pytest.mark.parametrize("subject", ["smile", "mannequin_head"])
@pytest.mark.parametrize("preset", ["quick", "paper"])
def test_every_level_of_every_knob_can_be_set_and_changes_something(subject, preset):
    base = open_job(subject, parse_request({"preset": preset}, subject))
    knobs = knobs_of(base.settings)
    assert {"iterations", "number of Gaussians", "image size", "fit effort", "precision", "LPIPS"} <= {
        knob.name for knob in knobs
    }
    assert [knob.name for knob in knobs if not knob.combines] == [CHANCE]
    for knob in knobs:
        assert not knob.levels[0].words
        for level in knob.levels[1:]:
            changed = open_job(subject, parse_request({"preset": preset, **level.words}, subject))
            assert changed.settings != base.settings, level.label
            assert level.factor > 0


@pytest.mark.parametrize(
    ("subject", "words"),
    [("smile", {"ingest.long_side": "256"}), ("mannequin_head", {"ingest.mannequin_size": "128"})],
)
def test_a_size_is_asked_for_where_ingest_takes_it_from(subject, words):
    knobs = {knob.name: knob for knob in knobs_of(open_job(subject, parse_request({}, subject)).settings)}
    assert knobs["image size"].levels[1].words == words  # long_side does nothing to what is filmed here


@pytest.mark.parametrize(
    ("words", "own", "others"),
    [
        ({}, "at most one subdivision", "012"),  # the plan may have left none
        ({"plan.subdivision": "on"}, "one subdivision", "02"),
        ({"plan.subdivision": "off"}, "no subdivision", "12"),
        ({"train.subdivisions": "0"}, "no subdivision", "12"),
    ],
)
def test_the_number_of_gaussians_is_turned_whatever_the_plan_says(words, own, others):
    settings = open_job("smile", parse_request(words, "smile")).settings
    levels = {knob.name: knob for knob in knobs_of(settings)}["number of Gaussians"].levels
    assert levels[0].label == own and not levels[0].words
    assert "".join(level.words["train.subdivisions"] for level in levels[1:]) == others
    assert all(level.words["plan.subdivision"] == "on" for level in levels[1:])


@pytest.mark.parametrize(("text", "seconds"), [("90s", 90), ("20m", 1200), ("1.5h", 5400), ("45", 45)])
def test_budgets(text, seconds):
    assert seconds_of(text) == seconds


@pytest.mark.parametrize("text", ["", "soon", "-3m", "0", "m", "nan", "inf"])
def test_no_budgets(text):
    with pytest.raises(UserError, match="no length of time"):
        seconds_of(text)


def test_what_was_noted_is_not_measured_again(tmp_path):
    notes, asked = Notes(tmp_path / "notes"), []

    def measure():
        asked.append(1)
        return {"ms": 2.5, "unknown": float("nan")}

    assert notes.once("a", measure) == notes.once("a", measure) == {"ms": 2.5}
    assert len(asked) == 1
    (tmp_path / "notes" / "a.json").write_text("{")  # cut off
    assert notes.once("a", measure) == {"ms": 2.5} and len(asked) == 2


def test_the_dag_refuses_what_a_study_cannot_be_told(toy):
    for words, hint in (
        (("tradeoff", "subject=ann", "budget=soon"), "no length of time"),
        (("ablate", "subject=ann", "scale=huge"), "there are preset, small"),
        (("ablate", "subject=nobody"), "there is no"),
    ):
        run = toy.doit(*words)
        assert run.returncode != 0
        assert hint in run.stdout + run.stderr and "Traceback" not in run.stdout + run.stderr
    assert toy.ran() == [] and not (toy.data / "studies").exists()
