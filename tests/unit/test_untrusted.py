"""Hostile and damaged files: nothing of them is executed, no memory is taken for what they claim."""

import io
import os
import pickle
import struct
import tracemalloc
import zipfile
import zlib

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.sparse
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.body import read_poses
from pipeline.clip.keypoints import read_keypoints
from pipeline.clip.records import read_cameras
from pipeline.errors import UserError
from pipeline.untrusted import (
    check_picture,
    inside,
    parse_json,
    read_npy,
    read_npz,
    read_numbers,
    read_pickle,
    read_torch,
)
from stages.ingest.mask_files import read_given_mask
from stages.ingest.video import read_picture

REMEDY = "get it again"
VALUE = {
    "a": torch.arange(6.0).reshape(2, 3),
    "turned": torch.arange(6).reshape(2, 3).T,
    "part": torch.arange(10.0)[3:5],
    "empty": torch.zeros(0, 3),
    "truth": torch.tensor([True, False]),
    "half": torch.tensor([0.5, 2.0], dtype=torch.float16),
    "array": np.asfortranarray(np.arange(6, dtype=np.float32).reshape(2, 3)),
    "big": np.arange(3, dtype=">i4"),
    "scalar": np.float64(2.5),
    "parameter": torch.nn.Parameter(torch.ones(2)),
    "plain": [1, "x", (2.5, None), {"k": b"raw"}],
}


class Evil:
    """A pickle of it runs a command when it is read."""

    def __init__(self, victim):
        self.victim = victim

    def __reduce__(self):
        return os.system, (f"touch {self.victim}",)


def same(found):
    for name, value in VALUE.items():
        if isinstance(value, torch.Tensor):
            assert found[name].dtype == value.detach().numpy().dtype, name
            np.testing.assert_array_equal(found[name], value.detach().numpy())
        elif isinstance(value, np.ndarray):
            np.testing.assert_array_equal(found[name], value)
        else:
            assert found[name] == value, name


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_pickles_of_arrays_and_tensors_are_read(tmp_path, protocol):
    (tmp_path / "x.pkl").write_bytes(pickle.dumps(VALUE, protocol))
    same(read_pickle(tmp_path / "x.pkl", REMEDY))


@pytest.mark.parametrize("zipped", [True, False])
def test_torch_files_are_read(tmp_path, zipped):
    torch.save(VALUE, tmp_path / "x.pt", _use_new_zipfile_serialization=zipped)
    same(read_torch(tmp_path / "x.pt", REMEDY))


def test_npy_with_objects_and_npz_are_read(tmp_path):
    annots = {"cams": {"K": [np.eye(3)] * 2}, "ims": [{"ims": ["a/0.jpg", "b/0.jpg"]}]}
    np.save(tmp_path / "o.npy", annots, allow_pickle=True)
    found = read_npy(tmp_path / "o.npy", REMEDY)
    assert found["ims"] == annots["ims"]
    np.testing.assert_array_equal(found["cams"]["K"][1], np.eye(3))
    np.save(tmp_path / "n.npy", np.arange(6).reshape(2, 3))
    np.testing.assert_array_equal(read_npy(tmp_path / "n.npy", REMEDY), np.arange(6).reshape(2, 3))
    np.savez_compressed(tmp_path / "z.npz", a=np.ones(3), b=np.zeros((2, 2)))
    assert read_npz(tmp_path / "z.npz", REMEDY)["b"].shape == (2, 2)


@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_a_pickle_that_would_run_a_command_is_refused(tmp_path, protocol):
    victim = tmp_path / "victim"
    content = pickle.dumps({"poses": np.zeros(3), "evil": Evil(victim)}, protocol)
    (tmp_path / "e.pkl").write_bytes(content)
    np.save(tmp_path / "e.npy", {"evil": Evil(victim)}, allow_pickle=True)
    torch.save({"evil": Evil(victim)}, tmp_path / "e.pt")
    torch.save({"evil": Evil(victim)}, tmp_path / "old.pt", _use_new_zipfile_serialization=False)
    for name, read in (
        ("e.pkl", read_pickle),
        ("e.npy", read_npy),
        ("e.pt", read_torch),
        ("old.pt", read_torch),
    ):
        with pytest.raises(UserError, match=rf"{name} cannot be read.*system.*{REMEDY}"):
            read(tmp_path / name, REMEDY)
    assert not victim.exists()


def test_a_torch_storage_may_not_carry_a_command_either(tmp_path):
    victim = tmp_path / "victim"

    class Hidden:
        def __reduce__(self):
            return torch.storage._load_from_bytes, (pickle.dumps(Evil(victim)),)

    class Tensor:
        def __reduce__(self):
            return torch._utils._rebuild_tensor_v2, (Hidden(), 0, (1,), (1,), False, {})

    (tmp_path / "e.pkl").write_bytes(pickle.dumps({"transl": Tensor()}))
    with pytest.raises(UserError, match="e.pkl cannot be read"):
        read_pickle(tmp_path / "e.pkl", REMEDY)
    assert not victim.exists()


