"""Avatars from Python: flexiavatar.load and what it gives."""

import subprocess
import sys

import gsply
import numpy as np
import pytest
import torch

import flexiavatar
from pipeline.avatar import save_avatar
from pipeline.body import JOINT_NAMES, Poses, joint_index, write_poses
from pipeline.clip.camera import facing_camera
from pipeline.config.workspace import REPOSITORY
from pipeline.errors import UserError
from pipeline.splat import render
from tests.glb_reader import Glb
from tests.made.body import open_body
from tests.made.doll import awake_avatar


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A subject's folder, as the store lays it out."""
    subject = tmp_path_factory.mktemp("doll")
    train = subject / "train" / "latest"
    train.mkdir(parents=True)
    save_avatar(train / "avatar.safetensors", awake_avatar(gated=True))
    rotation = torch.zeros(2, 55, 3)
    rotation[1, 0, 1] = 0.5
    transl = torch.tensor([[0.0, 0.0, -3.0], [0.2, 0.0, -3.0]])
    write_poses(train / "poses.parquet", Poses((4, 9), rotation, torch.zeros(2, 38), transl))
    return subject


@pytest.fixture(scope="module")
def avatar(folder):
    return flexiavatar.load(folder)


@pytest.mark.parametrize("inner", [".", "train/latest", "train/latest/avatar.safetensors"])
def test_any_of_its_places_leads_to_it(inner, folder):
    assert flexiavatar.load(str(folder / inner)).frames == (4, 9)


def test_a_picture_is_rgb_and_alpha(avatar):
    picture = avatar.render(frame=4, size=48)
    assert picture.shape == (48, 48, 4) and picture.dtype == np.float32
    assert picture.min() >= 0 and picture.max() <= 1
    assert picture[..., 3].max() > 0.99 and picture[0, 0, 3] == 0
    assert avatar.render(size=(40, 24)).shape == (24, 40, 4)
    assert avatar.render(size=np.int64(16)).shape == (16, 16, 4)


def test_the_picture_is_the_renderers(avatar):
    camera = facing_camera(32, 40, 45.0)
    picture = avatar.render(
        frame=9, size=(32, 40), intrinsics=camera.intrinsics, extrinsics=camera.world_to_camera.tolist()
    )
    with torch.no_grad():
        expected = render(avatar.gaussians(frame=9), camera)
    assert np.allclose(picture[..., 3], expected.alpha, atol=1e-6)
    assert np.allclose(picture[..., :3] * picture[..., 3:], expected.color, atol=1e-5)


def test_the_camera_goes_round_and_above(avatar):
    """Nothing is cut off from any side, and the left arm is nearer from the left."""
    lifted = {"left_shoulder": [0, 0, 0], "right_shoulder": [0, 0, 0]}  # the T pose
    for yaw in (0, 90, 200):
        for pitch in (-90, -30, 0, 45, 90):
            alpha = avatar.render(pose=lifted, size=48, yaw=yaw, pitch=pitch)[..., 3]
            border = np.concatenate([alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]])
            assert border.max() < 0.01 and alpha.max() > 0.9, (yaw, pitch)
    front, left = (avatar.render(pose=lifted, size=48, yaw=yaw)[..., 3] for yaw in (0, 90))
    assert (front.max(0) > 0.5).sum() > 1.5 * (left.max(0) > 0.5).sum()
    # From before it the person's left is on the right of the picture.
    up = avatar.render(pose={"left_shoulder": [0, 0, 1.0]}, size=48)[..., 3]
    assert up[:16, 24:].sum() > up[:16, :24].sum()


