"""A disk that is full, and one that cannot be written: really, on a small mount, where that can be had."""

import contextlib
import errno
import os
import shutil
import subprocess

import numpy as np
import pyarrow as pa
import pytest
from safetensors.numpy import save_file

from pipeline.clip.frames import write_png
from pipeline.errors import error_message, is_disk_full, readable_size
from pipeline.files.tables import write_table
from pipeline.run.job import open_job, run_stage
from pipeline.store.artifact import Store
from pipeline.store.verify import damages

STAGES = ("gather", "bend", "paint")
PAGE = os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else 4096
PAGES = 64


@contextlib.contextmanager
def mounted(folder, *options):
    """A mount at a folder; the test is skipped where that is not allowed."""
    folder.mkdir(exist_ok=True)
    try:
        made = subprocess.run(["mount", *options, str(folder)], capture_output=True, check=False)
    except FileNotFoundError:
        pytest.skip("there is no mount here")
    if made.returncode:
        pytest.skip(f"nothing can be mounted here: {made.stderr.decode().strip()}")
    try:
        yield folder
    finally:
        subprocess.run(["umount", str(folder)], check=False)


@pytest.fixture
def small_disk(tmp_path):
    with mounted(tmp_path / "disk", "-t", "tmpfs", "-o", f"size={PAGES * PAGE}", "tmpfs") as folder:
        yield folder


@contextlib.contextmanager
def read_only(folder):
    """A folder that nobody can write: root ignores permissions, so that it needs a mount."""
    if os.geteuid() == 0:
        with mounted(folder, "--bind", "-o", "ro", str(folder)):
            yield folder
        return
    folder.chmod(0o555)
    try:
        yield folder
    finally:
        folder.chmod(0o755)


def make(toy, stage, *words):
    return run_stage(open_job("ann", toy.request(*words)), stage)


def fill(folder, pages_left):
    """A file that leaves this many pages free."""
    ballast = folder / "ballast"
    free = shutil.disk_usage(folder).free
    ballast.write_bytes(bytes(max(0, free - pages_left * PAGE)))
    return ballast


@pytest.mark.slow
def test_a_disk_that_fills_at_any_moment_leaves_nothing_half_published(toy, small_disk):
    store = small_disk / "store"
    words, text = (f"artifacts={store}",), "ann 1.0" * 2000  # 14 kB, four pages
    for stage in ("gather", "bend"):
        make(toy, stage, *words)
    outcomes = set()
    for pages in range(1, 20):
        ballast = fill(small_disk, pages)
        try:
            make(toy, "paint", "paint.iterations=2000", *words)
            outcomes.add("done")
        except OSError as error:
            said = error_message(error, store)
            assert "the disk is full" in said and "of 256.0 KiB free" in said, said
            assert str(small_disk) in said and "artifacts=FOLDER" in said and "the same command" in said
            assert not list((store / "ann" / "paint").glob(".scratch-*/output/*"))  # its room is given back
            assert Store(store).folders("ann", "paint") == [] and not damages(Store(store), "ann", STAGES)
            outcomes.add("full")
        ballast.unlink()
        if "done" in outcomes:
            break
    assert outcomes == {"full", "done"}
    version = Store(store).latest("ann", "paint")
    assert (version.folder / "painted.txt").read_text() == text


def test_a_full_disk_at_the_last_step_of_publishing(toy, monkeypatch):
    make(toy, "gather")

    def full(handle):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch, pytest.raises(OSError) as caught:
        patch.setattr(os, "fsync", full)
        make(toy, "bend")
    said = error_message(caught.value, toy.store)
    assert said.startswith((str(toy.store), "/")) and "the disk is full" in said and " free)" in said
    assert toy.published("bend", "ann") == [] and not list(toy.store.glob("ann/bend/.scratch-*/output"))
    make(toy, "bend")
    assert len(toy.published("bend", "ann")) == 1


def test_the_same_command_goes_on_when_there_is_room_again(toy, small_disk):
    words = ("subject=ann", f"artifacts={small_disk / 'store'}")
    assert toy.doit("gather:ann", *words).returncode == 0
    ballast = fill(small_disk, 0)
    run = toy.doit(*words)
    assert run.returncode != 0 and "the disk is full" in run.stderr and "Traceback" not in run.stderr
    ballast.unlink()
    again = toy.doit(*words)
    assert again.returncode == 0, again.stderr


@pytest.mark.parametrize(
    "error",
    [
        RuntimeError("Error while serializing: I/O error: No space left on device (os error 28)"),
        OSError(errno.EDQUOT, "Disk quota exceeded", "/x/y"),
        ValueError("[Errno 28] Error writing bytes to file. Detail: [errno 28] No space left on device"),
    ],
)
def test_a_full_disk_in_other_words(error, tmp_path):
    assert is_disk_full(error) and "the disk is full" in error_message(error, tmp_path)
    try:
        try:
            raise error
        except Exception as first:
            raise RuntimeError("cannot write") from first
    except RuntimeError as later:
        assert "the disk is full" in error_message(later, tmp_path)


def test_other_errors_are_not_taken_for_a_full_disk(tmp_path):
    assert error_message(ValueError("ours"), tmp_path) is None
    assert error_message(FileNotFoundError(2, "No such file", "x"), tmp_path) is None
    outside = error_message(PermissionError(13, "Permission denied", "/etc/shadow"), tmp_path)
    assert "/etc/shadow: cannot be used" in outside and "artifacts" not in outside
    assert (readable_size(0), readable_size(1536), readable_size(5 * 1024**3)) == (
        "0 bytes",
        "1.5 KiB",
        "5.0 GiB",
    )


def test_a_data_folder_that_cannot_be_written(toy):
    with read_only(toy.data):
        run = toy.doit("subject=ann")
        assert run.returncode != 0 and "Traceback" not in run.stdout + run.stderr
        assert f"{toy.store}" in run.stderr and "choose another store: artifacts=FOLDER" in run.stderr
        elsewhere = toy.root / "elsewhere" / "store"
        again = toy.doit("subject=ann", f"artifacts={elsewhere}")
        assert again.returncode == 0, again.stderr
        assert (elsewhere / "ann" / "paint" / "latest" / "painted.txt").read_text() == "ann 1.0" * 3


def test_a_finished_store_can_be_read_where_it_cannot_be_written(made):
    (made.store / ".digests.json").unlink(missing_ok=True)
    with read_only(made.store):
        assert made.doit("subject=ann").returncode == 0 and made.doit("verify:ann").returncode == 0
        assert made.ran() == []
        run = made.doit("subject=ann", "bend.angle=9")
        assert run.returncode != 0 and "cannot be written" in run.stderr and str(made.store) in run.stderr
        assert "Traceback" not in run.stdout + run.stderr


def write_picture(path):
    write_png(path, np.random.default_rng(0).integers(0, 255, (300, 300, 3)).astype(np.uint8))


def write_numbers(path):
    write_table(path, pa.schema([("a", pa.float64())]), {"a": np.random.default_rng(0).random(90_000)})


def write_arrays(path):
    save_file({"a": np.ones(90_000)}, path)


@pytest.mark.parametrize("write", [write_picture, write_numbers, write_arrays])
def test_every_library_that_writes_says_that_the_disk_is_full(small_disk, write):
    with pytest.raises(Exception) as caught:
        write(small_disk / "file")
    assert "the disk is full" in error_message(caught.value, small_disk)
