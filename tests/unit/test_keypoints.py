"""The keypoint table: what is written is read back, and what is malformed is refused by name."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from pipeline.clip import keypoints as kp
from pipeline.errors import UserError


def some_keypoints(frames: tuple[int, ...] = (0, 1, 5)) -> kp.Keypoints:
    rng = np.random.default_rng(0)
    empty = kp.empty_keypoints(np.array(frames))
    for name in ("whole_body", "face_mesh", "pose_image", "pose_world", "hands"):
        array = getattr(empty, name)
        array[:] = rng.normal(100, 50, array.shape)
        array[..., -1] = rng.uniform(0, 1, array.shape[:-1])
    return empty


def test_round_trip_is_exact(tmp_path: Path) -> None:
    written = some_keypoints()
    kp.write_keypoints(tmp_path / "keypoints.parquet", written)
    read = kp.read_keypoints(tmp_path / "keypoints.parquet")
    for field in dataclasses.fields(kp.Keypoints):
        np.testing.assert_array_equal(getattr(read, field.name), getattr(written, field.name))
    assert read.whole_body.dtype == np.float32


def test_equal_input_gives_equal_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        kp.write_keypoints(tmp_path / name, some_keypoints())
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_no_frames_at_all_can_be_written(tmp_path: Path) -> None:
    kp.write_keypoints(tmp_path / "none", kp.empty_keypoints(np.zeros(0, int)))
    assert len(kp.read_keypoints(tmp_path / "none").frames) == 0


def test_index_finds_kept_frames_only() -> None:
    keypoints = some_keypoints()
    assert [keypoints.index(frame) for frame in (0, 1, 5)] == [0, 1, 2]
    for missing in (2, 6):
        with pytest.raises(KeyError):
            keypoints.index(missing)


def test_names_and_slices_cover_the_133_points() -> None:
    assert len(kp.NAMES) == len(set(kp.NAMES)) == kp.COUNT == 133
    assert kp.NAMES[kp.FEET] == (
        "left_big_toe", "left_small_toe", "left_heel", "right_big_toe", "right_small_toe", "right_heel",
    )  # fmt: skip
    assert kp.NAMES[kp.FACE][0] == "face_0" and kp.NAMES[kp.FACE][-1] == "face_67"
    assert kp.NAMES[kp.LEFT_HAND][0] == "left_hand_root"
    assert kp.NAMES[kp.RIGHT_HAND][-1] == "right_hand_pinky_finger4"


def test_face_mesh_table_names_distinct_vertices() -> None:
    assert len(kp.FACE_MESH_TO_IBUG68) == len(set(kp.FACE_MESH_TO_IBUG68)) == 68
    assert max(kp.FACE_MESH_TO_IBUG68) < 468


def test_unordered_frames_are_not_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="increase"):
        kp.write_keypoints(tmp_path / "k", some_keypoints((3, 1, 2)))


def test_non_finite_numbers_are_not_written(tmp_path: Path) -> None:
    keypoints = some_keypoints()
    keypoints.hands[1, 0, 3, 0] = np.inf
    with pytest.raises(ValueError, match="'hands' holds numbers that are not finite"):
        kp.write_keypoints(tmp_path / "k", keypoints)


def test_wrong_shape_is_refused() -> None:
    keypoints = some_keypoints()
    with pytest.raises(ValueError, match="hands is"):
        dataclasses.replace(keypoints, hands=keypoints.hands[:2])


def rewrite(path: Path, **columns: pa.Array) -> None:
    table = pq.read_table(path)
    for name, column in columns.items():
        table = table.set_column(table.column_names.index(name), name, column)
    pq.write_table(table, path)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_non_finite_numbers_are_refused(tmp_path: Path, value: float) -> None:
    path = tmp_path / "keypoints.parquet"
    kp.write_keypoints(path, some_keypoints())
    numbers = np.zeros(3 * 399, np.float32)
    numbers[500] = value
    rewrite(path, keypoints=pa.FixedSizeListArray.from_arrays(pa.array(numbers), 399))
    with pytest.raises(UserError, match=r"keypoints\.parquet: column 'keypoints' is not finite in row 1"):
        kp.read_keypoints(path)


def test_empty_cells_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "keypoints.parquet"
    kp.write_keypoints(path, some_keypoints())
    rewrite(path, frame=pa.array([0, None, 2], pa.int32()))
    with pytest.raises(UserError, match="'frame' has empty cells"):
        kp.read_keypoints(path)


def test_other_types_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "keypoints.parquet"
    kp.write_keypoints(path, some_keypoints())
    rewrite(path, frame=pa.array([0.0, 1.0, 2.0]))
    with pytest.raises(UserError, match="'frame' is double, not int32"):
        kp.read_keypoints(path)


def test_missing_column_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "keypoints.parquet"
    pq.write_table(pa.table({"frame": pa.array([0], pa.int32())}), path)
    with pytest.raises(UserError, match="has no column 'keypoints': run the ingest stage again"):
        kp.read_keypoints(path)


def test_repeated_frames_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "keypoints.parquet"
    kp.write_keypoints(path, some_keypoints())
    rewrite(path, frame=pa.array([4, 4, 5], pa.int32()))
    with pytest.raises(UserError, match="do not increase"):
        kp.read_keypoints(path)


def test_scores_beyond_one_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "keypoints.parquet"
    keypoints = some_keypoints()
    keypoints.whole_body[0, 0, 2] = 1.5
    kp.write_keypoints(path, keypoints)
    with pytest.raises(UserError, match="scores outside"):
        kp.read_keypoints(path)


@pytest.mark.parametrize("content", [b"", b"PAR1 and then nothing sensible PAR1"])
def test_damaged_file_is_named(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "keypoints.parquet").write_bytes(content)
    with pytest.raises(UserError, match=r"keypoints\.parquet is not a readable Parquet file"):
        kp.read_keypoints(tmp_path / "keypoints.parquet")


def test_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"keypoints\.parquet is missing: run the ingest stage again"):
        kp.read_keypoints(tmp_path / "keypoints.parquet")
