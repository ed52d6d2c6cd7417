"""Reading other programs' poses, and the axes that they are in."""

import json
import math

import numpy as np
import pytest
import roma
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipeline.body import joint_index, posed_joints
from pipeline.clip.camera import facing_camera
from pipeline.errors import UserError
from pipeline.pose_files import into_camera, into_world, moved_pivot, read_hand_mean, read_smplx_json
from tests.made.fake_body import PARENTS, write_official

FLAT = torch.zeros(30, 3)
FAST = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def draw(*shape, seed=0, scale=1.0):
    return scale * torch.from_numpy(np.random.default_rng(seed).normal(size=shape))


def parameters(seed=0, **changes):
    """What SMPLest-X writes for a frame."""
    numbers = 0.3 * np.random.default_rng(seed).normal(size=(55, 3))
    value = {
        "root_pose": numbers[0].tolist(),
        "body_pose": numbers[1:22].tolist(),
        "jaw_pose": numbers[22].tolist(),
        "leye_pose": [0, 0, 0],
        "reye_pose": [0, 0, 0],
        "lhand_pose": numbers[25:40].tolist(),
        "rhand_pose": numbers[40:55].tolist(),
        "shape": [0.1 * (seed % 7)] * 10,
        "expr": [0.2 * (seed % 7)] * 10,
    }
    return value | changes


def write(folder, frames):
    folder.mkdir(exist_ok=True)
    for frame, value in frames.items():
        (folder / f"{frame}.json").write_text(value if isinstance(value, str) else json.dumps(value))
    return folder


def test_every_number_finds_its_joint(tmp_path):
    value = parameters(seed=3)
    start = read_smplx_json(write(tmp_path / "init", {7: value}), [7], FLAT)
    rotation = start.rotation[0].tolist()
    for key, joint in (
        ("root_pose", "pelvis"),
        ("jaw_pose", "jaw"),
        ("leye_pose", "left_eye"),
        ("reye_pose", "right_eye"),
    ):
        assert rotation[joint_index(joint)] == pytest.approx(value[key])
    for key, first in (
        ("body_pose", "left_hip"),
        ("lhand_pose", "left_index1"),
        ("rhand_pose", "right_index1"),
    ):
        begin = joint_index(first)
        np.testing.assert_allclose(rotation[begin : begin + len(value[key])], value[key], rtol=1e-6)
    assert start.frames == (7,) and start.valid.tolist() == [True] and start.transl is None
    torch.testing.assert_close(start.betas, torch.full((10,), 0.3))
    torch.testing.assert_close(start.expression, torch.full((1, 10), 0.6))


def test_hands_are_relative_to_the_models_mean(tmp_path):
    folder = write(tmp_path / "init", {0: parameters()})
    mean = draw(30, 3).float()
    flat, bent = (read_smplx_json(folder, [0], hand).rotation[0] for hand in (FLAT, mean))
    torch.testing.assert_close(bent[25:] - flat[25:], mean)
    assert torch.equal(bent[:25], flat[:25])


def test_flat_lists_leading_zeros_and_other_files_are_fine(tmp_path):
    value = parameters()
    folder = write(tmp_path / "init", {"000005": value | {"body_pose": sum(value["body_pose"], [])}})
    write(folder, {"shape_param": [0.0] * 10, "notes": "no json at all"})
    nested = write(tmp_path / "nested", {5: value})
    assert torch.equal(
        read_smplx_json(folder, [5], FLAT).rotation, read_smplx_json(nested, [5], FLAT).rotation
    )


def test_what_is_missing_is_zero_or_none(tmp_path):
    value = {"root_pose": [0.0, 0.1, 0.0], "body_pose": [[0.0] * 3] * 21, "trans": [0.1, 0.2, 3.0]}
    start = read_smplx_json(write(tmp_path / "init", {1: value}), [1], FLAT)
    assert not start.rotation[:, 1:].any() and start.betas is None and start.expression is None
    assert start.transl.tolist() == [pytest.approx([0.1, 0.2, 3.0])]


