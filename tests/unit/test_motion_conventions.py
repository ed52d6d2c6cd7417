"""Round trips of one motion through every naming, axis and layout that captures come in."""

import math

import numpy as np
import pytest
import roma
import torch
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from pipeline.body import JOINT_NAMES, joint_index, load_body, mean_identity
from pipeline.errors import UserError
from pipeline.motion.joint_names import match_joints
from pipeline.motion.retarget import yaw
from pipeline.motion.up_axis import AXES, turn_to_y
from stages.animate.motions.motion import Span
from stages.animate.motions.read import DrivenPerson, read_motion
from stages.animate.motions.source import motion_source
from tests.made.body import BODY_FILE
from tests.made.captured_skeletons import (
    SKELETONS,
    extra_in,
    random_frames,
    representable,
    told_by,
    write_captured,
)
from tests.made.motions import FPS, made_up

HEIGHT = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
DRAWN = settings(
    deadline=None, derandomize=True, phases=[Phase.generate]
)  # shrinking 55 joints takes minutes


@pytest.fixture(scope="module")
def person():
    body = load_body(BODY_FILE)
    return DrivenPerson(body, BODY_FILE, mean_identity(body))


def read(path, person, up="auto"):
    return read_motion(motion_source(str(path)), person, Span(), up, {})


def angle(a, b):
    return roma.rotmat_geodesic_distance(roma.rotvec_to_rotmat(a.double()), roma.rotvec_to_rotmat(b.double()))


def check(motion, rotation, way, most, joints=slice(None)):
    """The motion is the truth once it faces the front; in metres to 1 mm."""
    assert motion.fps == pytest.approx(FPS)
    turn = yaw(roma.rotvec_to_rotmat(motion.rotation[0, 0].double())).mT
    found = motion.rotation.double().clone()
    found[:, 0] = roma.rotmat_to_rotvec(turn @ roma.rotvec_to_rotmat(found[:, 0]))
    assert float(angle(found, rotation)[:, joints].max()) < most
    moved = (motion.root - motion.root[:1]).double() @ turn.mT
    assert torch.allclose(moved, way, atol=1e-3)


@pytest.mark.parametrize("name", SKELETONS)
def test_every_programs_names_are_known(name, person, tmp_path):
    skeleton = SKELETONS[name]
    rotation, way = made_up(4)
    rotation = representable(rotation, skeleton)
    motion = read(write_captured(tmp_path / "a.bvh", rotation, way, person, skeleton), person)
    assert set(motion.told) == told_by(skeleton) and set(motion.unused) == extra_in(skeleton)
    check(motion, rotation, way, 1e-3)


def with_bent_limbs(rotation):
    """Knees and elbows bent in all frames but the first, which is then the one with the straightest limbs."""
    bent = rotation.clone()
    for side, sign in (("left", -1), ("right", 1)):
        for joint, axis, way in ((f"{side}_knee", 0, 1), (f"{side}_elbow", 1, sign)):
            angles = bent[1:, joint_index(joint), axis]
            bent[1:, joint_index(joint), axis] = way * (0.5 + angles.abs())
    return bent