def test_joints_and_parameters_are_set_by_name(avatar):
    turned = avatar.pose(
        frame=9, pose={"head": [0.1, 0.2, 0.3], "transl": [1, 2, 3], "jaw_pose": [0.2, 0, 0]}
    )
    assert turned.rotation[joint_index("head")].tolist() == pytest.approx([0.1, 0.2, 0.3])
    assert turned.rotation[joint_index("jaw"), 0] == pytest.approx(0.2)
    assert turned.rotation[0, 1] == 0.5 and turned.transl.tolist() == [1, 2, 3]
    hands = avatar.pose(pose={"left_hand_pose": np.arange(45) / 45.0, "body_pose": np.zeros((21, 3))})
    assert hands.rotation[25:40].flatten().numpy() == pytest.approx(np.arange(45) / 45.0)
    assert not hands.rotation[1:22].any()
    assert avatar.pose(pose=turned) is not turned
    assert torch.equal(avatar.pose(pose=turned).rotation, turned.rotation)
    assert avatar.joints == JOINT_NAMES


def test_expressions_are_set_by_name(avatar):
    assert "mouthSmileLeft" in avatar.expressions
    neutral = avatar.gaussians().means
    moved = avatar.gaussians(expression={"mouthSmileLeft": 1.0}).means
    face = (neutral - moved).norm(dim=1)
    assert face.max() > 0.003 and (face > 1e-6).float().mean() < 0.6
    numbers = avatar.pose(pose={"expression": [1.0, 2.0]}).expression
    assert numbers[:3].tolist() == [1, 2, 0] and len(numbers) == 38


def test_frames_of_the_clip_differ_from_each_other(avatar):
    assert not torch.allclose(avatar.gaussians(4).means, avatar.gaussians(9).means)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"frame": 5}, "2 from 4 to 9"),
        ({"pose": {"tail": [0, 0, 0]}}, "left_elbow"),
        ({"pose": {"head": [0, 0]}}, "head"),
        ({"pose": {"head": [0, float("nan"), 0]}}, "finite"),
        ({"pose": {"head": "up"}}, "numbers"),
        ({"pose": {"expression": np.zeros(39)}}, "38"),
        ({"expression": {"jawOpen": 1}}, "mouthFunnel"),
        ({"expression": {"cheekPuff": float("inf")}}, "finite"),
        ({"size": 0}, "size"),
        ({"size": (10, 10, 10)}, "size"),
        ({"size": 2.5}, "size"),
        ({"yaw": float("nan")}, "finite"),
        ({"intrinsics": np.eye(3)}, "extrinsics"),
        ({"intrinsics": np.eye(2), "extrinsics": np.eye(4)}, "intrinsics"),
    ],
)
def test_what_is_wrong_is_said_in_a_line(arguments, said, avatar):
    with pytest.raises(UserError, match=said) as error:
        avatar.render(**arguments)
    assert "\n" not in str(error.value)


def test_a_place_without_an_avatar_is_refused(tmp_path):
    with pytest.raises(UserError, match="doit run subject="):
        flexiavatar.load(tmp_path / "nobody")


def test_an_avatar_without_poses_stands_relaxed(folder, tmp_path):
    (tmp_path / "avatar.safetensors").write_bytes((folder / "train/latest/avatar.safetensors").read_bytes())
    alone = flexiavatar.load(tmp_path)
    assert alone.frames == () and alone.render(size=16)[..., 3].max() > 0.9
    with pytest.raises(UserError, match=r"poses\.parquet"):
        alone.render(frame=0)


def test_files_for_other_programs(avatar, tmp_path):
    avatar.save_splats(tmp_path / "doll.spz", pose={"transl": [0, 1, 0]})
    packed = gsply.read_spz(tmp_path / "doll.spz")
    assert np.abs(packed.means - avatar.gaussians(pose={"transl": [0, 1, 0]}).means.numpy()).max() < 5e-5
    avatar.save_rig(tmp_path / "a doll.glb")
    glb = Glb(tmp_path / "a doll.glb")
    assert glb.asset.nodes[0].name == "a doll"
    assert 0 < len(glb.attribute("POSITION")) < len(open_body().v_template)  # what the avatar shows


def test_the_import_is_light():
    """Neither torch nor numpy before an avatar is loaded."""
    code = "import sys, flexiavatar; print({'torch', 'numpy', 'pipeline'} & set(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=REPOSITORY, check=True
    )
    assert done.stdout.strip() == "set()"