@pytest.mark.parametrize("hole", [None, "null", "root_pose", "NaN", "deep"])
def test_frames_without_a_pose_are_turned_between_their_neighbours(tmp_path, hole):
    """Frame 4 of 2..10: a quarter of the way from 2 to 10, along the arc through pi."""
    ends = {f: parameters(f, root_pose=[x, 0, 0], trans=[0, 0, f]) for f, x in ((2, 3.0), (10, -3.0))}
    empty = {
        "null": {**ends[2], "body_pose": None},
        "root_pose": {**ends[2], "root_pose": [None, 0, 0]},
        "NaN": json.dumps(ends[2]).replace("3.0", "NaN"),
        "deep": {**ends[2], "body_pose": [[0, 0, 0]] * 20 + [[0, 0, None]]},
    }
    folder = write(tmp_path / "init", ends | ({} if hole is None else {4: empty[hole]}))
    notes = []
    start = read_smplx_json(folder, [1, 2, 4, 10, 12], FLAT, notes.append)
    assert start.valid.tolist() == [False, True, False, True, False]
    assert len(notes) == 1 and "3 of 5 frames" in notes[0] and str(folder) in notes[0]
    angle = start.rotation[2, 0].double() @ torch.tensor([1.0, 0, 0]).double() % (2 * math.pi)
    assert float(angle) == pytest.approx(3.0 + 0.25 * (2 * math.pi - 6.0), abs=1e-6)
    assert start.transl[:, 2].tolist() == pytest.approx([2, 2, 4, 10, 10])
    assert torch.equal(start.rotation[0], start.rotation[1])  # nothing is extrapolated
    assert torch.equal(start.rotation[4], start.rotation[3])


@FAST
@given(seed=st.integers(0, 2**31), share=st.integers(1, 9))
def test_interpolated_rotations_lie_on_the_shortest_arc(tmp_path, seed, share):
    ends = {f: parameters(seed + f) for f in (0, 10)}
    start = read_smplx_json(write(tmp_path / "init", ends), [0, share, 10], FLAT)
    matrices = roma.rotvec_to_rotmat(start.rotation.double())
    whole, part, rest = (
        roma.rotmat_geodesic_distance(matrices[a], matrices[b]) for a, b in ((0, 2), (0, 1), (1, 2))
    )
    torch.testing.assert_close(part, whole * share / 10, rtol=0, atol=1e-4)
    torch.testing.assert_close(part + rest, whole, rtol=0, atol=1e-4)


@pytest.mark.parametrize(
    "value",
    [
        "",
        "{",
        "[1, 2, 3]",
        "3",
        "[" * 100_000,
        '{"root_pose": ' + "[" * 50_000 + "]" * 50_000 + "}",
        json.dumps(parameters()).replace("root_pose", "rootpose"),
        parameters(root_pose=[0, 0]),
        parameters(root_pose="0 0 0"),
        parameters(root_pose=[True, False, True]),
        parameters(root_pose={"x": 0}),
        parameters(root_pose=[[[0, 0, 0]]]),
        parameters(body_pose=[[0, 0, 0]] * 22),
        parameters(body_pose=[]),
        parameters(lhand_pose=[0.0] * 12),
        parameters(expr=[]),
        parameters(expr=[0.0] * 401),
        parameters(trans=[0, 0, 0, 0]),
        parameters(root_pose=[1e9, 0, 0]),
        parameters(root_pose=[10**400, 0, 0]),
        parameters(trans=[0, 0, 1e30]),
        json.dumps(parameters(root_pose=[0.125, 0, 0])).replace("0.125", "1e999"),
        json.dumps(parameters(root_pose=[0.125, 0, 0])).replace("0.125", "9" * 5000),
        json.dumps(parameters()) + " " * (1 << 20),
        "\ud800",
    ],
    ids=range(25),
)
def test_malformed_files_are_named_in_one_line(tmp_path, value):
    folder = write(tmp_path / "init", {1: parameters()})
    text = value if isinstance(value, str) else json.dumps(value)
    (folder / "2.json").write_bytes(text.encode("utf-8", "surrogatepass"))
    with pytest.raises(UserError, match=r"2\.json.*fit\.pose_init") as caught:
        read_smplx_json(folder, [1, 2], FLAT)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 600


JUNK = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=8,
)


@FAST
@given(name=st.sampled_from(list(parameters())), junk=JUNK)
def test_any_junk_is_an_empty_frame_or_one_clear_error(tmp_path, name, junk):
    folder = write(tmp_path / "init", {1: parameters(), 2: parameters(**{name: junk})})
    try:
        start = read_smplx_json(folder, [1, 2], FLAT)
    except UserError as error:
        assert "2.json" in str(error)
    else:
        assert torch.isfinite(start.rotation).all()


def test_folders_without_poses_of_the_clip_are_named(tmp_path):
    with pytest.raises(UserError, match="nowhere is no folder.*pose_init"):
        read_smplx_json(tmp_path / "nowhere", [1], FLAT)
    folder = write(tmp_path / "init", {8: parameters(), 9: parameters(root_pose=None)})
    for frames, found in (
        ([1, 2], "poses of 0 of the clip's 2 frames"),
        ([9], "poses of 1 of the clip's 1 frames"),
    ):
        with pytest.raises(UserError, match=f"init has {found}.*pose_init"):
            read_smplx_json(folder, frames, FLAT)


