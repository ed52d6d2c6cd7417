"""doit on top of the store, as a user drives it, with toy stages."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest

from pipeline.config.workspace import REPOSITORY


def test_a_run_makes_every_stage_and_a_second_run_makes_none(toy):
    first = toy.doit("subject=ann")
    assert first.returncode == 0, first.stderr
    assert toy.ran() == ["gather:ann", "bend:ann", "paint:ann"]
    assert (toy.store / "ann" / "paint" / "latest" / "painted.txt").read_text() == "ann 1.0" * 3
    assert toy.doit("subject=ann").returncode == 0
    assert toy.ran() == []


@pytest.mark.slow
def test_two_subjects_at_once(toy):
    assert toy.doit("subject=ann,bob", options=("-n", "2", "-P", "thread")).returncode == 0
    assert sorted(toy.ran()) == sorted(
        f"{stage}:{name}" for stage in ("gather", "bend", "paint") for name in ("ann", "bob")
    )


def test_one_stage_and_what_it_needs_for_any_known_subject(toy):
    assert toy.doit("bend:bob").returncode == 0
    assert toy.ran() == ["gather:bob", "bend:bob"]


def test_any_clip_without_a_file_to_write_first(toy):
    clip = toy.root / "clip.txt"
    clip.write_text("me ")
    assert toy.doit("subject=me", f"source={clip}").returncode == 0
    assert toy.ran() == ["gather:me", "bend:me", "paint:me"]


def test_a_changed_setting_reruns_its_stage_and_what_follows_and_changing_back_runs_nothing(made):
    made.doit("subject=ann", "bend.angle=2")
    assert made.ran() == ["bend:ann", "paint:ann"]
    assert (made.store / "ann" / "paint" / "latest" / "painted.txt").read_text() == "ann 2.0" * 3
    made.doit("subject=ann")
    assert made.ran() == []
    assert (made.store / "ann" / "paint" / "latest" / "painted.txt").read_text() == "ann 1.0" * 3
    assert len(made.published("bend", "ann")) == 2


def test_a_changed_setting_of_the_last_stage_reruns_it_alone(made):
    made.doit("subject=ann", "paint.iterations=5")
    assert made.ran() == ["paint:ann"]


def test_an_upstream_rerun_whose_output_is_unchanged_stops_there(made):
    made.doit("subject=ann", "gather.unused=9")
    assert made.ran() == ["gather:ann"]


def test_changed_footage_reruns_everything(made):
    (made.data / "sources" / "ann.txt").write_text("anna ")
    made.doit("subject=ann")
    assert made.ran() == ["gather:ann", "bend:ann", "paint:ann"]


def test_the_state_that_doit_keeps_may_be_lost(made):
    (made.root / ".doit.json").unlink(missing_ok=True)
    made.doit("subject=ann")
    assert made.ran() == []


def test_presets_datasets_subjects_and_the_command_line_in_this_order(toy):
    toy.subject("cat", 'dataset = "pair"\n[source]\npath = "sources/ann.txt"\n[paint]\niterations = 2\n')

    def settings(stage):
        return json.loads((toy.store / "cat" / stage / "latest" / "manifest.json").read_text())["settings"]

    toy.doit("subject=cat", "preset=balanced")
    assert settings("paint")["iterations"] == 2  # the subject's wins over the preset's 7
    assert settings("bend")["angle"] == 5.0  # the dataset's
    toy.doit("subject=cat", "preset=balanced", "bend.angle=6", "paint.iterations=4")
    assert (settings("bend")["angle"], settings("paint")["iterations"]) == (6.0, 4)


def test_a_misspelt_name_is_an_error_that_shows_the_near_ones(toy):
    for words, near in (
        (("subject=ann", "paint.iteration=5"), "paint.iterations"),
        (("subject=ann", "pain.iterations=5"), "paint"),
        (("subjec=ann",), "subject"),
        (("subject=an",), "ann"),
        (("subject=ann", "preset=balancd"), "balanced"),
    ):
        run = toy.doit(*words)
        assert run.returncode != 0
        message = run.stderr.strip()
        assert near in message.split("did you mean")[1] and "Traceback" not in message, message
    assert toy.ran() == []


def test_a_value_that_does_not_fit_is_refused_before_anything_runs(toy):
    for word, hint in (
        ("paint.iterations=many", "whole number"),
        ("paint.iterations=0", "whole number from 1 to"),
        ("gather.upper=perhaps", "true or false"),
    ):
        run = toy.doit("subject=ann", word)
        assert run.returncode != 0 and hint in run.stderr and "Traceback" not in run.stderr
    assert toy.ran() == []


def test_an_error_of_the_users_is_one_line_and_publishes_nothing(toy):
    run = toy.doit("subject=ann", "bend.fail=user")
    assert run.returncode != 0
    assert "clip.mp4: is not a clip; name another" in run.stderr and "Traceback" not in run.stderr
    assert toy.published("bend", "ann") == []


def test_one_failing_subject_does_not_stop_the_others(toy):
    toy.subject("cat", '[source]\npath = "sources/ann.txt"\n[bend]\nfail = "user"\n')
    assert toy.doit("subject=cat,bob").returncode != 0
    assert "paint:bob" in toy.ran()


def test_a_full_disk_is_one_line_and_publishes_nothing(toy):
    run = toy.doit("subject=ann", "bend.fail=disk")
    assert run.returncode != 0
    assert "the disk is full" in run.stderr and "half.txt" in run.stderr and "Traceback" not in run.stderr
    assert toy.published("bend", "ann") == []


def test_a_defect_of_ours_keeps_its_traceback_and_publishes_nothing(toy):
    run = toy.doit("subject=ann", "bend.fail=bug")
    assert run.returncode != 0 and "ZeroDivisionError" in run.stderr
    assert toy.published("bend", "ann") == []


def test_missing_footage_says_what_to_fetch_and_names_a_subject_that_runs(toy):
    toy.subject("cat", '[source]\npath = "sources/cat.txt"\nobtain = "take it from the cat"\n')
    run = toy.doit("subject=cat")
    assert run.returncode != 0
    assert (
        "take it from the cat" in run.stderr
        and "subject=smile" in run.stderr
        and "Traceback" not in run.stderr
    )


@pytest.mark.slow
def test_a_killed_stage_goes_on_where_it_was(toy):
    toy.doit("bend:ann")
    killed = toy.stage("paint", "ann", "paint.iterations=40", "paint.rate=0.05")
    count = None
    for _ in range(200):
        time.sleep(0.05)
        found = list((toy.store / "ann" / "paint").glob(".scratch-*/work/count.txt"))
        count = int(found[0].read_text() or 0) if found else 0
        if count >= 3:
            break
    os.kill(killed.pid, signal.SIGKILL)
    killed.communicate()
    assert toy.published("paint", "ann") == [] and count >= 3
    again = toy.stage("paint", "ann", "paint.iterations=40", "paint.rate=0.05")
    assert again.communicate() and again.returncode == 0
    began = [int(line) for line in (toy.data / "began.log").read_text().split()]
    assert began[0] == 0 and began[1] >= 3
    painted = (toy.store / "ann" / "paint" / "latest" / "painted.txt").read_text()
    assert painted == "ann 1.0" * 40
    assert not list((toy.store / "ann" / "paint").glob(".scratch-*"))


def test_ctrl_c_ends_a_run_without_a_traceback_and_it_goes_on(toy):
    words = ("subject=ann", "paint.iterations=60", "paint.rate=0.1")
    line = [sys.executable, "-m", "doit", "run", *toy.words(), *words]
    run = subprocess.Popen(
        line, cwd=REPOSITORY, env=toy.environment(), start_new_session=True, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    while not list((toy.store / "ann" / "paint").glob(".scratch-*/work/count.txt")):
        assert run.poll() is None
        time.sleep(0.05)
    os.killpg(run.pid, signal.SIGINT)  # the terminal sends it to all
    _, said = run.communicate(timeout=20)
    assert run.returncode == 130 and "Traceback" not in said
    assert "paint:ann stopped; the same command goes on from here" in said
    assert toy.doit(*words[:1], "paint.iterations=60", "paint.rate=0.001").returncode == 0


def test_two_runs_of_the_same_stage_at_once_make_one_version(toy):
    toy.doit("bend:ann")
    toy.ran()
    both = [toy.stage("paint", "ann", "paint.iterations=10", "paint.rate=0.05") for _ in range(2)]
    assert [process.wait() for process in both] == [0, 0]
    for process in both:
        process.communicate()
    assert toy.ran() == ["paint:ann"]
    assert len(toy.published("paint", "ann")) == 1


def test_list_and_clean(toy):
    listing = toy.doit(command="list", options=("--all",))
    assert listing.returncode == 0 and "bend:ann" in listing.stdout and "paint:bob" in listing.stdout
    toy.doit("subject=ann,bob")
    toy.doit("subject=ann", command="clean")
    assert not (toy.store / "ann" / "paint").exists() and not (toy.store / "ann" / "gather").exists()
    assert (toy.store / "bob" / "paint" / "latest").exists()


def test_verify_finds_a_flipped_bit_and_names_the_stage_to_rerun(made):
    assert made.doit("verify:ann").returncode == 0
    file = made.store / "ann" / "bend" / "latest" / "bent.txt"
    content = bytearray(file.read_bytes())
    content[0] ^= 1
    file.write_bytes(content)
    run = made.doit("verify:ann")
    said = run.stdout + run.stderr
    assert run.returncode != 0 and "bent.txt" in said and "doit run bend:ann" in said


def test_prune_keeps_the_version_in_use(made):
    made.doit("subject=ann", "bend.angle=2")
    assert made.doit("prune:ann").returncode == 0
    assert len(made.published("bend", "ann")) == 1
    made.ran()
    made.doit("subject=ann", "bend.angle=2")
    assert made.ran() == []


def test_a_file_that_a_setting_names_is_known_by_its_content(toy):
    extra = toy.root / "extra.txt"
    extra.write_text("one ")
    toy.doit("gather:ann", f"gather.extra={extra}")
    toy.ran()
    toy.doit("gather:ann", f"gather.extra={extra}")
    assert toy.ran() == []
    extra.write_text("two ")
    toy.doit("gather:ann", f"gather.extra={extra}")
    assert toy.ran() == ["gather:ann"]


def test_a_subject_that_is_made_up_needs_no_footage(toy):
    toy.subject("doll", 'title = "doll"\n[gather]\nmade_up = "doll "\n')
    assert toy.doit("subject=doll").returncode == 0
    assert (toy.store / "doll" / "gather" / "latest" / "text.txt").read_text() == "doll "
    toy.subject("nothing", 'title = "no footage named"\n')
    run = toy.doit("subject=nothing")
    assert run.returncode != 0 and "source=CLIP.mp4" in run.stderr and "Traceback" not in run.stderr
