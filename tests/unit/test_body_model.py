"""Reading bodies of the SMPL-X schema: ours, the official layouts, and files that are none."""

import pickle
import zipfile

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from pipeline.body import JOINT_NAMES, load_body
from pipeline.config.workspace import REPOSITORY
from pipeline.errors import UserError
from tests.made.fake_body import PARENTS, VERTICES, Trap, official_arrays, write_official

OPEN_BODY = REPOSITORY / "data/body/open_body.npz"


def test_open_body_has_the_schema(body):
    count, triangles = len(body.v_template), len(body.faces)
    assert body.skinning_weights.shape == (count, 55) and body.joint_regressor.shape == (55, count)
    assert body.shape_directions.shape == (count, 3, 16)
    assert body.expression_directions.shape == (count, 3, 38)
    assert body.uv_faces.shape == (triangles, 3) and body.uv_faces.max() < len(body.uv)
    assert body.pose_directions is None, "zeros must not cost a matrix product"
    assert body.parents == PARENTS and body.joint_names == JOINT_NAMES
    torch.testing.assert_close(body.skinning_weights.sum(1), torch.ones(count))
    torch.testing.assert_close(body.joint_regressor.sum(1), torch.ones(55))
    assert (body.skinning_weights > 0).sum(1).max() <= 6


def test_open_body_stands_upright_faces_z_and_has_its_left_at_x(body):
    joints = dict(zip(body.joint_names, body.joint_regressor @ body.v_template, strict=True))
    assert joints["head"][1] > joints["pelvis"][1] > joints["left_ankle"][1]
    assert joints["left_wrist"][0] > 0.6 and joints["right_wrist"][0] < -0.6
    assert joints["left_eye"][2] > joints["head"][2] and joints["left_foot"][2] > joints["left_ankle"][2]
    height = body.v_template[:, 1].max() - body.v_template[:, 1].min()
    assert 1.6 < height < 1.85
    volume = torch.linalg.det(body.v_template[body.faces]).sum() / 6
    assert 0.05 < volume < 0.1, "triangles must be counter-clockwise from outside, round a person's volume"


def test_open_body_is_symmetric(body):
    vertices = body.v_template.numpy()
    distances, _ = cKDTree(vertices).query(vertices * [-1, 1, 1])
    assert distances.max() < 1e-4


def test_joints_hold_still_under_expressions(body):
    moved = torch.einsum("jv,vck->jkc", body.joint_regressor, body.expression_directions)
    assert moved.norm(dim=-1).max() < 1e-3


@pytest.mark.parametrize(("columns", "shapes", "expressions"), [(400, 300, 100), (20, 10, 10)])
def test_official_layouts_load_and_objects_stay_pickled(tmp_path, columns, shapes, expressions):
    arrays = official_arrays(columns)
    path = write_official(tmp_path / "SMPLX_NEUTRAL.npz", trap=tmp_path / "unpickled", columns=columns)
    body = load_body(path)
    assert body.shape_directions.shape == (VERTICES, 3, shapes)
    assert body.expression_directions.shape == (VERTICES, 3, expressions)
    np.testing.assert_allclose(body.shape_directions, arrays["shapedirs"][..., :shapes], rtol=1e-6)
    np.testing.assert_allclose(body.expression_directions, arrays["shapedirs"][..., shapes:], rtol=1e-6)
    np.testing.assert_allclose(body.pose_directions, arrays["posedirs"], rtol=1e-6)
    assert body.parents == PARENTS
    assert not (tmp_path / "unpickled").exists()
    assert pickle.loads(pickle.dumps(Trap(tmp_path / "unpickled"))) is None
    assert (tmp_path / "unpickled").exists(), "the trap works, so the test above means something"


def test_trailing_zero_columns_are_dropped(tmp_path):
    directions = official_arrays()["shapedirs"]
    directions[:, :, 12:300] = 0
    directions[:, :, 307:] = 0
    body = load_body(write_official(tmp_path / "b.npz", shapedirs=directions))
    assert body.shape_directions.shape[2] == 12 and body.expression_directions.shape[2] == 7


