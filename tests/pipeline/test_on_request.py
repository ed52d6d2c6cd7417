"""A stage that is run only by its name, and what it borrows of another subject."""

import pytest

from pipeline.config.request import parse_request
from pipeline.config.settings import as_dict
from pipeline.errors import UserError
from pipeline.run.job import key_of, open_job
from pipeline.run.stage import load_stages, usual


def song(toy, subject):
    return (toy.store / subject / "sing" / "latest" / "song.txt").read_text()


def test_what_is_run_unasked_leaves_it_out(toy):
    assert list(usual(load_stages("tests.pipeline.toy_stages"))) == ["gather", "bend", "paint"]
    assert list(usual(load_stages()))[-1] == "evaluate" and "animate" not in usual(load_stages())
    assert toy.doit("subject=ann").returncode == 0
    assert toy.ran() == ["gather:ann", "bend:ann", "paint:ann"]
    listing = toy.doit(command="list", options=("--all",)).stdout
    assert "sing:ann" in listing and "sing:bob" in listing


def test_its_name_alone_means_the_chosen_subjects_and_only_what_it_needs(toy):
    assert toy.doit("sing", "subject=ann").returncode == 0
    assert toy.ran() == ["gather:ann", "bend:ann", "sing:ann"] and song(toy, "ann") == "ann 1.0hum"
    assert toy.doit("sing:bob").returncode == 0
    assert toy.ran() == ["gather:bob", "bend:bob", "sing:bob"]


def test_its_result_is_known_by_the_content_of_the_file_that_drives_it(toy):
    tune = toy.root / "tune.txt"
    tune.write_text("la")
    toy.doit("sing", "subject=ann", f"tune={tune}")
    toy.ran()
    toy.doit("sing", "subject=ann", f"tune={tune}")
    assert toy.ran() == [] and song(toy, "ann") == "ann 1.0la"
    tune.write_text("lu")
    toy.doit("sing", "subject=ann", f"tune={tune}")
    assert toy.ran() == ["sing:ann"] and song(toy, "ann") == "ann 1.0lu"
    assert toy.doit("subject=ann").returncode == 0
    assert toy.ran() == ["paint:ann"]


@pytest.mark.slow
def test_what_another_subject_made_is_made_first_and_known_by_its_content(toy):
    words = ("sing", "subject=ann", "tune=subject:bob")
    assert toy.doit(*words).returncode == 0
    assert sorted(toy.ran()) == ["bend:ann", "bend:bob", "gather:ann", "gather:bob", "sing:ann"]
    assert song(toy, "ann") == "ann 1.0bob 1.0"
    toy.doit(*words)
    assert toy.ran() == []
    (toy.data / "sources" / "bob.txt").write_text("rob ")
    toy.doit(*words)
    assert toy.ran() == ["gather:bob", "bend:bob", "sing:ann"] and song(toy, "ann") == "ann 1.0rob 1.0"


def test_a_subject_whose_footage_is_gone_lends_what_the_store_has(toy):
    clip = toy.root / "clip.txt"
    clip.write_text("me ")
    toy.doit("bend:me", "subject=me", f"source={clip}")
    toy.ran()
    run = toy.doit("sing", "subject=ann", "tune=subject:me")
    assert run.returncode == 0, run.stderr
    assert song(toy, "ann") == "ann 1.0me 1.0"
    run = toy.doit("sing", "subject=ann", "tune=subject:nobody")
    assert run.returncode != 0 and "nobody" in run.stderr and "Traceback" not in run.stderr


@pytest.mark.slow
def test_a_clip_that_is_named_is_made_a_subject_of_its_own(toy):
    clip = toy.root / "dance.txt"
    clip.write_text("jig ")
    words = ("sing", "subject=ann", f"tune=clip:{clip}")
    run = toy.doit(*words)
    assert run.returncode == 0, run.stderr
    assert sorted(toy.ran()) == ["bend:ann", "bend:dance", "gather:ann", "gather:dance", "sing:ann"]
    assert song(toy, "ann") == "ann 1.0jig 1.0"
    assert toy.doit(*words).returncode == 0 and toy.ran() == []
    assert toy.doit("sing:ann", f"tune=clip:{clip}").returncode == 0 and toy.ran() == []
    assert not (toy.store / "dance" / "paint").exists()


@pytest.mark.slow
def test_a_clip_with_a_subjects_name_and_other_footage_is_refused(toy):
    for name, known in (("bob", "there is a subject 'bob'"), ("dance", "the store's 'dance'")):
        clip = toy.root / "first" / f"{name}.txt"
        clip.parent.mkdir(exist_ok=True)
        clip.write_text("jig ")
        if name == "dance":
            assert toy.doit("sing", "subject=ann", f"tune=clip:{clip}").returncode == 0
            clip.write_text("reel ")
        toy.ran()
        run = toy.doit("sing", "subject=ann", f"tune=clip:{clip}")
        assert run.returncode != 0 and known in run.stderr and "Traceback" not in run.stderr
        assert f"subject:{name}" in run.stderr and toy.ran() == []


def test_a_stage_that_is_run_alone_refuses_it_too(toy):
    clip = toy.root / "bob.txt"
    clip.write_text("jig ")
    toy.doit("bend:ann", "subject=ann")
    with pytest.raises(UserError, match="there is a subject 'bob'"):
        open_job("ann", toy.request(f"tune=clip:{clip}")).description("sing")


def test_a_clip_that_cannot_be_made_stops_what_needs_it(toy):
    run = toy.doit("sing", "subject=ann", f"tune=clip:{toy.root / 'gone.txt'}")
    assert run.returncode != 0 and "gone.txt" in run.stderr + run.stdout and "Traceback" not in run.stderr


def test_nothing_is_made_for_a_clip_that_cannot_be_used(toy):
    clip = toy.root / "noise.txt"
    clip.write_bytes(b"\xff\xfe")
    assert toy.doit("sing", "subject=ann", f"tune=clip:{clip}").returncode != 0
    assert toy.ran() == ["gather:noise"]
    assert toy.doit("sing", "paint:ann", "subject=ann", f"tune=clip:{clip}").returncode != 0
    assert sorted(toy.ran()) == ["bend:ann", "gather:ann", "gather:noise", "paint:ann"]


def test_clean_takes_its_results_too(toy):
    toy.doit("sing", "subject=ann")
    assert toy.doit("subject=ann", command="clean").returncode == 0
    assert not (toy.store / "ann" / "sing").exists() and not (toy.store / "ann" / "bend").exists()


def test_a_short_word_is_its_stages_setting(toy):
    assert toy.request("tune=la").overrides == {"sing.tune": "la"}
    with pytest.raises(UserError, match="tune and sing.tune"):
        toy.request("tune=la", "sing.tune=lu")
    run = toy.doit("sing", "subject=ann", "tun=la")
    assert run.returncode != 0 and "tune" in run.stderr.split("did you mean")[1]


def test_keys_of_other_stages_do_not_know_of_loans(toy):
    job = open_job("ann", toy.request("tune=subject:bob"))
    description = job.description("gather")
    assert "loans" not in description and as_dict(job.settings["sing"]) == {"tune": "subject:bob"}
    assert key_of(description) == key_of(open_job("ann", toy.request()).description("gather"))


def test_a_motion_that_is_not_there_is_refused_before_anything_runs(toy):
    with pytest.raises(UserError, match=r"motion=nowhere.bvh: there is no such file.*subject:NAME"):
        open_job("smile", parse_request(["motion=nowhere.bvh"]))