@settings(DRAWN, max_examples=20)
@given(
    name=st.sampled_from(sorted(SKELETONS)),
    up=st.sampled_from(sorted(AXES)),
    heading=st.floats(-3, 3),
    order=st.sampled_from(["XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX"]),
    unit=st.sampled_from([1.0, 39.37, 100.0, 1000.0]),
    own_axes=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_a_capture_in_any_convention_tells_the_same_motion(
    tmp_path_factory, person, name, up, heading, order, unit, own_axes, seed
):
    """With axes of the joints' own, zero angles are no stance: the first frame, a T pose, is."""
    skeleton = SKELETONS[name]
    rotation, way = made_up(4, seed)
    rotation = with_bent_limbs(rotation) if own_axes else rotation
    rotation = representable(rotation, skeleton)
    facing = roma.rotvec_to_rotmat(
        torch.tensor([0.0, heading if own_axes else 0.0, 0.0], dtype=torch.float64)
    )
    path = write_captured(
        tmp_path_factory.mktemp("bvh") / "a.bvh", rotation, way, person, skeleton, turn_to_y(up).mT @ facing,
        order, unit, random_frames(seed) if own_axes else None, ground=HEIGHT,
    )  # fmt: skip
    motion = read(path, person)
    limbs = [joint for joint in range(25) if JOINT_NAMES[joint] in skeleton]
    check(motion, rotation, way, 0.01, limbs)
    check(motion, rotation, way, 0.06)
    assert motion.notes[0].startswith(f"a.bvh: {up.upper()} is up")


LAYOUTS = {"smpl": 24, "body": 22, "smplh": 52, "smplx": 55}


def as_written(values, form):
    """Rotation vectors [T, J, 3] in one of the shapes that archives have."""
    if form == "flat":
        return values.reshape(len(values), -1)
    return roma.rotvec_to_rotmat(values) if form == "matrices" else values


def write_archive(path, rotation, way, up, layout, form, wide, extra, rate="mocap_framerate"):
    turn = turn_to_y(up).mT
    turned = rotation.clone()
    turned[:, 0] = roma.rotmat_to_rotvec(turn @ roma.rotvec_to_rotmat(rotation[:, 0]))
    values = {"trans": way @ turn.mT + torch.tensor([5.0, -3.0, 1.0])}
    if layout in LAYOUTS:
        joints = {
            22: [*range(22)], 24: [*range(22), 25, 40], 52: [*range(22), *range(25, 55)], 55: [*range(55)],
        }[LAYOUTS[layout]]  # fmt: skip
        values["poses"] = as_written(turned[:, joints], form)
    elif layout == "amass parts":
        parts = {"root_orient": [0], "pose_body": [*range(1, 22)], "pose_jaw": [22], "pose_eye": [23, 24],
                 "pose_hand": [*range(25, 55)]}  # fmt: skip
        values |= {name: as_written(turned[:, joints], form) for name, joints in parts.items()}
    else:
        values["transl"] = values.pop("trans")
        body = [*range(1, 24)] if layout == "smpl parts" else [*range(1, 22)]
        parts = {"global_orient": [0], "body_pose": body}
        if layout == "smplx parts":
            parts |= {"jaw_pose": [22], "leye_pose": [23], "reye_pose": [24],
                      "left_hand_pose": [*range(25, 40)], "right_hand_pose": [*range(40, 55)]}  # fmt: skip
        values |= {name: as_written(turned[:, joints], form) for name, joints in parts.items()}
    arrays = {
        name: value.numpy().astype(np.float64 if wide else np.float32) for name, value in values.items()
    }
    np.savez(path, **arrays, **{rate: np.array(FPS)}, **extra)
    return path


class Evil:
    def __reduce__(self):
        return (print, ("executed",))


EXTRA = {
    "gender": np.array("female"), "surface_model_type": np.array("smplx"), "betas": np.zeros(16),
    "labels": np.array(["LFHD", Evil()], object), "marker_meta": np.array({"a": Evil()}, object),
    "latent_labels": np.array(["a", "b"]), "dmpls": np.zeros((4, 8)), "num_betas": np.array(16),
}  # fmt: skip


@settings(DRAWN, max_examples=25)
@given(
    layout=st.sampled_from([*LAYOUTS, "amass parts", "smplx parts", "smpl parts"]),
    form=st.sampled_from(["flat", "joints", "matrices"]),
    up=st.sampled_from(["z", "y", "-y"]),
    wide=st.booleans(),
    extra=st.sets(st.sampled_from(sorted(EXTRA))),
    rate=st.sampled_from(["mocap_framerate", "mocap_frame_rate", "fps"]),
    seed=st.integers(0, 1000),
)
def test_an_archive_in_any_layout_tells_the_same_motion(
    tmp_path_factory, person, layout, form, up, wide, extra, rate, seed
):
    rotation, way = made_up(4, seed)
    known = {"body": 22, "smpl": 22, "smpl parts": 22}.get(layout, 55)
    rotation[:, known:] = 0
    path = tmp_path_factory.mktemp("npz") / "a.npz"
    extra = {name: EXTRA[name] for name in extra}
    motion = read(write_archive(path, rotation, way, up, layout, form, wide, extra, rate), person)
    check(motion, rotation, way, 2e-3)
    told = {"smplh": 52, "smplx": 55, "amass parts": 55, "smplx parts": 55}.get(layout, 22)
    assert len(motion.told) == told
    assert any(note.startswith(f"a.npz is {up.upper()} up") for note in motion.notes)


def test_members_that_are_not_needed_are_not_parsed(tmp_path, person, capsys):
    rotation, way = made_up(4)
    plain = write_archive(tmp_path / "plain.npz", rotation, way, "z", "smplh", "flat", True, {})
    full = write_archive(tmp_path / "full.npz", rotation, way, "z", "smplh", "flat", True, EXTRA)
    a, b = read(plain, person), read(full, person)
    assert torch.equal(a.rotation, b.rotation) and torch.equal(a.root, b.root)
    assert "executed" not in capsys.readouterr().out


def test_hands_as_coefficients_are_left_out_and_said(tmp_path, person):
    rotation, way = made_up(4)
    extra = {"left_hand_pose": np.ones((4, 12)), "right_hand_pose": np.ones((4, 6))}
    motion = read(
        write_archive(tmp_path / "a.npz", rotation, way, "y", "smpl parts", "flat", True, extra), person
    )
    assert "left_index1" not in motion.told and sum("coefficients" in note for note in motion.notes) == 2


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"global_orient": np.zeros((3, 3))}, ["pose_body", "body_pose"]),
        ({"global_orient": np.zeros((3, 3)), "body_pose": np.zeros((4, 63))}, ["3 and 4 frames"]),
        ({"poses": np.zeros((3, 55, 6))}, ["(3, 55, 6)", "165"]),
        ({"poses": np.zeros((3, 52, 3, 3))}, ["no rotations"]),
        ({"poses": np.zeros((3, 156)), "trans": np.zeros((4, 3))}, ["trans", "(4, 3)"]),
        ({"poses": np.array(["a", "b"])}, ["numbers"]),
        ({"poses": np.array([np.zeros(3), None], object)}, ["poses", "numbers"]),
    ],
)
def test_a_wrong_archive_is_named_in_a_line(tmp_path, person, arrays, words):
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(UserError) as error:
        read(tmp_path / "a.npz", person)
    message = str(error.value)
    assert all(word in message for word in ["a.npz", *words]) and "\n" not in message