def test_digest_and_topology_follow_the_content_not_the_packing(tmp_path):
    plain = load_body(write_official(tmp_path / "a.npz"))
    arrays = official_arrays()
    single = {name: a.astype(np.float32) for name, a in arrays.items() if a.dtype == np.float64}
    np.savez_compressed(tmp_path / "b.npz", **(arrays | single))
    assert load_body(tmp_path / "b.npz").digest == plain.digest
    other = load_body(write_official(tmp_path / "c.npz", v_template=arrays["v_template"] + 0.1))
    assert other.digest != plain.digest and other.topology == plain.topology
    turned = load_body(write_official(tmp_path / "d.npz", f=arrays["f"][:, ::-1]))
    assert turned.topology != plain.topology


def test_uv_is_optional(tmp_path):
    body = load_body(write_official(tmp_path / "b.npz", vt=None, ft=None, posedirs=None))
    assert body.uv.shape == (0, 2) and body.uv_faces.shape == (0, 3) and body.pose_directions is None


def _with(name, index, value):
    array = official_arrays()[name].astype(float)
    array[index] = value
    return {name: array}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"weights": None}, "no array 'weights'"),
        ({"v_template": np.zeros((VERTICES, 2))}, "v_template has shape"),
        ({"J_regressor": np.zeros((24, VERTICES))}, "J_regressor has shape"),
        ({"shapedirs": np.zeros((VERTICES, 3, 37))}, "37 columns"),
        ({"v_template": np.full((VERTICES, 3), "x")}, "dtype"),
        ({"f": np.full((40, 3), VERTICES)}, "f holds indices"),
        ({"weights": np.zeros((VERTICES, 55))}, "sum to 1"),
        ({"kintree_table": np.zeros((2, 55), int) + 54}, "no tree"),
        (_with("v_template", (3, 1), np.nan), "not finite"),
        (_with("shapedirs", (3, 1, 5), np.inf), "not finite"),
    ],
)
def test_malformed_bodies_are_refused_by_name(tmp_path, changes, said):
    path = write_official(tmp_path / "SMPLX_BROKEN.npz", **changes)
    with pytest.raises(UserError, match=said) as caught:
        load_body(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_a_needed_object_array_is_refused_and_stays_pickled(tmp_path):
    trap = np.array([Trap(tmp_path / "unpickled")], dtype=object)
    path = write_official(tmp_path / "b.npz", shapedirs=trap)
    with pytest.raises(UserError, match="without unpickling"):
        load_body(path)
    assert not (tmp_path / "unpickled").exists()


def test_files_that_are_no_npz_are_refused(tmp_path):
    whole = write_official(tmp_path / "whole.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "text.npz").write_text("not a body")
    (tmp_path / "empty.npz").write_bytes(b"")
    np.save(tmp_path / "single.npy", np.zeros(3))
    (tmp_path / "pickle.npz").write_bytes(pickle.dumps(Trap(tmp_path / "unpickled")))
    with zipfile.ZipFile(tmp_path / "bytes.npz", "w") as archive:
        archive.writestr("v_template", b"\x00" * 40)
    for name in ("cut.npz", "text.npz", "empty.npz", "single.npy", "pickle.npz", "bytes.npz", "none.npz"):
        with pytest.raises(UserError, match=name):
            load_body(tmp_path / name)
    assert not (tmp_path / "unpickled").exists()


def test_a_flipped_byte_is_refused(tmp_path):
    data = bytearray(write_official(tmp_path / "b.npz").read_bytes())
    data[len(data) // 2] ^= 0xFF  # inside the large shapedirs: the archive's checksum catches it
    (tmp_path / "b.npz").write_bytes(data)
    with pytest.raises(UserError, match="b.npz"):
        load_body(tmp_path / "b.npz")


def test_to_casts_numbers_and_leaves_indices(tmp_path):
    body = load_body(write_official(tmp_path / "b.npz")).to(torch.float64)
    assert body.v_template.dtype == torch.float64 and body.faces.dtype == torch.int64