@pytest.mark.parametrize("size, stride", [((1 << 30,), (0,)), ((4,), (1,)), ((2, 2), (5, 1)), ((2,), (1, 1))])
def test_tensors_may_not_reach_out_of_their_storage(tmp_path, size, stride):
    class Tensor:
        def __reduce__(self):
            storage = torch.arange(3.0).untyped_storage()
            typed = torch.storage.TypedStorage(wrap_storage=storage, dtype=torch.float32, _internal=True)
            return torch._utils._rebuild_tensor_v2, (typed, 0, size, stride, False, {})

    (tmp_path / "t.pkl").write_bytes(pickle.dumps(Tensor()))
    with pytest.raises(UserError, match="t.pkl cannot be read"):
        read_pickle(tmp_path / "t.pkl", REMEDY)


def test_shared_containers_do_not_unroll_without_end(tmp_path):
    bomb = ["x"]
    for _ in range(30):
        bomb = [bomb] * 10  # a few hundred bytes that stand for 10^30 values
    (tmp_path / "b.pkl").write_bytes(pickle.dumps(bomb))
    with pytest.raises(UserError, match="unrolls to too much"):
        read_pickle(tmp_path / "b.pkl", REMEDY)


def test_shared_arrays_do_not_unroll_without_end(tmp_path):
    (tmp_path / "b.pkl").write_bytes(pickle.dumps([np.zeros(100_000)] * 100))
    with pytest.raises(UserError, match="more numbers than is allowed"):
        read_pickle(tmp_path / "b.pkl", REMEDY, most_bytes=1 << 20)


@pytest.mark.parametrize("kind", ["csc_matrix", "csr_matrix"])
def test_sparse_matrices_are_read_and_may_not_reach_out_of_themselves(tmp_path, kind):
    matrix = getattr(scipy.sparse, kind)(np.diag([1.0, 2.0, 3.0]))
    (tmp_path / "s.pkl").write_bytes(pickle.dumps(matrix))
    np.testing.assert_array_equal(read_pickle(tmp_path / "s.pkl", REMEDY), matrix.toarray())
    matrix.indices[0] = 1 << 20  # scipy would write there
    (tmp_path / "s.pkl").write_bytes(pickle.dumps(matrix))
    with pytest.raises(UserError, match=r"s\.pkl cannot be read"):
        read_pickle(tmp_path / "s.pkl", REMEDY)
    matrix = getattr(scipy.sparse, kind)((1 << 24, 1 << 24))  # 2 PB if it were dense
    (tmp_path / "s.pkl").write_bytes(pickle.dumps(matrix))
    with pytest.raises(UserError, match=r"s\.pkl cannot be read"):
        read_pickle(tmp_path / "s.pkl", REMEDY)


def test_a_pickle_cannot_change_what_a_name_stands_for(tmp_path):
    (tmp_path / "e.pkl").write_bytes(b"(lp0\n0c_codecs\nencode\n(N}V__defaults__\n(Vascii\ntstb0N.")
    (tmp_path / "x.pkl").write_bytes(pickle.dumps(VALUE, 2))
    assert read_pickle(tmp_path / "e.pkl", REMEDY) is None
    same(read_pickle(tmp_path / "x.pkl", REMEDY))


@pytest.mark.parametrize("damage", ["sum", "storage"])
def test_a_torch_file_whose_numbers_are_not_what_was_saved_is_refused(tmp_path, damage):
    torch.save(torch.arange(3.0), tmp_path / "x.pt", _use_new_zipfile_serialization=damage == "sum")
    content = (tmp_path / "x.pt").read_bytes()
    raw = torch.arange(3.0).numpy().tobytes()
    assert content.count(raw) == 1
    if damage == "sum":
        content = content.replace(raw, raw[:-1] + b"\x01")
    else:  # the pickle after the object lists the keys of the storages: none
        start = content.rindex(b"\x80\x02]")
        content = content[:start] + b"\x80\x02]." + content[content.index(raw) - 8 :]
    (tmp_path / "x.pt").write_bytes(content)
    with pytest.raises(UserError, match=r"x\.pt cannot be read"):
        read_torch(tmp_path / "x.pt", REMEDY)


def peak_while(call):
    tracemalloc.start()
    try:
        with pytest.raises(UserError) as caught:
            call()
        return tracemalloc.get_traced_memory()[1], str(caught.value)
    finally:
        tracemalloc.stop()


