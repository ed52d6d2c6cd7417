"""Reading BVH, the text format of motion capture: a skeleton of offsets and a table of angles."""

from __future__ import annotations

import dataclasses
import itertools
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import roma
import torch
from torch import Tensor

from pipeline.errors import UserError
from pipeline.files.text_encoding import decode_text
from pipeline.untrusted import bounded_bytes

_MOST_BYTES = 256 << 20  # an hour of 60 joints at 30 frames a second has some 120 MB
_MOST_JOINTS = 2000
_LARGEST = 1e7  # of an offset or a channel: ten kilometres in millimetres
_SLOWEST, _FASTEST = 0.1, 10_000.0  # frames a second
_POSITIONS = ("Xposition", "Yposition", "Zposition")
_ROTATIONS = ("Xrotation", "Yrotation", "Zrotation")
_MOTION = re.compile(r"(?i)(?<![^\s}])MOTION\s+Frames\s*:\s*(\S+)\s+Frame\s+Time\s*:\s*(\S+)")
_CHANNELS = {name.lower(): name for name in (*_POSITIONS, *_ROTATIONS)}


@dataclasses.dataclass(frozen=True)
class Bvh:
    """A clip of motion capture, N joints over T frames.

    Attributes:
        names: the joints, parents before children.
        parents: -1 for the root.
        offsets: [N, 3] float64, from the parent, in the file's unit of length.
        channels: each joint's channel names in the order of the table's columns.
        values: [T, C] float64, the table; angles in degrees.
        fps: frames a second.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: np.ndarray
    channels: tuple[tuple[str, ...], ...]
    values: np.ndarray
    fps: float


def read_bvh(path: Path) -> Bvh:
    """Read a BVH file.

    Joints' names may have spaces, keywords and channels are known in any case, and a byte-order mark is left
    out.

    Raises:
        UserError: the file is missing or too large, is no BVH, or its table does not fit its skeleton.
    """
    content = bounded_bytes(Path(path), _MOST_BYTES, "name another BVH file")
    try:
        return _parse(decode_text(content, errors="replace"))
    except (ValueError, StopIteration, IndexError, RuntimeError) as error:
        # A count that the file does not hold ends a generator early, which Python calls a RuntimeError.
        reason = "it ends early" if isinstance(error, StopIteration | RuntimeError) else error
        raise UserError(f"{path} cannot be read as BVH ({reason}): name another file") from None


def world_motion(bvh: Bvh, frames: np.ndarray) -> tuple[Tensor, Tensor]:
    """Each joint's orientation and place at some of the frames.

    Args:
        frames: [K] indices of its table's rows.

    Returns:
        orientations [K, N, 3, 3] and positions [K, N, 3] float64, in the file's axes and unit.
    """
    table = torch.from_numpy(bvh.values[frames])
    orientations: list[Tensor] = []
    positions: list[Tensor] = []
    column = 0
    for joint, (parent, names) in enumerate(zip(bvh.parents, bvh.channels, strict=True)):
        own = table[:, column : column + len(names)]
        column += len(names)
        local, place = _local(names, own, torch.from_numpy(bvh.offsets[joint]))
        if parent < 0:
            orientations.append(local)
            positions.append(place)
        else:
            orientations.append(orientations[parent] @ local)
            positions.append(positions[parent] + (orientations[parent] @ place[..., None])[..., 0])
    return torch.stack(orientations, dim=1), torch.stack(positions, dim=1)


def zero_places(bvh: Bvh) -> Tensor:
    """Each joint's place where all angles are zero and the root is at its offset: [N, 3] float64."""
    places: list[np.ndarray] = []
    for parent, offset in zip(bvh.parents, bvh.offsets, strict=True):
        places.append(offset if parent < 0 else places[parent] + offset)
    return torch.from_numpy(np.stack(places))


def _local(names: tuple[str, ...], values: Tensor, offset: Tensor) -> tuple[Tensor, Tensor]:
    """One joint's rotation [K, 3, 3] and place [K, 3] relative to its parent."""
    turns = [k for k, name in enumerate(names) if name in _ROTATIONS]
    rotation = torch.eye(3, dtype=values.dtype).expand(len(values), 3, 3)
    if turns:
        # Channels are applied from the last to the first, each about the axes that the earlier ones
        # have turned: intrinsic angles in the order of the columns.
        order = "".join(names[k][0] for k in turns)
        rotation = roma.euler_to_rotmat(order, values[:, turns], degrees=True)
    place = offset.expand(len(values), 3).clone()
    for k, name in enumerate(names):
        if name in _POSITIONS:
            place[:, _POSITIONS.index(name)] = values[:, k]
    return rotation, place