def test_up_that_is_said_is_obeyed(tmp_path, person):
    rotation, way = made_up(4)
    capture = write_captured(tmp_path / "a.bvh", rotation, way, person, SKELETONS["mixamo"])
    archive = write_archive(tmp_path / "a.npz", rotation, way, "y", "smplx", "flat", True, {})
    for path in (capture, archive):
        assert torch.equal(read(path, person, "y").rotation, read(path, person).rotation)
        lying = read(path, person, "z")
        tilt = roma.rotvec_to_rotmat(lying.rotation[0, 0].double())[:, 1]
        assert abs(float(tilt[1])) < 0.01 and any("Z" in note for note in lying.notes)


def test_a_y_up_skeleton_in_a_z_up_world(tmp_path, person):
    """Exporters that leave the skeleton and turn the root; the ground is at height zero."""
    rotation, way = made_up(4)
    path = write_captured(
        tmp_path / "a.bvh",
        rotation,
        way,
        person,
        SKELETONS["mixamo"],
        tilt=turn_to_y("z").mT,
        ground=1.246 * HEIGHT,
    )
    motion = read(path, person)
    check(motion, rotation, way, 1e-3)
    assert "Z is up" in motion.notes[0] and "against its skeleton" in motion.notes[0]


def test_a_body_that_lies_throughout_is_not_stood_up(tmp_path, person):
    rotation, way = made_up(4)
    rotation *= 0.2
    rotation[:, 0] = torch.tensor([-math.pi / 2, 0, 0])  # on its back
    ground = torch.tensor(
        [0.0, 0.45, 3.0], dtype=torch.float64
    )  # the pelvis 0.1 m up, the feet far from zero
    path = write_captured(tmp_path / "a.bvh", rotation, 0 * way, person, SKELETONS["mixamo"], ground=ground)
    motion = read(path, person)
    upward = roma.rotvec_to_rotmat(motion.rotation[:, 0].double())[:, :, 1]
    assert float(upward[:, 1].abs().max()) < 0.01 and "Y is up" in motion.notes[0]


