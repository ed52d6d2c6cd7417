"""Motion-capture files as the mannequin's motion."""

import math

import numpy as np
import pytest
import torch

from pipeline.body import joint_index
from pipeline.errors import UserError
from pipeline.motion.bvh import read_bvh
from stages.ingest.mannequin import MannequinSpec
from stages.ingest.mannequin.motion import make_motion

ANGLES = "CHANNELS 3 Yrotation Xrotation Zrotation"
ARM = """JOINT {0}Arm {{ OFFSET {1}18 35 0 {2}
  JOINT {0}ForeArm {{ OFFSET {1}26 0 0 {2}
    JOINT {0}Hand {{ OFFSET {1}24 0 0 {2} End Site {{ OFFSET {1}8 0 0 }} }} }} }}"""
LEG = """JOINT {0}UpLeg {{ OFFSET {1}9 0 0 {2}
  JOINT {0}Leg {{ OFFSET 0 -40 0 {2} End Site {{ OFFSET 0 -40 0 }} }} }}"""
BVH = f"""HIERARCHY
ROOT Hips
{{ OFFSET 0 100 0 CHANNELS 6 Xposition Yposition Zposition Yrotation Xrotation Zrotation
  JOINT Spine {{ OFFSET 0 10 0 {ANGLES}
    JOINT Neck {{ OFFSET 0 40 0 {ANGLES} End Site {{ OFFSET 0 10 0 }} }}
    {ARM.format("Left", "", ANGLES)} {ARM.format("Right", "-", ANGLES)} }}
  {LEG.format("Left", "", ANGLES)} {LEG.format("Right", "-", ANGLES)}
}}
MOTION
Frames: 3
Frame Time: 0.1
"""
SIDED = ("LeftArm", "LeftForeArm", "LeftHand", "RightArm", "RightForeArm", "RightHand")
JOINTS = ("Hips", "Spine", "Neck", *SIDED, "LeftUpLeg", "LeftLeg", "RightUpLeg", "RightLeg")


def write_bvh(path, *frames):
    """A tiny BVH in T pose; each frame is {joint: (y, x, z) degrees} and may move the "place"."""
    rows = []
    for frame in frames:
        place = frame.get("place", (0, 100, 0))
        angles = [frame.get(joint, (0, 0, 0)) for joint in JOINTS]
        rows.append(" ".join(str(v) for v in (*place, *(a for own in angles for a in own))))
    path.write_text(BVH.replace("Frames: 3", f"Frames: {len(rows)}") + "\n".join(rows) + "\n")
    return path


def motion_of(path, body, frames, fps=10.0):
    spec = MannequinSpec(motion=str(path), frames=frames, fps=fps)
    return make_motion(spec, body.joint_regressor @ body.v_template, body.parents, torch.zeros(5))


def test_bvh_angles_become_the_joints_own(tmp_path, body):
    path = write_bvh(
        tmp_path / "tiny.bvh",
        {},
        {"LeftForeArm": (-90, 0, 0), "place": (0, 90, 20)},
        {"Hips": (40, 0, 0), "RightArm": (0, 0, 50)},
    )
    bvh = read_bvh(path)
    assert (bvh.names, bvh.fps, bvh.values.shape) == (JOINTS, pytest.approx(10), (3, 42))
    motion = motion_of(path, body, 3)
    rotation = motion.rotation.numpy()
    elbow, shoulder = joint_index("left_elbow"), joint_index("right_shoulder")
    np.testing.assert_allclose(rotation[1, elbow], [0, -math.pi / 2, 0], atol=0.03)
    np.testing.assert_allclose(rotation[2, 0] - rotation[0, 0], [0, math.radians(40), 0], atol=0.02)
    turned = rotation[2, shoulder] - rotation[0, shoulder]
    np.testing.assert_allclose(turned, [0, 0, math.radians(50)], atol=0.05)
    np.testing.assert_allclose(rotation[2, elbow], 0, atol=0.03)
    rest = (body.joint_regressor @ body.v_template).numpy()
    thigh = np.linalg.norm(rest[joint_index("left_hip")] - rest[joint_index("left_knee")])
    np.testing.assert_allclose(motion.root[1], np.array([0, -10, 20]) * thigh / 40, atol=1e-3)


def test_bvh_is_resampled_and_runs_back_when_it_ends(tmp_path, body):
    frames = [{"LeftForeArm": (-30 * k, 0, 0)} for k in range(3)]
    motion = motion_of(write_bvh(tmp_path / "short.bvh", *frames), body, 6, fps=10)
    bend = -motion.rotation[:, joint_index("left_elbow"), 1].numpy()
    np.testing.assert_allclose(np.degrees(bend), [0, 30, 60, 30, 0, 30], atol=0.1)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "not a bvh",
        BVH,
        BVH + "1 2 3",
        BVH.replace("Frames: 3", "Frames: 0"),
        BVH.replace("Xposition", "Wposition"),
    ],
)
def test_a_bad_bvh_is_named(tmp_path, text):
    path = tmp_path / "bad.bvh"
    path.write_text(text)
    with pytest.raises(UserError, match="bad.bvh"):
        read_bvh(path)


def test_a_skeleton_without_arms_is_refused(tmp_path, body):
    path = tmp_path / "odd.bvh"
    path.write_text(BVH.replace("LeftArm", "Wing") + "\n".join(" ".join(["0"] * 42) for _ in range(3)))
    with pytest.raises(UserError, match="left_shoulder"):
        motion_of(path, body, 2)


def test_a_dance_is_carried_over(shared_folder, body):
    path = shared_folder / "data" / "motion" / "jesse_dance.bvh"
    if not path.is_file():
        pytest.skip("there is no motion capture here")
    motion = motion_of(path, body, 40, fps=5.0)
    knees = motion.rotation[:, [joint_index("left_knee"), joint_index("right_knee")]].norm(dim=-1)
    assert 0.5 < float(knees.max()) < 2.8
    assert float(motion.root.abs().max()) < 3
    assert motion.rotation[:, joint_index("left_index2")].std() > 0 and torch.isfinite(motion.rotation).all()