def _parse(text: str) -> Bvh:
    if not text.lstrip()[:9].upper() == "HIERARCHY":
        raise ValueError(f"'HIERARCHY' expected, not {text.lstrip()[:40]!r}")
    motion = _MOTION.search(text)
    if motion is None:
        raise ValueError("it has no MOTION with Frames and Frame Time")
    skeleton = _Skeleton()
    skeleton.read(iter(re.sub(r"([{}])", r" \1 ", text[: motion.start()]).split()))
    count, fps = _clock(*motion.groups())
    values = _table(text[motion.end() :], count, sum(len(own) for own in skeleton.channels))
    return Bvh(
        tuple(skeleton.names), tuple(skeleton.parents), np.array(skeleton.offsets), tuple(skeleton.channels),
        values, fps,
    )  # fmt: skip


class _Skeleton:
    """The joints of a BVH, filled in while its first part is read."""

    def __init__(self) -> None:
        self.names: list[str] = []
        self.parents: list[int] = []
        self.offsets: list[list[float]] = []
        self.channels: list[tuple[str, ...]] = []
        self._open: list[int] = []  # -1 for an end site

    def read(self, stream: Iterator[str]) -> None:
        """Reads the words from HIERARCHY to MOTION; an error of Python's where they are bad."""
        _expect(stream, "HIERARCHY")
        for word in stream:
            kind = word.upper()
            if kind in ("ROOT", "JOINT"):
                self._begin(stream)
            elif kind == "END":
                _expect(stream, "SITE")
                _expect(stream, "{")
                self._open.append(-1)
            elif kind == "OFFSET":
                self._place(stream)
            elif kind == "CHANNELS":
                self._channels(stream)
            elif word == "}":
                self._open.pop()
            else:
                raise ValueError(f"unexpected {word[:40]!r}")
        if not self.names:
            raise ValueError("no joints")
        if self._open:
            raise ValueError("a brace is not closed before MOTION")

    def _begin(self, stream: Iterator[str]) -> None:
        """A joint's name, which may be several words, and its brace."""
        self.names.append(" ".join(itertools.takewhile(lambda word: word != "{", stream)))
        if not self.names[-1]:
            raise ValueError("a joint without a name")
        if len(self.names) > _MOST_JOINTS:
            raise ValueError(f"it has more than {_MOST_JOINTS} joints")
        self.parents.append(self._open[-1] if self._open else -1)
        if self._open and self._open[-1] < 0:
            raise ValueError(f"{self.names[-1][:40]!r} hangs from an end site")
        self.offsets.append([0.0] * 3)
        self.channels.append(())
        self._open.append(len(self.names) - 1)

    def _place(self, stream: Iterator[str]) -> None:
        place = [float(next(stream)) for _ in range(3)]
        if not all(abs(number) <= _LARGEST for number in place):
            raise ValueError(f"an OFFSET of {place} is no length of a bone")
        if self._open[-1] >= 0:
            self.offsets[self._open[-1]] = place

    def _channels(self, stream: Iterator[str]) -> None:
        names = tuple(next(stream) for _ in range(int(next(stream))))
        unknown = [name[:40] for name in names if name.lower() not in _CHANNELS]
        if unknown:
            raise ValueError(f"unknown channels {sorted(set(unknown))}")
        found = tuple(_CHANNELS[name.lower()] for name in names)
        turns = [name for name in found if name in _ROTATIONS]
        if len(turns) > 3 or any(a == b for a, b in itertools.pairwise(turns)):
            raise ValueError(f"rotation channels {', '.join(turns)} are no order of angles")
        if self._open[-1] >= 0:
            self.channels[self._open[-1]] = found
        elif found:
            raise ValueError("an end site has channels")


def _clock(frames: str, frame_time: str) -> tuple[int, float]:
    """How many frames there are, and how many a second."""
    count, seconds = int(frames), float(frame_time)
    if count < 1:
        raise ValueError(f"Frames: {count} are none")
    if not 1 / _FASTEST <= seconds <= 1 / _SLOWEST:
        raise ValueError(f"Frame Time: {frame_time[:40]} is no time from one frame to the next, in seconds")
    return count, 1 / seconds


def _table(text: str, count: int, columns: int) -> np.ndarray:
    values = np.array([float(word) for word in text.split()])
    if values.size != count * columns:
        raise ValueError(f"{count} frames of {columns} channels do not make {values.size} numbers")
    if not (np.isfinite(values).all() and np.abs(values).max(initial=0) <= _LARGEST):
        raise ValueError("its table holds numbers that no capture has")
    return values.reshape(count, columns)


def _expect(stream: Iterator[str], word: str) -> None:
    found = next(stream)
    if found.upper() != word:
        raise ValueError(f"{word!r} expected, not {found[:40]!r}")