CMU = """HIERARCHY
ROOT Hips
{ OFFSET 0 0 0 CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation
%s
JOINT LowerBack { OFFSET 0 0 0 {A} JOINT Spine { OFFSET 0.02827 2.03559 -0.19338 {A}
JOINT Spine1 { OFFSET 0.05672 2.04885 -0.04275 {A}
JOINT Neck { OFFSET 0 0 0 {A} JOINT Neck1 { OFFSET -0.05417 1.74624 0.17202 {A}
JOINT Head { OFFSET 0.10407 1.76136 -0.12397 {A} End Site { OFFSET 0.03720 1.77044 -0.06242 } } } }
%s
} } } }
MOTION
Frames: %d
Frame Time: 0.0333333
"""
CMU_LEG = """JOINT {L}HipJoint { OFFSET 0 0 0 {A} JOINT {Left}UpLeg { OFFSET {s}1.36306 -1.79463 0.83929 {A}
JOINT {Left}Leg { OFFSET {s}2.44811 -6.72613 0 {A} JOINT {Left}Foot { OFFSET {s}2.56220 -7.03959 0 {A}
JOINT {Left}ToeBase { OFFSET {s}0.15764 -0.43311 2.32255 {A} End Site { OFFSET 0 0 1.1 } } } } } }"""
CMU_ARM = """JOINT {Left}Shoulder { OFFSET 0 0 0 {A} JOINT {Left}Arm { OFFSET {s}3.36554 1.20089 -0.31121 {A}
JOINT {Left}ForeArm { OFFSET {s}4.98300 0 0 {A} JOINT {Left}Hand { OFFSET {s}3.48356 0 0 {A}
End Site { OFFSET {s}0.7 0 0 } } } } }"""


def write_cmu(path, *rows):
    """A skeleton of CMU's proportions, hip joints before and below the root; rows of {joint: (z, y, x)}."""

    def both(text):
        return "\n".join(
            text.replace("{L}", side[0]).replace("{Left}", side).replace("{s}", sign)
            for side, sign in (("Left", ""), ("Right", "-"))
        )

    text = CMU % (both(CMU_LEG), both(CMU_ARM), len(rows))
    names = [
        line.split(" {")[0] for line in text.replace("JOINT ", "\nJOINT ").split("\n") if line[:5] == "JOINT"
    ]
    names = [name.removeprefix("JOINT ") for name in names]
    table = [
        " ".join(
            str(x)
            for x in (
                0,
                17,
                0,
                *row.get("Hips", (0, 0, 0)),
                *(a for n in names for a in row.get(n, (0, 0, 0))),
            )
        )
        for row in rows
    ]
    path.write_text(text.replace("{A}", "CHANNELS 3 Zrotation Yrotation Xrotation") + "\n".join(table) + "\n")
    return path


def test_a_cmu_skeleton_stands_upright_and_its_three_spines_bend(tmp_path, person):
    bent = {"Hips": (0, 0, 10), "LowerBack": (0, 0, 20), "Spine": (0, 15, 0), "Spine1": (5, 0, 0)}
    motion = read(write_cmu(tmp_path / "cmu.bvh", {}, bent), person)
    upright = ("pelvis", "spine1", "spine2", "spine3", "neck", "head", "left_collar", "left_ankle")
    for name in upright[:-1]:
        assert float(motion.rotation[0, joint_index(name)].norm()) < 1e-4, name
    degrees = torch.rad2deg(motion.rotation[1])
    for name, wanted in {
        "pelvis": (10, 0, 0), "spine1": (20, 0, 0), "spine2": (0, 15, 0), "spine3": (0, 0, 5)
    }.items():  # fmt: skip
        assert torch.allclose(degrees[joint_index(name)], torch.tensor(wanted).float(), atol=0.1), name
    assert set(motion.unused) == {"Neck1", "LHipJoint", "RHipJoint"}
    # Feet are level although the legs stand apart.
    chain = [joint_index(f"left_{part}") for part in ("hip", "knee", "ankle")]
    foot = roma.rotvec_to_rotmat(motion.rotation[0, chain].double())
    assert float(roma.rotmat_to_rotvec(foot[0] @ foot[1] @ foot[2])[[0, 2]].norm()) < 0.02


def test_joints_are_told_from_where_they_hang_not_only_by_name():
    names = ["Hips", "LeftHip", "LeftKnee", "LeftFoot", "RightHip", "RightKnee", "RightFoot", "Spine",
             "LeftShoulder", "LeftElbow", "RightShoulder", "RightElbow", "LeftHand"]  # fmt: skip
    parents = [-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 7, 10, 0]
    found = match_joints(names, parents)
    assert found["left_ankle"] == 3 and "left_foot" not in found and "left_wrist" not in found
    assert found["left_shoulder"] == 8 and "left_collar" not in found


def test_a_public_z_up_capture_stands(shared_folder, person):
    path = shared_folder / "cases" / "bvh" / "real_zup_dab.bvh"
    if not path.is_file():
        pytest.skip("the public capture is not here")
    motion = read(path, person)
    upward = roma.rotvec_to_rotmat(motion.rotation[:, 0].double())[:, 1, 1]
    assert float(upward.min()) > 0.8 and "Z is up" in motion.notes[0]