def test_two_files_of_a_frame_and_lengths_that_differ_are_errors(tmp_path):
    folder = write(tmp_path / "init", {1: parameters(), 2: parameters(expr=[0.0] * 50)})
    with pytest.raises(UserError, match=r"2\.json has 50 numbers in expr, 1\.json 10"):
        read_smplx_json(folder, [1, 2], FLAT)
    write(folder, {"01": parameters()})
    with pytest.raises(UserError, match=r"both name frame 1: keep one"):
        read_smplx_json(folder, [1], FLAT)


def test_the_hand_mean_of_a_body_file(tmp_path):
    left, right = np.arange(45.0), -np.arange(45.0)
    path = write_official(tmp_path / "b.npz", trap=tmp_path / "trap", hands_meanl=left, hands_meanr=right)
    mean = read_hand_mean(path)
    assert mean[:15].flatten().tolist() == left.tolist() and mean[15:].flatten().tolist() == right.tolist()
    assert not (tmp_path / "trap").exists()
    assert not read_hand_mean(write_official(tmp_path / "c.npz", hands_meanl=None)).any()
    bad = (
        {"hands_meanl": np.full(45, np.nan), "hands_meanr": np.zeros(45)},
        {
            "hands_meanl": np.zeros(44),
            "hands_meanr": np.zeros(45),
        },
    )
    for number, arrays in enumerate(bad):
        with pytest.raises(UserError, match="d.npz.*mean hand pose"):
            read_hand_mean(write_official(tmp_path / f"{number}d.npz", **arrays))
    (tmp_path / "e.npz").write_bytes(b"PK")
    for name in ("e.npz", "none.npz"):
        with pytest.raises(UserError, match=name):
            read_hand_mean(tmp_path / name)


def test_upright_before_an_uncalibrated_camera_is_no_turn():
    """Their pi about X is our rest: Y down against Y up, and facing the camera in both."""
    camera = facing_camera(64, 64, 80.0)
    views = camera.rotation[None], camera.translation[None]
    pivot = torch.tensor([0.0, -0.35, 0.01])
    orient, transl = into_world(
        torch.tensor([[math.pi, 0, 0]]), torch.tensor([[0.1, 0.2, 3.0]]), pivot, *views
    )
    assert orient.abs().max() < 1e-6
    # The pelvis is at trans + pivot in the camera, so at (x, -y, -z) of that in the world.
    expected = torch.tensor([[0.1, -(0.2 - 0.35), -(3.0 + 0.01)]]) - pivot
    torch.testing.assert_close(transl, expected.double(), rtol=0, atol=1e-6)


@FAST
@given(seed=st.integers(0, 2**31))
def test_the_way_into_the_camera_and_back(seed):
    orient, transl = draw(5, 3, seed=seed, scale=1.5), draw(5, 3, seed=seed + 1)
    rotation = roma.rotvec_to_rotmat(draw(5, 3, seed=seed + 9, scale=2.0))
    translation, pivot = draw(5, 3, seed=seed + 2), draw(3, seed=seed + 3)
    root_pose, trans = into_camera(orient, transl, pivot, rotation, translation)
    back = into_world(root_pose, trans, pivot, rotation, translation)
    torch.testing.assert_close(back[1], transl, rtol=0, atol=1e-9)
    torch.testing.assert_close(
        roma.rotvec_to_rotmat(back[0]), roma.rotvec_to_rotmat(orient), rtol=0, atol=1e-9
    )
    # The same points, posed there and then moved, or moved and then posed.
    joints = draw(55, 3, seed=seed + 4)
    joints[0] = pivot
    pose = draw(5, 55, 3, seed=seed + 5, scale=0.5)
    world = posed_joints(torch.cat([orient[:, None], pose[:, 1:]], 1), joints, PARENTS) + transl[:, None]
    there = posed_joints(torch.cat([root_pose[:, None], pose[:, 1:]], 1), joints, PARENTS) + trans[:, None]
    torch.testing.assert_close(there, world @ rotation.mT + translation[:, None], rtol=0, atol=1e-8)


@FAST
@given(seed=st.integers(0, 2**31))
def test_another_pivot_moves_no_joint_but_itself(seed):
    joints, pose = draw(55, 3, seed=seed), draw(4, 55, 3, seed=seed + 1)
    transl = draw(4, 3, seed=seed + 2)
    other = joints.clone()
    other[0] = draw(3, seed=seed + 3)
    moved = moved_pivot(pose[:, 0], transl, joints[0], other[0])
    before = posed_joints(pose, joints, PARENTS) + transl[:, None]
    after = posed_joints(pose, other, PARENTS) + moved[:, None]
    torch.testing.assert_close(after[:, 1:], before[:, 1:], rtol=0, atol=1e-9)
