"""Identity and poses on disk."""

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

from pipeline.body import (
    Identity,
    Poses,
    load_body,
    read_identity,
    read_poses,
    write_identity,
    write_poses,
)
from pipeline.errors import UserError
from tests.made.fake_body import VERTICES, official_arrays, write_official


def draw(*shape):
    return torch.from_numpy(np.random.default_rng(len(shape)).normal(size=shape)).float()


@pytest.fixture
def poses():
    measured = torch.tensor([True, False, True])
    return Poses((3, 4, 9), draw(3, 55, 3), draw(3, 38), draw(3, 3), measured)


@pytest.fixture
def body(tmp_path):
    return load_body(write_official(tmp_path / "body.npz"))


def test_poses_come_back_as_they_were(tmp_path, poses):
    write_poses(tmp_path / "a.parquet", poses)
    write_poses(tmp_path / "b.parquet", poses)
    assert (tmp_path / "a.parquet").read_bytes() == (tmp_path / "b.parquet").read_bytes()
    back = read_poses(tmp_path / "a.parquet")
    assert back.frames == poses.frames and len(back) == 3 and back.index(9) == 2
    for name in ("rotation", "expression", "transl", "valid"):
        assert torch.equal(getattr(back, name), getattr(poses, name))
    schema = pq.read_schema(tmp_path / "a.parquet")
    assert [str(kind) for kind in schema.types] == [
        "int32",
        "fixed_size_list<element: float>[165]",
        "fixed_size_list<element: float>[38]",
        "fixed_size_list<element: float>[3]",
        "bool",
    ]


def test_poses_without_the_flag_are_all_valid(tmp_path, poses):
    path = tmp_path / "poses.parquet"
    write_poses(path, poses)
    pq.write_table(pq.read_table(path).drop_columns(["valid"]), path)
    assert read_poses(path).valid.tolist() == [True] * 3
    assert Poses((1, 2), draw(2, 55, 3), draw(2, 4), draw(2, 3)).valid.tolist() == [True] * 2


def test_a_flag_that_is_no_truth_value_names_the_file(tmp_path, poses):
    path = tmp_path / "poses.parquet"
    write_poses(path, poses)
    table = pq.read_table(path)
    pq.write_table(table.set_column(4, "valid", [[1, 2, 3]]), path)
    with pytest.raises(UserError, match="poses.parquet.*valid"):
        read_poses(path)


def test_poses_of_unequal_length_are_an_error():
    with pytest.raises(ValueError, match="rotation has shape"):
        Poses((1, 2), draw(3, 55, 3), draw(2, 4), draw(2, 3))
    with pytest.raises(ValueError, match="a row for every frame"):
        Poses((1, 2), draw(2, 55, 3), draw(3, 4), draw(2, 3))
    with pytest.raises(ValueError, match="a truth value for every frame"):
        Poses((1, 2), draw(2, 55, 3), draw(2, 4), draw(2, 3), torch.tensor([True]))


def test_no_such_frame_is_an_error(poses):
    for ask in (poses.index, poses.pose, lambda frame: poses.select([3, frame])):
        with pytest.raises(ValueError, match="no pose of frame 5"):
            ask(5)


def test_a_pose_is_found_by_its_frame_number(poses):
    pose = poses.pose(9)
    for name in ("rotation", "expression", "transl"):
        assert torch.equal(getattr(pose, name), getattr(poses, name)[2])
    assert torch.equal(pose.global_orient, poses.rotation[2, 0])


def test_poses_are_chosen_and_stacked_in_the_order_asked_for(poses):
    chosen = poses.select([9, 4])
    assert chosen.frames == (9, 4) and chosen.valid.tolist() == [True, False]
    stacked = Poses.stack(chosen.frames, [poses.pose(9), poses.pose(4)])
    assert stacked.frames == (9, 4) and stacked.valid.tolist() == [True, True]
    for name in ("rotation", "expression", "transl"):
        assert torch.equal(getattr(chosen, name), getattr(poses, name)[[2, 1]])
        assert torch.equal(getattr(stacked, name), getattr(chosen, name))


def test_damaged_poses_name_the_file_and_the_stage(tmp_path, poses):
    path = tmp_path / "poses.parquet"
    write_poses(path, poses)
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(UserError, match="poses.parquet.*fit stage"):
        read_poses(path)
    pq.write_table(__import__("pyarrow").table({"frame": [1]}), path)
    with pytest.raises(UserError, match="poses.parquet"):
        read_poses(path)


def test_identity_comes_back_as_it_was(tmp_path, body):
    identity = Identity(draw(16), draw(55, 3), draw(VERTICES, 3))
    write_identity(tmp_path / "a.safetensors", identity, body)
    write_identity(tmp_path / "b.safetensors", identity, body)
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()
    back = read_identity(tmp_path / "a.safetensors", body)
    for name in ("betas", "joint_offset", "face_offset"):
        assert torch.equal(getattr(back, name), getattr(identity, name))


def test_identity_of_another_body_is_refused(tmp_path, body):
    write_identity(tmp_path / "i.safetensors", Identity(draw(16), draw(55, 3), draw(VERTICES, 3)), body)
    template = official_arrays()["v_template"] * 1.1
    other = load_body(write_official(tmp_path / "other.npz", v_template=template))
    with pytest.raises(UserError, match="i.safetensors was fitted with another body"):
        read_identity(tmp_path / "i.safetensors", other)


def test_damaged_identity_names_the_file(tmp_path, body):
    (tmp_path / "i.safetensors").write_bytes(b"\x10")
    for name in ("i.safetensors", "none.safetensors"):
        with pytest.raises(UserError, match=name):
            read_identity(tmp_path / name, body)
