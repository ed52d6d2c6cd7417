"""A word on the command line that would do nothing is an error that says what to write."""

import pytest

from pipeline.config.request import parse_request
from pipeline.errors import UserError
from pipeline.run.effect import check_settings_act, named_tasks
from pipeline.run.job import open_job

STAGES = ("gather", "bend", "paint", "sing")


def refused(toy, *words, saying):
    run = toy.doit(*words)
    said = (run.stderr + run.stdout).strip()
    assert run.returncode != 0 and "Traceback" not in said, said
    for part in saying:
        assert part in said, said
    assert toy.ran() == []


@pytest.mark.parametrize(
    ("words", "saying"),
    [
        (("source={clip}",), ("add subject=NAME",)),
        (("gather:ann", "source={clip}"), ("add subject=ann",)),
        (("subject=", "source={clip}"), ("subject= names nothing",)),
        (("dataset=pair", "source={clip}"), ("add subject=",)),
        (("gather:ann", "subject=bob"), ("subject=bob", "gather:bob")),
        (("gather:ann", "subject=bob", "source={clip}"), ("gather:bob",)),
        (("gather:ann", "dataset=pair"), ("dataset=pair", "subject=ann")),
        (("bend", "subject=ann"), ("every subject", "bend:ann")),
        (("gather:ann", "paint.iterations=2"), ("paint.iterations=2", "paint:")),
        (("prune:ann", "paint.iterations=2"), ("paint.iterations=2",)),
        (("subject=ann", "tune=la"), ("doit run sing subject=ann tune=la",)),
        (("subject=ann", "sing.tune=la"), ("doit run sing subject=ann",)),
        (("subject=ann", "cluster=auto"), ("doit run batch",)),
        (("subject=ann", "budget=20m"), ("doit run tradeoff",)),
        (("subject=ann", "scale=small"), ("ablate and tradeoff",)),
        (("subject=ann", "subject=bob"), ("subject= stands twice",)),
        (("subject=ann", "bend.angle=1", "bend.angle=2"), ("bend.angle= stands twice",)),
        (("subject=made", "source={clip}"), ("made up and not filmed",)),
        (("subject=ann", "gather.extra=nowhere/extra.txt"), ("gather.extra=", "no such file or folder")),
    ],
)
def test_a_word_without_effect_is_refused_and_nothing_runs(toy, words, saying):
    clip = toy.root / "clip.txt"
    clip.write_text("me ")
    toy.subject("cat", 'dataset = "pair"\n[source]\npath = "sources/ann.txt"\n')
    toy.subject("made", '[gather]\nmade_up = "made "\n')
    refused(toy, *(word.format(clip=clip) for word in words), saying=saying)


def test_words_that_act_are_taken(toy):
    clip = toy.root / "clip.txt"
    clip.write_text("me ")
    for words, ran in (
        (("gather:ann", "subject=ann", f"source={clip}"), ["gather:ann"]),
        (("bend:bob", "gather.unused=3"), ["gather:bob", "bend:bob"]),
        (("sing", "subject=bob", "gather.unused=4", "tune=la"), ["gather:bob", "sing:bob"]),
        (("paint:bob", "bend.angle=2", "verify=true"), ["gather:bob", "bend:bob", "paint:bob"]),
    ):
        run = toy.doit(*words)
        assert run.returncode == 0, run.stderr
        assert sorted(toy.ran()) == sorted(ran), words


def test_other_commands_than_run_are_left_alone():
    assert named_tasks(["list", "--all", "train.seed=3"], STAGES) is None
    assert named_tasks(["run", "-n", "2", "-P", "thread", "subject=ann"], STAGES) == []
    assert named_tasks(["subject=ann"], STAGES) == []
    assert named_tasks(["run", "bend:ann", "verify:bob", "x=1"], STAGES) == ["bend:ann", "verify:bob"]


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (("ingest.mannequin_frames=9",), "mannequin_frames"),
        (("ingest.masks={folder}", "ingest.mask_edge=0.5"), "mask_edge"),
        (("ingest.masks={folder}", "ingest.mask_steadiness=0"), "mask_steadiness"),
        (("ingest.test_frames=3", "ingest.test_fraction=0.2"), "test_fraction"),
        (("ingest.mannequin=head", "ingest.keypoints={folder}"), "keypoints"),
        (("ingest.cameras=pinhole", "ingest.camera_name=a"), "camera_name"),
        (("fit.given=keep", "fit.iterations=50"), "iterations"),
        (("fit.numbered_from=1",), "numbered_from"),
    ],
)
def test_what_a_stage_cannot_use_is_refused_where_the_command_line_says_it(tmp_path, words, name):
    given = [word.format(folder=tmp_path) for word in words]
    request = parse_request(["subject=me", f"source={tmp_path}", *given])
    with pytest.raises(UserError, match=rf"\.{name} has no effect on 'me'"):
        check_settings_act(open_job("me", request), ["ingest", "fit"])
    fine = parse_request(["subject=me", f"source={tmp_path}", *given[:-1]])
    check_settings_act(open_job("me", fine), ["ingest", "fit"])


def test_a_face_that_is_not_asked_for_is_refused(tmp_path):
    with pytest.raises(UserError, match=r"set fit\.face=flame"):
        open_job("me", parse_request(["subject=me", f"source={tmp_path}", f"fit.face_init={tmp_path}"]))
