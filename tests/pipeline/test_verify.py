"""A flipped bit in any published file is found, and the command that the message gives mends it."""

import random
import re
import shlex
import subprocess
import sys

import pytest

from pipeline.config.workspace import REPOSITORY
from pipeline.errors import UserError
from pipeline.store.artifact import LATEST, Store
from pipeline.store.verify import damages, verify

SEED = 7


def publish(store, key="k1", stage="fit"):
    with store.scratch("ann", stage, key, lambda: None) as scratch:
        (scratch.output / "frames").mkdir()
        (scratch.output / "frames" / "000000.png").write_bytes(bytes(range(64)))
        (scratch.output / "split.json").write_text('{"train": [0]}')
        description = {"stage": stage, "version": 1, "settings": {"rate": 0.5, "name": "a"}, "inputs": {}}
        return store.publish(scratch, "ann", stage, key, description, {"seconds": 1.25, "host": "here"})


def flip(path, place, bit):
    content = bytearray(path.read_bytes())
    content[place] ^= 1 << bit
    path.write_bytes(content)


@pytest.mark.parametrize(
    "name", ["frames/000000.png", "split.json", "manifest.json", "run.json", "SHA256SUMS"]
)
def test_a_flipped_bit_anywhere_is_found_and_the_stage_to_rerun_is_named(tmp_path, name):
    print(f"seed {SEED}")
    draw, store = random.Random(SEED), Store(tmp_path)
    path = publish(store).folder / name
    whole = path.read_bytes()
    for place in range(len(whole)):
        flip(path, place, draw.randrange(8))
        with pytest.raises(UserError) as caught:
            verify(store, "ann", ["fit"])
        message = str(caught.value)
        assert "doit run fit:ann verify=true" in message and str(path.parent) in message, (place, message)
        # The seal and what it seals cannot be told apart where one line of it is wrong.
        assert name in message or name == "SHA256SUMS", (place, message)
        path.write_bytes(whole)
    assert verify(store, "ann", ["fit"]) == 1


def test_a_thorough_store_believes_nothing_that_verify_refuses(tmp_path):
    store, thorough = Store(tmp_path), Store(tmp_path, thorough=True)
    folder = publish(store).folder
    for name in ("frames/000000.png", "run.json", "SHA256SUMS"):
        flip(folder / name, 3, 2)
        assert store.find("ann", "fit", "k1") is not None and thorough.find("ann", "fit", "k1") is None
        flip(folder / name, 3, 2)
    assert thorough.find("ann", "fit", "k1") is not None


def test_a_version_without_its_manifest_is_damaged_and_not_passed_over(tmp_path):
    store = Store(tmp_path)
    (publish(store).folder / "manifest.json").unlink()
    publish(store, "k2")
    assert [(damage.folder.name, damage.files) for damage in damages(store, "ann", ["fit"])] == [
        ("k1", ("manifest.json",))
    ]


def test_every_damaged_version_is_told(tmp_path):
    store = Store(tmp_path)
    for stage in ("fit", "train"):
        flip(publish(store, stage=stage).folder / "split.json", 0, 0)
    with pytest.raises(UserError) as caught:
        verify(store, "ann", ["ingest", "fit", "train"])
    first, second = str(caught.value).splitlines()
    assert "doit run fit:ann" in first and "doit run train:ann" in second


def test_a_version_from_before_there_were_seals_is_whole(tmp_path):
    store = Store(tmp_path)
    (publish(store).folder / "SHA256SUMS").unlink()
    assert verify(store, "ann", ["fit"]) == 1


def test_the_seal_is_what_sha256sum_checks(tmp_path):
    folder = publish(Store(tmp_path)).folder
    try:
        said = subprocess.run(["sha256sum", "-c", "SHA256SUMS"], cwd=folder, capture_output=True, text=True)
    except FileNotFoundError:
        pytest.skip("there is no sha256sum here")
    assert said.returncode == 0 and said.stdout.split() == ["manifest.json:", "OK", "run.json:", "OK"]


def bytes_of(folder):
    """Every published byte but the times: run.json, and the digest of it in the seal."""
    times = ("run.json", "SHA256SUMS")
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.name not in times}


@pytest.mark.slow
def test_the_command_in_the_message_makes_the_damaged_version_again(toy):
    toy.doit("subject=ann", "bend.angle=2")
    folder = (toy.store / "ann" / "bend" / LATEST).resolve()
    whole = bytes_of(folder)
    toy.ran()
    for name in ("bent.txt", "run.json", "manifest.json"):
        flip(folder / name, 1, 4)
        found = toy.doit("verify:ann", "bend.angle=2")
        assert found.returncode != 0 and name in found.stdout + found.stderr
        command = re.search(r"rerun the stage: doit (run bend:ann .*)", found.stdout + found.stderr)[1]
        line = [sys.executable, "-m", "doit", *shlex.split(command)]
        subprocess.run(line, cwd=REPOSITORY, env=toy.environment(), check=True, capture_output=True)
        assert toy.ran() == ["bend:ann"] and bytes_of(folder) == whole
        assert damages(Store(toy.store), "ann", ["gather", "bend", "paint"]) == []
        assert not [path for path in folder.parent.iterdir() if path.name.startswith((".scratch", ".dam"))]


def test_a_damaged_version_of_other_settings_is_told_apart(toy):
    toy.doit("bend:ann", "bend.angle=2")
    flip(toy.store / "ann" / "bend" / LATEST / "bent.txt", 0, 0)
    toy.doit("bend:ann")
    found = toy.doit("verify:ann")
    said = found.stdout + found.stderr
    assert found.returncode != 0 and "under other settings" in said and "doit run prune:ann" in said
    assert toy.doit("prune:ann").returncode == 0
    assert damages(Store(toy.store), "ann", ["bend"]) == []


def test_a_flipped_bit_in_an_upstream_record_does_not_mislead_about_what_follows(made):
    manifest = made.store / "ann" / "bend" / LATEST / "manifest.json"
    digest = manifest.read_text().index('"sha256": "') + len('"sha256": "')
    flip(manifest, digest, 0)  # still a manifest, of another file
    flip(made.store / "ann" / "paint" / LATEST / "painted.txt", 0, 0)
    found = made.doit("verify:ann")
    said = found.stdout + found.stderr
    assert "rerun the stage: doit run bend:ann" in said and "rerun the stage: doit run paint:ann" in said


def test_verify_takes_true_or_false(toy):
    run = toy.doit("subject=ann", "verify=perhaps")
    assert run.returncode != 0 and "verify must be true or false, not perhaps" in run.stderr
