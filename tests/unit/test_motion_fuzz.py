"""Damaged motion files of every kind: a motion or one line, no traceback, no hang, nothing executed."""

import io
import json
import random
import time
import warnings
import zipfile

import numpy as np
import pytest
import torch

from pipeline.body import load_body, mean_identity, rest_joints
from pipeline.errors import UserError
from stages.animate.motions.motion import Span
from stages.animate.motions.read import DrivenPerson, read_motion
from stages.animate.motions.source import MotionSource
from tests.made.body import BODY_FILE
from tests.made.captured_skeletons import SKELETONS, write_captured
from tests.made.motions import made_up, write_folder, write_npz

FILES = 400  # of each kind
MOST_SECONDS = 20.0  # for one file, on a busy machine
WORDS = (
    b"nan", b"inf", b"-1e999", b"1e308", b"99999999999999999999", b"-7", b"0", b"{", b"}", b"[", b"]",
    b"null", b"{}",
    b"CHANNELS 3 Zrotation Xrotation Zrotation", b"CHANNELS 99999999", b"End Site {", b"OFFSET", b"JOINT x {",
    b"MOTION", b"Frames: 3", b"\xff\xfe", b"\xef\xbb\xbf", b"\x00", b'"root_pose"', b"\xed\xa0\x80",
)  # fmt: skip


class Evil:
    def __reduce__(self):
        return (print, ("executed",))


def mutated(content, rng):
    """Bytes with one to four pieces changed, put in, taken out, doubled, or all cut off behind a place."""
    content = bytearray(content)
    for _ in range(rng.randint(1, 4)):
        at, size = rng.randrange(len(content) + 1), rng.choice((1, 1, 4, 30, 300))
        match rng.randrange(6):
            case 0:
                content[at : at + size] = rng.randbytes(min(size, 30))
            case 1:
                content[at:at] = rng.choice(WORDS)
            case 2:
                del content[at : at + size]
            case 3:
                content[at:at] = content[at : at + size]
            case 4:
                words = bytes(content).split(b" ")
                words[rng.randrange(len(words))] = rng.choice(WORDS)
                content = bytearray(b" ".join(words))
            case 5:
                if rng.random() < 0.2:
                    del content[at:]
    return bytes(content)


def odd_array(array, rng):
    """An array of another type or shape, with other numbers, or of objects."""
    match rng.randrange(8):
        case 0:
            return array.astype(
                rng.choice([np.float16, np.int8, np.uint64, np.complex64, bool, ">f8", "S4", "U4"])
            )
        case 1:
            return array[..., : rng.randrange(4)] if array.ndim else array.reshape(1)
        case 2:
            return array[None] if rng.random() < 0.5 else array.reshape(-1)
        case 3:
            return np.where(np.random.default_rng(rng.randrange(99)).random(array.shape) < 0.1, rng.choice(
                [np.nan, np.inf, 1e30, -1e-300]), array)  # fmt: skip
        case 4:
            return np.array([Evil(), *array.reshape(-1)[:3]], object)
        case 5:
            return np.array({"poses": array}, object)
        case 6:
            return array.reshape(-1)[:0]
        case _:
            return np.zeros((rng.randrange(3), rng.randrange(4), rng.randrange(200)))


def odd_archive(path, rng):
    """An archive whose arrays are odd, or whose bytes are."""
    if rng.random() < 0.5:
        path.write_bytes(mutated(path.read_bytes(), rng))
        return
    arrays = dict(np.load(path))
    for name in rng.sample(sorted(arrays), rng.randint(1, len(arrays))):
        if rng.random() < 0.3:
            arrays.pop(name)
        else:
            arrays[name] = odd_array(arrays[name], rng)
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    if rng.random() < 0.2:
        with warnings.catch_warnings(), zipfile.ZipFile(buffer, "a") as archive:
            warnings.simplefilter("ignore")  # a name twice
            archive.writestr(rng.choice(["../poses.npy", "poses.npy", "betas.npy"]), rng.randbytes(90))
    path.write_bytes(buffer.getvalue())


def odd_frame(folder, rng):
    """A folder with one odd frame."""
    path = rng.choice(sorted(folder.glob("*.json")))
    if rng.random() < 0.5:
        path.write_bytes(mutated(path.read_bytes(), rng))
        return
    values = json.loads(path.read_text())
    name = rng.choice(sorted(values))
    odd = [
        None,
        [],
        [None] * 3,
        "x",
        {"a": 1},
        [[1, 2], 3],
        1e9,
        True,
        [float("nan")] * 3,
        [[[1]]],
        [10**400],
    ]
    values[name] = rng.choice(odd)
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
