"""One frame's pose, a clip's poses, and their Parquet file."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from torch import Tensor

from pipeline.body.joints import JOINT_NAMES
from pipeline.errors import UserError, first_line
from pipeline.files.tables import open_table
from pipeline.finite import NotFiniteError, rows_not_finite

_JOINTS = len(JOINT_NAMES)


@dataclasses.dataclass(frozen=True)
class Pose:
    """One frame's pose.

    Attributes:
        rotation: theta, [55, 3], rotation vectors in radians relative to the parent joint, in the order of
            ``JOINT_NAMES``; joint 0 is global_orient.
        expression: psi, [E].
        transl: [3], metres, added to the posed body.
    """

    rotation: Tensor  # [55, 3]
    expression: Tensor  # [E]
    transl: Tensor  # [3]

    @property
    def global_orient(self) -> Tensor:
        """The root's rotation vector, [3], radians."""
        return self.rotation[0]


@dataclasses.dataclass(frozen=True)
class Poses:
    """The motion of one body over a clip.

    Attributes:
        frames: the T frame numbers in the source clip, ascending.
        rotation: theta, [T, 55, 3], rotation vectors in radians relative to the parent joint, in
            the order of ``JOINT_NAMES``; joint 0 is global_orient.
        expression: psi, [T, E].
        transl: [T, 3], metres, added to the posed body.
        valid: [T] bool, whether the frame's pose was measured: at least one keypoint of it was
            trusted. The pose of any other frame is interpolated. All True if not given.

    >>> transl = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 2.0]])
    >>> poses = Poses((0, 2), torch.zeros(2, 55, 3), torch.zeros(2, 10), transl)
    >>> poses.pose(2).transl
    tensor([0., 0., 2.])
    >>> poses.select([2]).frames
    (2,)
    """

    frames: tuple[int, ...]
    rotation: Tensor  # [T, 55, 3]
    expression: Tensor  # [T, E]
    transl: Tensor  # [T, 3]
    valid: Tensor = None  # type: ignore[assignment]  # [T]; never None once it is made

    def __post_init__(self) -> None:
        """Refuse arrays whose lengths disagree."""
        count = len(self.frames)
        if self.valid is None:
            object.__setattr__(self, "valid", torch.ones(count, dtype=torch.bool))
        if tuple(self.rotation.shape) != (count, _JOINTS, 3):
            raise ValueError(f"rotation has shape {tuple(self.rotation.shape)}, not ({count}, {_JOINTS}, 3)")
        if self.expression.shape[:-1] != (count,) or self.transl.shape != (count, 3):
            raise ValueError("expression and transl must have a row for every frame")
        if self.valid.shape != (count,) or self.valid.dtype != torch.bool:
            raise ValueError("valid must have a truth value for every frame")

    def __len__(self) -> int:
        return len(self.frames)

    @cached_property
    def _rows(self) -> Mapping[int, int]:
        return {frame: row for row, frame in enumerate(self.frames)}

    def index(self, frame: int) -> int:
        """The row of a frame number.

        Raises:
            ValueError: the clip has no such frame.
        """
        row = self._rows.get(frame)
        if row is None:
            raise ValueError(f"there is no pose of frame {frame}")
        return row

    def pose(self, frame: int) -> Pose:
        """The pose of a frame number; ValueError as of ``index``."""
        row = self.index(frame)
        return Pose(self.rotation[row], self.expression[row], self.transl[row])

    def select(self, frames: Iterable[int]) -> Poses:
        """The poses of some frame numbers, in their order; ValueError as of ``index``."""
        chosen = tuple(frames)
        rows = [self.index(frame) for frame in chosen]
        return Poses(chosen, self.rotation[rows], self.expression[rows], self.transl[rows], self.valid[rows])

    @staticmethod
    def stack(frames: Iterable[int], poses: Sequence[Pose]) -> Poses:
        """The poses of some frames as one record; at least one."""
        return Poses(
            frames=tuple(frames),
            rotation=torch.stack([pose.rotation for pose in poses]),
            expression=torch.stack([pose.expression for pose in poses]),
            transl=torch.stack([pose.transl for pose in poses]),
        )


def write_poses(path: Path, poses: Poses) -> None:
    """Write ``poses.parquet``, a row a frame.

    Columns: ``frame`` int32; ``rotation`` [165], ``expression`` [E] and ``transl`` [3], lists of float32
    of one size each; ``valid`` bool, whether the pose was measured rather than interpolated.

    Raises:
        NotFiniteError: a number is not finite; names the frame.
    """
    for name in ("rotation", "expression", "transl"):
        bad = rows_not_finite(getattr(poses, name))
        if bad:
            raise NotFiniteError(f"{path.name}: {name} of frame {poses.frames[bad[0]]} is not finite")
    columns = {
        "frame": pa.array(poses.frames, pa.int32()),
        "rotation": _column(poses.rotation.flatten(1)),
        "expression": _column(poses.expression),
        "transl": _column(poses.transl),
        "valid": pa.array(poses.valid.cpu().numpy(), pa.bool_()),
    }
    pq.write_table(pa.table(columns), path, compression="zstd")


def read_poses(path: Path) -> Poses:
    """Read what ``write_poses`` wrote; tensors are float32. Without a column ``valid`` all frames are.

    Raises:
        UserError: the file is damaged or lacks a column.
    """
    try:
        table = open_table(path)
        frames = tuple(table["frame"].to_pylist())
        rotation, expression, transl = (_rows(table, name) for name in ("rotation", "expression", "transl"))
        valid = {"valid": _truths(table, "valid")} if "valid" in table.column_names else {}
        return Poses(frames, rotation.unflatten(1, (_JOINTS, 3)), expression, transl, **valid)
    except (OSError, KeyError, ValueError, TypeError, AttributeError, RuntimeError, pa.ArrowInvalid) as error:
        raise UserError(
            f"{path} cannot be read as poses ({first_line(error)}): run the fit stage again"
        ) from error


def _column(values: Tensor) -> pa.FixedSizeListArray:
    """[T, K] -> a Parquet column of fixed-size lists of K float32."""
    array = values.detach().cpu().numpy().astype(np.float32)
    return pa.FixedSizeListArray.from_arrays(pa.array(array.ravel()), array.shape[1])


def _rows(table: pa.Table, name: str) -> Tensor:
    column = table[name].combine_chunks()
    flat = column.values.to_numpy(zero_copy_only=False).astype(np.float32)
    return torch.from_numpy(flat.reshape(len(column), column.type.list_size).copy())


def _truths(table: pa.Table, name: str) -> Tensor:
    column = table[name]
    if column.type != pa.bool_() or column.null_count:
        raise ValueError(f"column {name!r} must be true or false in every row")
    return torch.from_numpy(column.to_numpy().astype(bool))
