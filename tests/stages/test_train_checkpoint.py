"""Checkpoints: whose they are, and that a damaged one is never gone on from, but told of."""

import random

import pytest
import torch

from stages.train.checkpoint import NAME, Checkpoint, read_checkpoint, run_key, write_checkpoint
from stages.train.run import resume

SEED = 5


@pytest.fixture
def written(tmp_path):
    tensors = {
        "weight": torch.linspace(-1, 1, 6).reshape(2, 3),
        "half": torch.linspace(0, 1, 3).to(torch.bfloat16),
        "step": torch.tensor(7),
        "none": torch.zeros(0, 3),
    }
    write_checkpoint(tmp_path, Checkpoint(7, "run", tensors, {"curve": [0.5, 0.25]}))
    return tmp_path / NAME


def test_a_whole_checkpoint_is_read(written):
    read = read_checkpoint(written.parent, "run")
    assert read.iteration == 7 and read.extra == {"curve": [0.5, 0.25]}
    assert read.tensors["half"].dtype == torch.bfloat16 and read.tensors["none"].shape == (0, 3)


def test_a_checkpoint_of_another_run_is_left_alone(written):
    assert read_checkpoint(written.parent, "another run") is None
    assert [path.name for path in written.parent.iterdir()] == [NAME]


def test_the_key_of_a_run_changes_with_settings_and_inputs():
    poses = torch.zeros(4, 3)
    key = run_key({"seed": 0}, [poses])
    assert key == run_key({"seed": 0}, [poses.clone()])
    assert len({key, run_key({"seed": 1}, [poses]), run_key({"seed": 0}, [poses + 1])}) == 3


def test_a_flipped_bit_anywhere_makes_it_no_checkpoint(written):
    print(f"seed {SEED}")
    draw, whole = random.Random(SEED), written.read_bytes()
    before = read_checkpoint(written.parent, "run")
    for place in range(len(whole)):
        content = bytearray(whole)
        content[place] ^= 1 << draw.randrange(8)
        written.write_bytes(content)
        read = read_checkpoint(written.parent, "run")
        if read is not None:  # a bit that means nothing: between the header's words
            assert (read.iteration, read.extra) == (before.iteration, before.extra), place
            assert read.tensors.keys() == before.tensors.keys()
            assert all(torch.equal(read.tensors[name], one) for name, one in before.tensors.items()), place


@pytest.mark.parametrize("content", [b"", b"\0" * 100, b"\x10" * 5000, b'{"a": 1}'])
def test_what_is_no_checkpoint_is_said_and_training_begins_anew(tmp_path, content):
    (tmp_path / NAME).write_bytes(content)
    said = []
    resume(None, tmp_path, "run", said.append)
    assert len(said) == 1


def test_a_first_run_says_nothing(tmp_path):
    said = []
    resume(None, tmp_path, "run", said.append)
    assert said == []
