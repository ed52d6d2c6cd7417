"""Damaged motion files of every kind: a motion or one line, no traceback, no hang, nothing executed."""

import json
import random
import time

import pytest
import torch

from pipeline.body import load_body, mean_identity, rest_joints
from pipeline.errors import UserError
from stages.animate.motions.motion import Span
from stages.animate.motions.read import DrivenPerson, read_motion
from stages.animate.motions.source import MotionSource
from tests.made.body import BODY_FILE
from tests.made.captured_skeletons import SKELETONS, write_captured
from tests.made.damage import MOST_SECONDS, ODD_VALUES, mutated, odd_archive
from tests.made.motions import made_up, write_folder, write_npz

FILES = 400  # of each kind


def odd_frame(folder, rng):
    """A folder with one odd frame."""
    path = rng.choice(sorted(folder.glob("*.json")))
    if rng.random() < 0.5:
        path.write_bytes(mutated(path.read_bytes(), rng))
        return
    values = json.loads(path.read_text())
    values[rng.choice(sorted(values))] = rng.choice(ODD_VALUES)
    path.write_text(json.dumps(values))


@pytest.fixture(scope="module")
def person():
    body = load_body(BODY_FILE)
    return DrivenPerson(body, BODY_FILE, mean_identity(body))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["bvh", "amass", "peers"])
def test_a_damaged_motion_is_read_or_refused_in_a_line(tmp_path, person, kind, capsys):
    rotation, way = made_up(3)
    pivot = rest_joints(person.body, person.identity)[0].double()
    names = sorted(SKELETONS)
    good, outcomes = {}, {"read": 0, "refused": 0}
    for seed in range(FILES):
        rng = random.Random(f"{kind} {seed}")
        print(f"{kind}, seed {seed}")  # pytest shows it where a file fails
        path = tmp_path / str(seed)
        if kind == "bvh":
            name = names[seed % len(names)]
            if name not in good:
                good[name] = write_captured(path, rotation, way, person, SKELETONS[name]).read_bytes()
            path.write_bytes(mutated(good[name], rng))
        elif kind == "amass":
            path = write_npz(path.with_suffix(".npz"), rotation, way, pivot, rng.choice(["poses", "parts"]))
            odd_archive(path, rng)
        else:
            odd_frame(write_folder(path, rotation, way, pivot, BODY_FILE), rng)
        begun = time.monotonic()
        try:
            motion = read_motion(MotionSource(kind, path), person, Span(), "auto", {})
        except UserError as error:
            outcomes["refused"] += 1
            assert str(path) in str(error) and "\n" not in str(error).strip(), str(error)
        else:
            outcomes["read"] += 1
            assert torch.isfinite(motion.rotation).all() and torch.isfinite(motion.root).all()
        assert time.monotonic() - begun < MOST_SECONDS
    assert min(outcomes.values()) > FILES / 20, outcomes
    assert "executed" not in capsys.readouterr().out
