"""The versioned store by itself."""

import json

import pytest

from pipeline.errors import UserError
from pipeline.store.artifact import Store, wrong_digests, wrong_sizes
from pipeline.store.verify import verify


def publish(store, key="k1", text="one", stage="fit"):
    with store.scratch("ann", stage, key, lambda: None) as scratch:
        (scratch.output / "sub").mkdir()
        (scratch.output / "sub" / "a.txt").write_text(text)
        (scratch.output / "b.txt").write_text("b")
        return store.publish(scratch, "ann", stage, key, {"stage": stage}, {"seconds": 1.0})


def test_what_is_published_is_found_and_is_the_latest(tmp_path):
    store = Store(tmp_path)
    made = publish(store)
    assert store.find("ann", "fit", "k1").manifest == made.manifest
    assert store.latest("ann", "fit").key == "k1"
    assert [file["path"] for file in made.manifest["files"]] == ["b.txt", "sub/a.txt"]
    assert not list(tmp_path.rglob(".scratch-*"))


def test_two_equal_results_have_equal_manifests_and_times_lie_beside(tmp_path):
    first, second = publish(Store(tmp_path / "1")), publish(Store(tmp_path / "2"))
    assert (first.folder / "manifest.json").read_bytes() == (second.folder / "manifest.json").read_bytes()
    assert json.loads((first.folder / "run.json").read_text()) == {"seconds": 1.0}


def test_the_digest_is_of_the_files_that_are_read(tmp_path):
    store = Store(tmp_path)
    one, two = publish(store, "k1", "one"), publish(store, "k2", "two")
    assert one.digest_of(["b.txt"]) == two.digest_of(["b.txt"])
    assert one.digest_of(["sub/*"]) != two.digest_of(["sub/*"])


def test_a_failed_attempt_publishes_nothing_and_keeps_its_work(tmp_path):
    store = Store(tmp_path)
    with pytest.raises(RuntimeError), store.scratch("ann", "fit", "k1", lambda: None) as scratch:
        (scratch.output / "half.txt").write_text("half")
        (scratch.work / "checkpoint").write_text("7")
        raise RuntimeError
    assert store.versions("ann", "fit") == [] and store.latest("ann", "fit") is None
    with store.scratch("ann", "fit", "k1", lambda: None) as scratch:
        assert (scratch.work / "checkpoint").read_text() == "7"
        assert list(scratch.output.iterdir()) == []


def test_a_file_of_the_wrong_size_makes_the_version_unusable_and_a_new_one_takes_its_place(tmp_path):
    store = Store(tmp_path)
    made = publish(store)
    (made.folder / "b.txt").write_text("longer")
    assert wrong_sizes(made) == ["b.txt"] and store.find("ann", "fit", "k1") is None
    publish(store)
    assert (store.find("ann", "fit", "k1").folder / "b.txt").read_text() == "b"


def test_a_missing_or_broken_manifest_makes_the_version_unusable(tmp_path):
    store = Store(tmp_path)
    made = publish(store)
    for content in ("", "[]", "{", '{"files": 3}'):
        (made.folder / "manifest.json").write_text(content)
        assert store.find("ann", "fit", "k1") is None


def test_verify_reads_every_byte(tmp_path):
    store = Store(tmp_path)
    made = publish(store)
    assert verify(store, "ann", ["fit"]) == 1
    (made.folder / "b.txt").write_text("c")
    assert wrong_sizes(made) == [] and wrong_digests(made) == ["b.txt"]
    with pytest.raises(UserError, match="doit run fit:ann"):
        verify(store, "ann", ["fit"])


def test_a_store_that_cannot_be_made_names_itself(tmp_path):
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(UserError, match="artifacts=FOLDER"),
        Store(tmp_path / "file").scratch("ann", "fit", "k", lambda: None),
    ):
        pass
