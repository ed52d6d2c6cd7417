"""Damaged files for fuzzing: bytes, arrays and values changed at random, and how a reader is held to it."""

from __future__ import annotations

import io
import json
import pickle
import random
import shutil
import time
import warnings
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
from safetensors.numpy import save_file

from pipeline.errors import UserError

MOST_SECONDS = 20.0  # for one file, on a busy machine
WORDS = (
    b"nan", b"inf", b"-1e999", b"1e308", b"99999999999999999999", b"-7", b"0", b"{", b"}", b"[", b"]",
    b"null", b"{}",
    b"CHANNELS 3 Zrotation Xrotation Zrotation", b"CHANNELS 99999999", b"End Site {", b"OFFSET", b"JOINT x {",
    b"MOTION", b"Frames: 3", b"\xff\xfe", b"\xef\xbb\xbf", b"\x00", b'"root_pose"', b"\xed\xa0\x80",
)  # fmt: skip


ODD_VALUES = (
    None, [], [None] * 3, "x", "", {"a": 1}, [[1, 2], 3], 1e9, True, [float("nan")] * 3, [[[1]]],
    {}, -1, 0, [10**400], 10**400, 1e308, [1e308], ["x"], [{}], "../../x", 2**63,
)  # fmt: skip


class Evil:
    """Says that it was executed where a file that holds it is unpickled."""

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
        case 3 if array.dtype.kind in "fiub":
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


def odd_value(value: Any, rng: random.Random) -> Any:
    """JSON-like content of which one place, at any depth, holds something else."""
    if isinstance(value, dict) and value and rng.random() < 0.9:
        key = rng.choice(list(value))
        if rng.random() < 0.1:
            return {name: one for name, one in value.items() if name != key}
        return {**value, key: odd_value(value[key], rng)}
    if isinstance(value, (list, tuple)) and value and rng.random() < 0.7:
        place = rng.randrange(len(value))
        if rng.random() < 0.2:
            return [*value[:place], *value[place + 1 :]]
        return [*value[:place], odd_value(value[place], rng), *value[place + 1 :]]
    if isinstance(value, np.ndarray):
        return odd_array(value, rng)
    return rng.choice(ODD_VALUES)


def odd_safetensors(path: Path, rng: random.Random) -> None:
    """A file of tensors of which one is odd or missing, or whose metadata say something else."""
    with safetensors.safe_open(path, "np") as file:
        words, arrays = file.metadata() or {}, {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    name = rng.choice(sorted(words) * 3 + sorted(arrays))
    if name in words:
        try:
            words[name] = json.dumps(odd_value(json.loads(words[name]), rng))
        except ValueError:
            words[name] = rng.choice(["", "x", "{}", "[]"])
    elif rng.random() < 0.3:
        del arrays[name]
    else:
        odd = odd_array(arrays[name], rng)
        known = odd.dtype.str in ("<f4", "<f8", "|i1", "|b1")
        arrays[name] = np.ascontiguousarray(odd) if known else np.zeros((rng.randrange(3), 2), np.float32)
    save_file(arrays, path, words)


def damage(path: Path, rng: random.Random) -> None:
    """Change a file: its values where its kind is known, or its bytes."""
    kind = path.suffix
    if rng.random() < 0.5 and kind in (".json", ".pkl", ".npy", ".npz", ".safetensors"):
        if kind == ".json":
            path.write_text(json.dumps(odd_value(json.loads(path.read_text()), rng)))
        elif kind == ".safetensors":
            odd_safetensors(path, rng)
        elif kind == ".npz":
            odd_archive(path, rng)
        elif kind == ".npy":
            value = np.load(path, allow_pickle=True)
            value = odd_value(value.item(), rng) if value.ndim == 0 else odd_array(value, rng)
            np.save(path, np.array(value, object) if not isinstance(value, np.ndarray) else value)
        else:
            value = odd_value(pickle.loads(path.read_bytes()), rng)
            path.write_bytes(pickle.dumps([value, Evil()] if rng.random() < 0.1 else value))
    else:
        path.write_bytes(mutated(path.read_bytes(), rng))


def fuzz(
    kind: str,
    good: Path,
    read: Callable[[Path], object],
    folder: Path,
    count: int,
    damaged: Sequence[str] = ("**/*",),
) -> dict[str, int]:
    """Damage copies of a good input and read each: an answer, or one line that names the file.

    Args:
        kind: its name, of which the seeds are made.
        good: a file or a folder.
        read: the reader; takes a copy of ``good``.
        folder: for the copies.
        count: how many.
        damaged: patterns of a folder's files of which one is damaged each time.

    Returns:
        How many were ``read`` and ``refused``.

    Raises:
        AssertionError: anything else was raised, a message is no single line or does not name the file, or
            reading took longer than ``MOST_SECONDS``; the kind, the seed and the file are in the message.
    """
    read(good)
    outcomes = {"read": 0, "refused": 0}
    for seed in range(count):
        rng = random.Random(f"{kind} {seed}")
        path = folder / f"{seed}" / good.name
        path.parent.mkdir(parents=True)
        if good.is_dir():
            shutil.copytree(good, path)
        else:
            shutil.copy(good, path)
        files = sorted({one for way in damaged for one in path.glob(way) if one.is_file()}) or [path]
        target = rng.choice(files)
        damage(target, rng)
        what = f"{kind}, seed {seed}: {target}"
        print(what, flush=True)  # which it was, where a library ends the process
        begun = time.monotonic()
        try:
            read(path)
            outcomes["read"] += 1
        except UserError as error:
            outcomes["refused"] += 1
            message = str(error)
            assert "\n" not in message.strip() and len(message) < 2000, f"{what}: {message}"
            assert str(path) in message or path.name in message, f"{what}: {message}"
        except Exception as error:
            raise AssertionError(f"{what}: {type(error).__name__}: {error}") from error
        assert time.monotonic() - begun < MOST_SECONDS, f"{what}: took {time.monotonic() - begun:.0f} s"
        shutil.rmtree(path.parent)  # a failed one is kept to be looked at
    return outcomes