def test_lengths_that_are_not_there_take_no_memory(tmp_path):
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
    (tmp_path / "big.npy").write_bytes(header.getvalue() + b"\0" * 64)
    (tmp_path / "big.pkl").write_bytes(b"\x80\x04\x8e" + struct.pack("<Q", 1 << 36) + b"x.")
    with zipfile.ZipFile(tmp_path / "big.pt", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("x/data.pkl", pickle.dumps({}))
        archive.writestr("x/data/0", b"\0" * (64 << 20))
    for name, call in (
        ("big.npy", lambda: read_npy(tmp_path / "big.npy", REMEDY)),
        ("big.pkl", lambda: read_pickle(tmp_path / "big.pkl", REMEDY)),
        ("big.pt", lambda: read_torch(tmp_path / "big.pt", REMEDY, most_bytes=1 << 20)),
    ):
        peak, said = peak_while(call)
        assert peak < 16 << 20 and name in said and REMEDY in said


def png_header(width, height):
    def chunk(name, body):
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    size = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", size) + chunk(b"IDAT", zlib.compress(b"\0" * 1000))


def test_a_png_of_a_hundred_gigapixels_is_refused_by_its_header(tmp_path):
    path = tmp_path / "00001.png"
    path.write_bytes(png_header(400_000, 250_000) + b"\0" * 100)
    for call in (
        lambda: check_picture(path, REMEDY),
        lambda: read_picture(path),
        lambda: read_given_mask(path, 64, 64),
    ):
        peak, said = peak_while(call)
        assert peak < 32 << 20 and "00001.png" in said and "pixels" in said
    path.write_bytes(png_header(12_000, 12_000))
    with pytest.raises(UserError, match="12000x12000"):
        check_picture(path, REMEDY)


@pytest.mark.parametrize(
    "name", ["../secret.png", "a/../../secret.png", "/etc/passwd", "..\\secret.png", "C:\\x.png"]
)
def test_names_may_not_lead_out_of_their_folder(tmp_path, name):
    (tmp_path / "data").mkdir()
    with pytest.raises(UserError, match="list.txt names .* outside"):
        inside(tmp_path / "data", name, tmp_path / "list.txt")


def test_links_may_not_lead_out_of_their_folder(tmp_path):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "link").symlink_to(tmp_path)
    with pytest.raises(UserError, match="a link out of"):
        inside(tmp_path / "data", "link/secret.png", tmp_path / "list.txt")
    assert inside(tmp_path / "data", "a/b.png", tmp_path / "l") == tmp_path / "data" / "a" / "b.png"


BAD_JSON = (
    '{"a": NaN}',
    '{"a": Infinity}',
    "[-Infinity]",
    "[1e999]",
    "",
    "[" * 100_000,
    '{"a": 1',
    "\xff",
    "[" + "9" * 5000 + "]",
)


@pytest.mark.parametrize("text", BAD_JSON, ids=range(len(BAD_JSON)))
def test_json_that_is_none_or_not_finite_names_itself(tmp_path, text):
    (tmp_path / "t.json").write_bytes(text.encode("latin1"))
    with pytest.raises(UserError, match=r"t\.json is not readable JSON"):
        parse_json(tmp_path / "t.json", REMEDY)


def test_missing_json_is_named(tmp_path):
    with pytest.raises(UserError, match=rf"t\.json is missing: {REMEDY}"):
        parse_json(tmp_path / "t.json", REMEDY)


def test_json_with_a_million_keys_is_refused(tmp_path):
    keys = ",".join(f'"{n}":0' for n in range(1_000_000))
    (tmp_path / "t.json").write_text(f"{{{keys}}}")
    with pytest.raises(UserError, match="more than 500000 keys"):
        parse_json(tmp_path / "t.json", REMEDY)
    with pytest.raises(UserError, match="more than the 1 MB"):
        parse_json(tmp_path / "t.json", REMEDY, most_bytes=1 << 20)


def test_frame_lists_hold_frame_numbers_only(tmp_path):
    path = tmp_path / "list.txt"
    path.write_text("00012.png\n00003.png\n")
    assert read_numbers(path, REMEDY, ".png") == [3, 12]
    for text in ("../../x.png", "1e3", "-4", "٣", "9" * 30, ""):
        path.write_text(f"{text}\n")
        with pytest.raises(UserError, match=r"list\.txt"):
            read_numbers(path, REMEDY)


@pytest.mark.parametrize("read", [read_poses, read_cameras, read_keypoints])
def test_parquet_of_wrong_types_names_itself(tmp_path, read):
    path = tmp_path / "p.parquet"
    names = ["frame", "rotation", "expression", "transl", "width", "height", "intrinsics", "translation"]
    for column in (["x", "y"], [1.5, None], [[1.0], [2.0, 3.0]], [{"a": 1}, {"a": 2}]):
        pq.write_table(pa.table({name: pa.array(column) for name in names}), path)
        with pytest.raises(UserError, match=r"p\.parquet"):
            read(path)
    path.write_bytes(b"PAR1nothingPAR1")
    with pytest.raises(UserError, match=r"p\.parquet"):
        read(path)


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=200), st.integers(0, 3))
def test_any_bytes_are_one_clear_error_or_plain_data(tmp_path_factory, junk, kind):
    path = tmp_path_factory.mktemp("junk") / "junk"
    starts = [b"", b"\x80\x04", b"\x93NUMPY\x01\x00", pickle.dumps(VALUE["array"])[:60]]
    path.write_bytes(starts[kind] + junk)
    for read in (read_pickle, read_npy, read_torch, read_npz):
        try:
            read(path, REMEDY)
        except UserError as error:
            assert str(path) in str(error) and REMEDY in str(error)
