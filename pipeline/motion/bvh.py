"""Reading BVH, the text format of motion capture: a skeleton of offsets and a table of angles."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import roma
import torch
from torch import Tensor

from pipeline.errors import UserError
from pipeline.untrusted import bounded_bytes

_MOST_BYTES = 256 << 20  # an hour of 60 joints at 30 frames a second has some 120 MB
_POSITIONS = ("Xposition", "Yposition", "Zposition")
_ROTATIONS = ("Xrotation", "Yrotation", "Zrotation")


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

    Raises:
        UserError: the file is missing or too large, is no BVH, or its table does not fit its skeleton.
    """
    content = bounded_bytes(Path(path), _MOST_BYTES, "name another BVH file")
    try:
        return _parse(content.decode("utf-8", errors="replace").split())
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


def _parse(words: list[str]) -> Bvh:
    stream = iter(words)
    _expect(stream, "HIERARCHY")
    names: list[str] = []
    parents: list[int] = []
    offsets: list[list[float]] = []
    channels: list[tuple[str, ...]] = []
    open_joints: list[int] = []  # -1 for an end site
    for word in stream:
        if word in ("ROOT", "JOINT"):
            names.append(next(stream))
            parents.append(open_joints[-1] if open_joints else -1)
            offsets.append([0.0] * 3)
            channels.append(())
            _expect(stream, "{")
            open_joints.append(len(names) - 1)
        elif word == "End":
            _expect(stream, "Site")
            _expect(stream, "{")
            open_joints.append(-1)
        elif word == "OFFSET":
            place = [float(next(stream)) for _ in range(3)]
            if open_joints[-1] >= 0:
                offsets[open_joints[-1]] = place
        elif word == "CHANNELS":
            channels[open_joints[-1]] = tuple(next(stream) for _ in range(int(next(stream))))
        elif word == "}":
            open_joints.pop()
        elif word == "MOTION":
            break
        else:
            raise ValueError(f"unexpected {word!r}")
    values, fps = _table(stream, sum(len(own) for own in channels))
    unknown = {name for own in channels for name in own} - {*_POSITIONS, *_ROTATIONS}
    if unknown or not names:
        raise ValueError(f"unknown channels {sorted(unknown)}" if unknown else "no joints")
    return Bvh(tuple(names), tuple(parents), np.array(offsets), tuple(channels), values, fps)


def _table(stream: Iterator[str], columns: int) -> tuple[np.ndarray, float]:
    _expect(stream, "Frames:")
    count = int(next(stream))
    _expect(stream, "Frame")
    _expect(stream, "Time:")
    seconds = float(next(stream))
    values = np.array([float(word) for word in stream])
    if count < 1 or not seconds > 0 or values.size != count * columns or not np.isfinite(values).all():
        raise ValueError(f"{count} frames of {columns} channels do not make {values.size} numbers")
    return values.reshape(count, columns), 1 / seconds


def _expect(stream: Iterator[str], word: str) -> None:
    found = next(stream)
    if found != word:
        raise ValueError(f"{word!r} expected, not {found!r}")
