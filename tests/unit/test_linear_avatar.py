"""An avatar as skinned points with linear bases, and the page's scripts that pose it, run under node."""

import base64
import dataclasses
import json
import shutil
import subprocess

import numpy as np
import pytest
import roma
import torch

from pipeline.avatar.bake import bake
from pipeline.avatar.linear_avatar import linear_avatar
from pipeline.body import joint_transforms
from pipeline.config.workspace import REPOSITORY
from pipeline.errors import UserError
from pipeline.viewer.packed import ViewedMotion, pack
from pipeline.viewer.shown import novel_motion
from tests.unit.test_avatar_representations import FRAMES, KINDS, a_pose, an_avatar

SCRIPT = REPOSITORY / "pipeline" / "viewer" / "page" / "posing.js"
PROGRAM = """
const Posing = require(process.argv[1]), told = JSON.parse(require("fs").readFileSync(0, "utf8"));
Posing.unpack(Buffer.from(told.packed, "base64")).then(avatar => {
  const found = told.poses.map(pose => Buffer.from(Posing.pose(avatar, pose).buffer).toString("base64"));
  const motion = avatar.motions[0];
  console.log(JSON.stringify({ found, rotation: motion ? Array.from(motion.rotation) : [] }));
}, error => { console.error(error.message); process.exit(3); });
"""


def run_node(packed: bytes, poses=()):
    """The packed avatar in some poses, [N, 16] each, as the page computes it, and its first motion."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("there is no node here")
    told = [
        {
            "local": roma.rotvec_to_rotmat(pose.rotation).flatten(1).tolist(),
            "expression": pose.expression.tolist(),
            "transl": pose.transl.tolist(),
        }
        for pose in poses
    ]
    content = json.dumps({"packed": base64.b64encode(packed).decode(), "poses": told})
    run = subprocess.run([node, "-e", PROGRAM, str(SCRIPT)], input=content, capture_output=True, text=True)
    if run.returncode:
        raise RuntimeError(run.stderr)
    answer = json.loads(run.stdout)
    rows = [
        np.frombuffer(base64.b64decode(one), np.float32).reshape(-1, 16).copy() for one in answer["found"]
    ]
    return [torch.from_numpy(one) for one in rows], np.array(answer["rotation"])


def clip_poses():
    return [a_pose(seed) for seed in range(FRAMES)]


def covariances(gaussians):
    axes = roma.unitquat_to_rotmat(roma.quat_wxyz_to_xyzw(gaussians.quaternions)) * gaussians.scales[:, None]
    row, column = torch.triu_indices(3, 3)
    return (axes @ axes.mT)[:, row, column]


def require_the_same(found, gaussians):
    """Places within 0.1 mm, colours within two levels, and shapes within 5%."""
    assert (found[:, :3] - gaussians.means).norm(dim=1).max() < 1e-4
    assert (found[:, 9:12] - gaussians.colors).abs().max() < 2 / 255
    assert (found[:, 12] - gaussians.opacities).abs().max() < 1e-4
    shape = covariances(gaussians)
    largest = shape[:, [0, 3, 5]].amax(1, keepdim=True)
    assert ((found[:, 3:9] - shape).abs() / largest).max() < 0.05


@pytest.mark.parametrize("kind", ["bases", "split bases"])
@pytest.mark.parametrize("gated", [False, True])
def test_the_page_poses_linear_bases_as_we_do(body, kind, gated):
    avatar = an_avatar(body, kind)
    if gated:
        avatar.gate(torch.arange(len(avatar.vertex_ids)) % 7 != 0)
    baked, poses = bake(avatar), [a_pose(3), a_pose(99, 1.0)]  # one far outside of what the clip showed
    for found, pose in zip(run_node(pack(linear_avatar(avatar)), poses)[0], poses, strict=True):
        require_the_same(found, baked.gaussians(pose))
    moved = (baked.gaussians(poses[0]).means - baked.gaussians(poses[1]).means).norm(dim=1)
    assert moved.max() > 0.1


@pytest.mark.parametrize("kind", KINDS)
def test_without_bases_that_are_awake_it_is_the_static_avatar(body, kind):
    avatar = an_avatar(body, kind, awake=False)
    avatar.pose_heads_active = avatar.residuals_active = False
    require_the_same(
        run_node(pack(linear_avatar(avatar)), [a_pose(3)])[0][0], bake(avatar).gaussians(a_pose(3))
    )


def test_a_triplane_is_told_by_bases_of_the_clips_poses(body):
    avatar, poses = an_avatar(body, "triplane"), clip_poses()
    linear, baked = linear_avatar(avatar, poses), bake(avatar)
    assert 0 < len(linear.signal) <= FRAMES // 3
    found, _ = run_node(pack(linear), poses)
    still, _ = run_node(pack(linear_avatar(avatar)), poses)

    def wrong(some):
        pairs = zip(some, (baked.gaussians(pose).colors for pose in poses), strict=True)
        return sum(float((rows[:, 9:12] - colors).square().mean()) for rows, colors in pairs)

    assert wrong(found) < 0.8 * wrong(still)


def test_correctives_of_the_body_are_told_by_bases_too(body):
    directions = torch.zeros(len(body.v_template), 3, 486)
    directions[:, 1, ::9] = 0.01
    bent = dataclasses.replace(body, pose_directions=directions)
    avatar, pose = an_avatar(bent, "bases"), dataclasses.replace(a_pose(3), expression=torch.zeros(3))
    avatar.pose_heads_active = False
    linear, baked = linear_avatar(avatar, [pose]), bake(avatar)
    transforms = joint_transforms(pose.rotation[None], linear.joints, linear.parents)[0]
    placed, _ = baked.skinning_tables.place(transforms, linear.points, pose.transl)
    assert (linear.points - baked.constants.points).abs().max() > 1e-3
    assert torch.allclose(placed, baked.gaussians(pose).means, atol=1e-4)  # stored in bfloat16


def test_equal_avatars_give_equal_bytes_and_a_motion_of_one_frame_is_kept(body):
    linear = linear_avatar(an_avatar(body, "bases"))
    rotation = a_pose(2).rotation.numpy()[None]
    motion = ViewedMotion("one", 30.0, rotation, np.zeros((1, 0), np.float32), np.zeros((1, 3), np.float32))
    packed = pack(linear, [motion])
    assert packed == pack(linear, [motion])
    assert np.abs(run_node(packed)[1].reshape(55, 3) - rotation[0]).max() < 1e-4


def test_a_damaged_block_is_refused(body):
    packed = pack(linear_avatar(an_avatar(body, "bases")), [novel_motion()])
    for bad in (packed[: len(packed) // 2], b"", b"\x00" * 100):
        with pytest.raises(RuntimeError, match="."):
            run_node(bad)


def test_an_avatar_of_which_the_gate_left_nothing_is_refused(body):
    avatar = an_avatar(body, "bases")
    avatar.active.fill_(False)
    with pytest.raises(UserError, match="train"):
        linear_avatar(avatar)
