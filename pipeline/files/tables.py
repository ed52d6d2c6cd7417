"""Parquet tables with a declared schema: written the same way always, refused when they differ.

Every table of the project goes through these two functions, so that a reader may trust the columns,
their types and that every number in them is finite.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.errors import UserError
from pipeline.finite import NotFiniteError

MOST_BYTES = 4 << 30  # an hour of keypoints unpacks to half of it


def vectors(length: int, kind: pa.DataType | None = None) -> pa.DataType:
    """The column type of ``length`` numbers a row, float32 unless ``kind`` says otherwise."""
    return pa.list_(kind or pa.float32(), length)


def write_table(path: Path, schema: pa.Schema, columns: dict[str, np.ndarray]) -> None:
    """Write arrays as the columns of ``schema``.

    Args:
        path: the Parquet file.
        schema: names and types; a fixed-size list column of length L takes an array whose rows
            hold L numbers in any shape.
        columns: one array for each name in the schema, all of the same first dimension.

    Raises:
        ValueError: a column is missing or has another length.
        NotFiniteError: a number is not finite; names its column, row and, if it has one, frame.
    """
    if set(columns) != set(schema.names):
        raise ValueError(f"{path.name}: columns {sorted(columns)} are not {sorted(schema.names)}")
    _require_finite(path.name, columns)
    arrays = [_to_arrow(path.name, field, np.asarray(columns[field.name])) for field in schema]
    if len({len(array) for array in arrays}) > 1:
        raise ValueError(f"{path.name}: its columns have different lengths")
    pq.write_table(pa.table(arrays, schema=schema), path, compression="zstd")


def read_table(path: Path, schema: pa.Schema, remedy: str) -> dict[str, np.ndarray]:
    """Read the columns of ``schema``; further columns are left alone.

    Args:
        path: the Parquet file.
        schema: names and types that must be there.
        remedy: what the user can do when the file is bad; it ends the error's line.

    Returns:
        One array a column; fixed-size lists of length L become [rows, L].

    Raises:
        UserError: the file is missing or unreadable, a column is missing or of another type, or a
            value is null or not finite.
    """
    try:
        table = open_table(path)
    except FileNotFoundError:
        raise UserError(f"{path} is missing: {remedy}") from None
    except (pa.ArrowException, OSError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(f"{path} is not a readable Parquet file ({reason}): {remedy}") from None
    return {field.name: _from_arrow(path, field, table, remedy) for field in schema}


def open_table(path: Path) -> pa.Table:
    """Read a whole Parquet file that does not unpack to more than ``MOST_BYTES``.

    Raises:
        OSError, pa.ArrowException: it is missing, damaged, or too large.
    """
    with pq.ParquetFile(path) as file:
        groups = [file.metadata.row_group(number) for number in range(file.metadata.num_row_groups)]
        if sum(group.total_byte_size for group in groups) > MOST_BYTES:
            raise pa.ArrowInvalid(f"it unpacks to more than {MOST_BYTES >> 30} GB")
        return file.read()


def _require_finite(name: str, columns: dict[str, np.ndarray]) -> None:
    for column, values in columns.items():
        array = np.asarray(values)
        if array.dtype.kind != "f" or np.isfinite(array).all():
            continue
        row = int(np.flatnonzero(~np.isfinite(array.reshape(len(array), -1)).all(1))[0])
        frame = f", frame {columns['frame'][row]}" if "frame" in columns else ""
        raise NotFiniteError(
            f"{name}: column {column!r} holds numbers that are not finite, the first in row {row}{frame}"
        )


def _to_arrow(name: str, field: pa.Field, array: np.ndarray) -> pa.Array:
    if not pa.types.is_fixed_size_list(field.type):
        return pa.array(array, type=field.type)
    flat = pa.array(np.ascontiguousarray(array).reshape(-1), type=field.type.value_type)
    rows = pa.FixedSizeListArray.from_arrays(flat, field.type.list_size)
    if len(rows) != len(array):
        raise ValueError(f"{name}: column {field.name!r} needs {field.type.list_size} numbers a row")
    return rows


def _from_arrow(path: Path, field: pa.Field, table: pa.Table, remedy: str) -> np.ndarray:
    if field.name not in table.column_names:
        raise UserError(f"{path} has no column {field.name!r}: {remedy}")
    column = table.column(field.name)
    if column.type != field.type:
        raise UserError(f"{path}: column {field.name!r} is {column.type}, not {field.type}: {remedy}")
    if column.null_count:
        raise UserError(f"{path}: column {field.name!r} has empty cells: {remedy}")
    chunk = column.combine_chunks()
    if pa.types.is_fixed_size_list(field.type):
        flat = chunk.flatten()
        if flat.null_count:
            raise UserError(f"{path}: column {field.name!r} has empty cells: {remedy}")
        array = flat.to_numpy(zero_copy_only=False).reshape(len(column), field.type.list_size)
    else:
        array = chunk.to_numpy(zero_copy_only=False)
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        row = int(np.flatnonzero(~np.isfinite(array.reshape(len(array), -1)).all(1))[0])
        raise UserError(f"{path}: column {field.name!r} is not finite in row {row}: {remedy}")
    return np.array(array)
