"""Digests that are remembered: never believed where the file could have changed."""

import json
import os
import random
import shutil
import time

import pytest

from pipeline.store import digest

SEED = 11
OLD = 1_600_000_000


@pytest.fixture
def later(monkeypatch):
    """Looks at files an hour from now, so that their digests are remembered."""
    real = time.time_ns
    monkeypatch.setattr(digest.time, "time_ns", lambda: real() + 3_600_000_000_000)


def test_what_is_remembered_is_not_read_again(tmp_path, later, monkeypatch):
    source, memory = tmp_path / "clip", tmp_path / "memory.json"
    source.write_text("one")
    first = digest.of_source(source, memory)
    with monkeypatch.context() as patch:
        patch.setattr(digest, "of_file", lambda path: pytest.fail("read again"))
        assert digest.of_source(source, memory) == first


@pytest.mark.parametrize("way", ["written over", "replaced", "copied with its times"])
def test_another_content_of_the_same_size_and_time_is_noticed(tmp_path, later, way):
    source, memory, other = tmp_path / "clip", tmp_path / "memory.json", tmp_path / "other"
    source.write_text("one")
    os.utime(source, (OLD, OLD))
    first = digest.of_source(source, memory)
    other.write_text("two")
    os.utime(other, (OLD, OLD))
    if way == "written over":
        source.write_text("two")
        os.utime(source, (OLD, OLD))
    elif way == "replaced":
        os.replace(other, source)
    else:
        shutil.copy2(other, source)
    assert source.stat().st_size == 3 and source.stat().st_mtime == OLD
    assert digest.of_source(source, memory) != first


def test_a_file_of_this_moment_or_of_the_future_is_read_each_time(tmp_path):
    source, memory = tmp_path / "clip", tmp_path / "memory.json"
    source.write_text("one")
    first = digest.of_source(source, memory)
    assert not memory.exists()  # within a tick of the clock it could change and look the same
    os.utime(source, (4102444800, 4102444800))
    assert digest.of_source(source, memory) == first and not memory.exists()


def test_a_flipped_bit_in_the_memory_never_gives_a_wrong_digest(tmp_path, later):
    print(f"seed {SEED}")
    draw, source, memory = random.Random(SEED), tmp_path / "clip", tmp_path / "memory.json"
    source.write_text("one")
    right = digest.of_source(source, memory)
    whole = memory.read_bytes()
    for place in range(len(whole)):
        content = bytearray(whole)
        content[place] ^= 1 << draw.randrange(8)
        memory.write_bytes(content)
        assert digest.of_source(source, memory) == right, place


@pytest.mark.parametrize("content", ["", "{", "[]", "3", '{"digests": 3}', '{"a|3|5": "00"}', "\udcff"])
def test_a_memory_of_another_form_is_forgotten(tmp_path, later, content):
    source, memory = tmp_path / "clip", tmp_path / "memory.json"
    source.write_text("one")
    memory.write_bytes(content.encode("utf-8", "surrogateescape"))
    right = digest.of_json([digest.of_file(source)])
    assert digest.of_source(source, memory) == right
    assert list(json.loads(memory.read_text())["digests"].values()) == [digest.of_file(source)]


def test_a_memory_that_cannot_be_written_is_done_without(tmp_path, later, monkeypatch):
    source = tmp_path / "clip"
    source.write_text("one")

    def refuse(*arguments, **options):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(digest.tempfile, "mkstemp", refuse)
    assert digest.of_source(source, tmp_path / "memory.json") == digest.of_json([digest.of_file(source)])
