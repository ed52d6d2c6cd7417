"""The run-time guard: what is not finite stops a stage where it appears, by name, and is not published."""

import dataclasses
import math

import numpy as np
import pyarrow as pa
import pytest
import torch
from safetensors.torch import save_file

from pipeline import finite as guard
from pipeline.body import Poses, write_poses
from pipeline.errors import UserError, error_message
from pipeline.files.json_files import write_json
from pipeline.files.tables import write_table
from pipeline.finite import NotFiniteError, finite, require_finite, require_finite_files
from pipeline.store.artifact import Store
from stages.evaluate.frame_metrics import Scorer

BAD = [math.nan, math.inf, -math.inf]
KEY = "0123456789abcdef"


def test_it_is_an_error_that_a_user_reads(tmp_path):
    assert error_message(NotFiniteError("said"), tmp_path) == "said"
    assert issubclass(NotFiniteError, UserError) and issubclass(NotFiniteError, ValueError)


@pytest.mark.parametrize("value", BAD)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.float16, torch.bfloat16])
def test_one_bad_number_is_found_and_named(value, dtype):
    tensors = {"first": torch.ones(5), "second": torch.zeros(3, 4, dtype=dtype), "third": torch.ones(2)}
    assert finite(tensors.values())
    require_finite(tensors, "training", "at iteration 3", "do this")
    tensors["second"][1, 2] = value
    what = r"training stopped: second is not finite at iteration 3"
    message = rf"{what} \(1 of 12 numbers, the first {value} at \[1, 2\]\); do this"
    with pytest.raises(NotFiniteError, match=message):
        require_finite(tensors, "training", "at iteration 3", "do this")


def test_infinities_of_both_signs_do_not_cancel():
    assert not finite([torch.tensor([math.inf, -math.inf])])
    assert not finite([torch.tensor([math.inf]), torch.tensor([-math.inf])])


def test_large_numbers_that_overflow_together_are_finite():
    huge = {"huge": torch.full((100,), 3e38), "half": torch.full((100,), 6e4, dtype=torch.float16)}
    require_finite(huge, "training", "now", "nothing")


def test_whole_numbers_truths_and_nothing_are_finite():
    require_finite(
        {"a": torch.arange(5), "b": torch.ones(3, dtype=torch.bool), "c": torch.zeros(0)}, "a", "b", "c"
    )
    assert finite([])


def test_the_rows_at_fault():
    values = torch.zeros(5, 2, 3)
    values[1, 0, 0], values[4, 1, 2] = math.nan, math.inf
    assert guard.rows_not_finite(values) == [1, 4]


# Files


@pytest.mark.parametrize("value", BAD)
def test_a_table_names_column_row_and_frame(tmp_path, value):
    schema = pa.schema([("frame", pa.int32()), ("value", pa.float32())])
    columns = {"frame": np.array([3, 8]), "value": np.array([0.0, value], np.float32)}
    with pytest.raises(NotFiniteError, match="column 'value' holds .* the first in row 1, frame 8"):
        write_table(tmp_path / "t.parquet", schema, columns)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("field", ["rotation", "expression", "transl"])
def test_poses_name_the_frame(tmp_path, field):
    poses = Poses((3, 8), torch.zeros(2, 55, 3), torch.zeros(2, 4), torch.zeros(2, 3))
    values = getattr(poses, field).clone()
    values[1].view(-1)[0] = math.nan
    with pytest.raises(NotFiniteError, match=f"poses.parquet: {field} of frame 8 is not finite"):
        write_poses(tmp_path / "poses.parquet", dataclasses.replace(poses, **{field: values}))
    assert not list(tmp_path.iterdir())


def test_json_names_the_place(tmp_path):
    with pytest.raises(NotFiniteError, match="s.json: means.test.1.psnr is not finite"):
        write_json(tmp_path / "s.json", {"means": {"test": [{"psnr": 1.0}, {"psnr": math.nan}]}})
    assert not list(tmp_path.iterdir())


def bad_safetensors(path):
    save_file(
        {"good": torch.ones(3), "weight": torch.tensor([1.0, math.nan])}, path.with_suffix(".safetensors")
    )


def bad_half(path):
    save_file(
        {"weight": torch.tensor([1.0, math.inf], dtype=torch.bfloat16)}, path.with_suffix(".safetensors")
    )


def bad_npz(path):
    np.savez(path.with_suffix(".npz"), good=np.ones(3), weight=np.array([[1.0, -math.inf]]))


def bad_npy(path):
    np.save(path.with_suffix(".npy"), np.array([math.nan]))


@pytest.mark.parametrize("write", [bad_safetensors, bad_half, bad_npz, bad_npy])
def test_a_version_with_a_bad_array_is_not_published(tmp_path, write):
    store = Store(tmp_path)
    with store.scratch("me", "train", KEY, lambda: None) as scratch:
        (scratch.output / "sub").mkdir()
        write(scratch.output / "sub" / "file")
        with pytest.raises(NotFiniteError, match=r"not published: \w+ of file\.\w+ is not finite; run the"):
            store.publish(scratch, "me", "train", KEY, {}, {})
    assert store.find("me", "train", KEY) is None and store.latest("me", "train") is None


def test_good_arrays_of_any_type_are_published(tmp_path):
    store = Store(tmp_path)
    with store.scratch("me", "train", KEY, lambda: None) as scratch:
        tensors = {
            "half": torch.full((4,), 6e4, dtype=torch.float16),
            "brain": torch.full((4,), 3e38, dtype=torch.bfloat16),
            "count": torch.arange(4),
            "kept": torch.ones(4, dtype=torch.bool),
            "none": torch.zeros(0),
        }
        save_file(tensors, scratch.output / "a.safetensors")
        np.savez(scratch.output / "b.npz", words=np.array(["x"]), huge=np.full(4, 1.7e308))
        store.publish(scratch, "me", "train", KEY, {}, {})
    assert store.latest("me", "train").key == KEY


def test_array_files_of_other_kinds_are_left_alone(tmp_path):
    (tmp_path / "note.txt").write_text("nan")
    require_finite_files(tmp_path, "nothing")


def test_a_picture_that_is_not_finite_is_not_scored():
    image = torch.zeros(12, 12, 3)
    image[3, 4, 0] = math.nan
    with pytest.raises(NotFiniteError, match="scoring stopped: a picture is not finite"):
        Scorer({}).picture(image)
