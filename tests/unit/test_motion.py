"""Motions of every form, and what becomes of them on another person."""

import dataclasses
import pickle

import numpy as np
import pytest
import roma
import torch

from pipeline.body import (
    JOINT_NAMES,
    joint_index,
    mean_identity,
    pose_body,
    posed_joints,
    rest_joints,
)
from pipeline.clip.keypoints import FACE, LEFT_HAND, empty_keypoints, read_keypoints, write_keypoints
from pipeline.errors import UserError
from pipeline.pose_files import read_hand_mean
from stages.animate.motions.motion import Motion, Span, leg_length
from stages.animate.motions.placement import place
from stages.animate.motions.read import DrivenPerson, read_motion, with_relaxed_hands
from stages.animate.motions.source import motion_source
from tests.made.body import BODY_FILE
from tests.made.motions import (
    FPS,
    made_up,
    write_capture,
    write_fitted,
    write_folder,
    write_npz,
)

COUNT = 7
TRUNK = [joint_index(name) for name in ("spine1", "spine2", "spine3", "left_collar", "right_collar", "neck")]


@pytest.fixture(scope="module")
def person(body):
    return DrivenPerson(body, BODY_FILE, mean_identity(body))


@pytest.fixture(scope="module")
def pivot(person):
    return rest_joints(person.body, person.identity)[0].double()


@pytest.fixture(scope="module")
def truth():
    return made_up(COUNT)


def read(path, person, span=None, up="auto", folders=None):
    return read_motion(motion_source(str(path)), person, span or Span(), up, folders or {})


def angle(a, b):
    """Radians between rotation vectors [..., 3]."""
    return roma.rotmat_geodesic_distance(roma.rotvec_to_rotmat(a.double()), roma.rotvec_to_rotmat(b.double()))


def check(motion, truth, person, joints=slice(None), most=1e-3):
    """The motion is the truth, once it is placed: rotations, way, and the ground."""
    rotation, way = truth
    placed = place(motion, person.body, person.identity)
    assert motion.fps == pytest.approx(FPS) and len(placed) == len(way)
    assert float(angle(placed.rotation, rotation)[:, joints].max()) < most
    moved = placed.transl - placed.transl[:1]
    assert torch.allclose(moved.double(), way, atol=1e-3)
    return placed


FORMS = {
    "amass": lambda path, truth, pivot: write_npz(path / "a.npz", *truth, pivot),
    "smplx": lambda path, truth, pivot: write_npz(path / "a.npz", *truth, pivot, "poses165"),
    "parts": lambda path, truth, pivot: write_npz(path / "a.npz", *truth, pivot, "parts"),
    "y up": lambda path, truth, pivot: write_npz(path / "a.npz", *truth, pivot, "poses165", z_up=False),
    "peers": lambda path, truth, pivot: write_folder(path / "smplx_init", *truth, pivot, BODY_FILE),
}


@pytest.mark.parametrize("form", FORMS)
def test_every_form_tells_the_same_motion(tmp_path, form, truth, pivot, person):
    motion = read(FORMS[form](tmp_path, truth, pivot), person)
    check(motion, truth, person)
    untold = {"amass": 3, "parts": 2}.get(form, 0)  # jaw and eyes, or eyes
    assert len(JOINT_NAMES) - len(motion.told) == untold
    assert motion.expression is None  # these coefficients are another body's


def test_a_capture_tells_the_same_motion(tmp_path, truth, person):
    rotation, way = truth
    path = write_capture(tmp_path / "walk.bvh", rotation, way, person)
    limbs = [joint for joint in range(25) if JOINT_NAMES[joint] not in ("jaw", "left_eye", "right_eye")]
    motion = read(path, person)
    check(motion, truth, person, limbs, most=0.01)
    check(motion, truth, person, most=0.06)  # the hands' orientation is found from their knuckles
    assert set(JOINT_NAMES) - set(motion.told) == {"jaw", "left_eye", "right_eye"} and not motion.unused


def test_what_a_capture_has_besides_is_named(tmp_path, truth, person):
    names = {"mixamorig:LeftHandRing2": "Tail", "mixamorig:Spine1": "Hump"}
    path = write_capture(tmp_path / "odd.bvh", *truth, person, rename=lambda name: names.get(name, name))
    motion = read(path, person)
    assert motion.unused == ("Hump", "Tail") or set(motion.unused) == {"Hump", "Tail"}
    assert "left_ring2" not in motion.told and "spine2" not in motion.told


def test_another_subjects_clip_in_whatever_world_it_stands(tmp_path, truth, person, body):
    rotation, way = truth
    psi = torch.randn(COUNT, 4, generator=torch.Generator().manual_seed(0))
    tilted = roma.rotvec_to_rotmat(torch.tensor([0.4, 1.9, -0.3], dtype=torch.float64))
    for name, turned in (("plain", None), ("tilted", tilted)):
        folders = write_fitted(tmp_path / name, rotation, way, person.identity, body, psi, turned)
        motion = read("subject:other", person, folders=folders)
        placed = check(motion, truth, person)
        assert torch.equal(placed.expression[:, :4], psi) and not placed.expression[:, 4:].any()
    assert motion.numbers == tuple(range(0, 2 * COUNT, 2))


def test_what_a_clip_does_not_show_is_left_out_and_said(tmp_path, truth, person, body):
    psi = torch.ones(COUNT, 4)
    unseen = (FACE, LEFT_HAND)
    folders = write_fitted(tmp_path, *truth, person.identity, body, psi, unseen=unseen)
    motion = read("subject:other", person, folders=folders)
    assert motion.expression is None
    assert {"jaw", "left_eye", "left_ring2"} & set(motion.told) == set() and "right_ring2" in motion.told
    jaw = joint_index("jaw")
    assert not motion.rotation[:, [jaw, jaw + 1, jaw + 2]].any()
    said = " ".join(motion.notes)
    assert "face" in said and "left hand" in said and "right hand" not in said


def test_a_part_that_some_frames_show_is_kept_and_said(tmp_path, truth, person, body):
    folders = write_fitted(tmp_path, *truth, person.identity, body, torch.ones(COUNT, 4))
    known = read_keypoints(folders["ingest"] / "keypoints.parquet")
    known.whole_body[1:, FACE] = 0
    write_keypoints(folders["ingest"] / "keypoints.parquet", known)
    motion = read("subject:other", person, folders=folders)
    assert motion.expression is not None and "jaw" in motion.told
    assert any(f"{100 / COUNT:.0f}%" in note and "face" in note for note in motion.notes)


def test_a_clip_without_keypoints_tells_all_that_its_poses_do(tmp_path, truth, person, body):
    folders = write_fitted(tmp_path, *truth, person.identity, body, torch.ones(COUNT, 4))
    frames = read_keypoints(folders["ingest"] / "keypoints.parquet").frames
    write_keypoints(folders["ingest"] / "keypoints.parquet", empty_keypoints(frames))
    motion = read("subject:other", person, folders=folders)
    assert motion.expression is not None and motion.told == JOINT_NAMES and motion.notes == ()


@pytest.mark.parametrize("count", [1, 2])
def test_a_clip_of_a_frame_or_two(count, tmp_path, truth, person, body):
    rotation, way = truth
    folders = write_fitted(tmp_path, rotation[:count], way[:count], person.identity, body)
    motion = read("subject:other", person, folders=folders)
    assert len(motion) == count and motion.fps > 0
    placed = place(motion, body, person.identity)
    assert bool(placed.rotation.isfinite().all()) and bool(placed.transl.isfinite().all())


@pytest.mark.parametrize(
    ("file", "subject"),
    [
        ("dance.mp4", "dance"), ("my dance (2).MOV", "my_dance__2_"), ("_x.mkv", "clip_x"),
        ("été.webm", "clip_t_"), (f"{'long' * 40}.avi", "long" * 25),
    ],
)  # fmt: skip
def test_a_clip_is_a_motion_under_a_subjects_name(file, subject, tmp_path):
    (tmp_path / file).write_bytes(b"anything")
    source = motion_source(str(tmp_path / file))
    assert (source.kind, source.subject, source.path) == ("clip", subject, tmp_path / file)


def test_gaps_between_a_folders_frames_come_from_the_neighbours(tmp_path, truth, pivot, person):
    folder = write_folder(tmp_path / "smplx_init", *truth, pivot, BODY_FILE)
    (folder / "6.json").unlink()
    motion = read(folder, person)
    assert motion.numbers == tuple(range(4, 4 + COUNT)) and any(
        "interpolated" in note for note in motion.notes
    )
    between = (motion.root[1] + motion.root[3]) / 2
    assert torch.allclose(motion.root[2], between, atol=1e-5)


@pytest.mark.parametrize(
    ("span", "available", "own", "rows", "fps"),
    [
        (Span(), 5, 30.0, [0, 1, 2, 3, 4], 30.0),
        (Span(), 7, 100.0, [0, 3, 6], 100 / 3),
        (Span(first=2, last=5), 100, 24.0, [2, 3, 4, 5], 24.0),
        (Span(fps=10.0), 9, 30.0, [0, 3, 6], 10.0),
        (Span(fps=60.0), 3, 30.0, [0, 0, 1, 2, 2, 2], 60.0),
        (Span(first=8, last=99), 10, 30.0, [8, 9], 30.0),
    ],
)
def test_which_frames_are_taken(span, available, own, rows, fps):
    found, rate = span.rows(available, own, "clip")
    assert found.tolist() == rows and rate == pytest.approx(fps)


def test_an_empty_range_says_what_there_is():
    with pytest.raises(UserError, match=r"frames 0 to 9, none between 10 and the end.*first_frame"):
        Span(first=10).rows(10, 30.0, "walk.bvh")


def longer_legs(body, share):
    """The mean body with its legs stretched."""
    identity, offset = mean_identity(body), torch.zeros(55, 3)
    joints = rest_joints(body, identity)
    for side in ("left", "right"):
        chain = [joint_index(f"{side}_{name}") for name in ("hip", "knee", "ankle", "foot")]
        for joint in chain[1:]:
            offset[joint] = (share - 1) * (joints[joint] - joints[chain[0]])
    return dataclasses.replace(identity, joint_offset=offset)


def test_longer_legs_walk_farther_and_turn_as_much(truth, body, person):
    rotation, way = truth
    motion = Motion(
        "walk", FPS, tuple(range(COUNT)), rotation.float(), None, way.float(), leg_length(body), JOINT_NAMES
    )
    tall = longer_legs(body, 1.3)
    short, long = place(motion, body, person.identity), place(motion, body, tall)
    assert long.scale == pytest.approx(1.3, rel=1e-3) and short.scale == pytest.approx(1)
    assert torch.equal(long.rotation, short.rotation)
    moved = [(one.transl - one.transl[:1]).double() for one in (short, long)]
    assert torch.allclose(moved[0], way, atol=1e-5) and torch.allclose(moved[1], 1.3 * way, atol=1e-3)


def test_the_feet_are_on_the_ground_and_the_pelvis_above_the_origin(truth, body, person):
    rotation, way = truth
    motion = Motion(
        "walk", FPS, tuple(range(COUNT)), rotation.float(), None, way.float(), leg_length(body), JOINT_NAMES
    )
    for identity in (person.identity, longer_legs(body, 1.3)):
        placed = place(motion, body, identity)
        feet = body.skinning_weights[:, [7, 8, 10, 11]].sum(1) > 0.5
        vertices, _ = pose_body(body, identity, placed.rotation, placed.expression, placed.transl)
        assert float(vertices[:, feet, 1].min()) == pytest.approx(0, abs=1e-4)
        pelvis = rest_joints(body, identity)[0] + placed.transl[0]
        assert pelvis[[0, 2]].abs().max() < 1e-6 and 0.5 < pelvis[1] < 1.5


def test_a_walk_on_the_spot_keeps_its_turns(truth, body, person):
    rotation, way = truth
    motion = Motion(
        "walk", FPS, tuple(range(COUNT)), rotation.float(), None, way.float(), leg_length(body), JOINT_NAMES
    )
    still = place(motion, body, person.identity, in_place=True)
    assert torch.allclose(still.transl, still.transl[:1].expand_as(still.transl))
    assert torch.equal(still.rotation, place(motion, body, person.identity).rotation)


def test_front_is_where_the_first_frame_looks_unless_a_camera_says(truth, body, person):
    rotation, way = truth
    turn = roma.rotvec_to_rotmat(torch.tensor([0.0, 2.0, 0.0]))
    turned = rotation.float().clone()
    turned[:, 0] = roma.rotmat_to_rotvec(turn @ roma.rotvec_to_rotmat(turned[:, 0]))
    motion = Motion(
        "walk", FPS, (0,) * COUNT, turned, None, way.float() @ turn.mT, leg_length(body), JOINT_NAMES
    )
    check(motion, truth, person)
    filmed = place(dataclasses.replace(motion, faces_camera=True), body, person.identity)
    assert torch.equal(filmed.rotation, turned)


def test_hands_that_nobody_captured_hang_relaxed(truth, person):
    rotation, way = truth
    told = tuple(name for name in JOINT_NAMES if not name.startswith("left_thumb"))
    motion = Motion("walk", FPS, (0,) * COUNT, rotation.float(), None, way.float(), 0.8, told)
    mean = read_hand_mean(BODY_FILE)
    relaxed = with_relaxed_hands(motion, mean)
    thumb = [joint_index(f"left_thumb{k}") for k in (1, 2, 3)]
    assert torch.equal(relaxed.rotation[2, thumb], mean[[joint - 25 for joint in thumb]])
    others = [joint for joint in range(55) if joint not in thumb]
    assert torch.equal(relaxed.rotation[:, others], motion.rotation[:, others])


class Evil:
    def __reduce__(self):
        return (print, ("executed",))


def test_wrong_files_are_named_with_a_remedy_and_never_executed(tmp_path, truth, pivot, person, capsys):
    def refused(path, *words):
        with pytest.raises(UserError) as error:
            read(path, person)
        assert all(word in str(error.value) for word in (str(path), *words)), error.value

    refused(tmp_path / "none.bvh", "no such file", "subject:NAME")
    (tmp_path / "dance.fbx").write_text("x")
    refused(tmp_path / "dance.fbx", ".fbx", ".bvh")
    np.savez(tmp_path / "objects.npz", poses=np.array([Evil()], object))
    refused(tmp_path / "objects.npz")
    (tmp_path / "pickle.npz").write_bytes(pickle.dumps(Evil()))
    refused(tmp_path / "pickle.npz", "npz archive")
    np.savez(tmp_path / "lacks.npz", trans=np.zeros((3, 3)))
    refused(tmp_path / "lacks.npz", "root_orient", "AMASS")
    np.savez(tmp_path / "odd.npz", poses=np.zeros((3, 100)))
    refused(tmp_path / "odd.npz", "(3, 100)", "156")
    np.savez(tmp_path / "nan.npz", poses=np.full((3, 156), np.nan))
    refused(tmp_path / "nan.npz", "no motion has")
    np.savez(tmp_path / "empty.npz", poses=np.zeros((0, 156)))
    refused(tmp_path / "empty.npz", "no frames")
    write_npz(tmp_path / "slow.npz", *truth, pivot, mocap_framerate=np.array(-3.0))
    refused(tmp_path / "slow.npz", "frames a second")
    write_capture(tmp_path / "dog.bvh", *truth, person, rename=lambda name: name.replace("Arm", "Paw"))
    refused(tmp_path / "dog.bvh", "left_elbow", "mixamorig:Hips", "Mixamo")
    for name, text in (
        ("cut", "HIERARCHY ROOT Hips { CHANNELS 99999999"),
        ("stray", "HIERARCHY CHANNELS 1 x"),
    ):
        (tmp_path / f"{name}.bvh").write_text(text)
        refused(tmp_path / f"{name}.bvh", "BVH")
    (tmp_path / "folder").mkdir()
    refused(tmp_path / "folder", "none usable")
    assert "executed" not in capsys.readouterr().out


def test_a_far_numbered_frame_does_not_fill_the_memory(tmp_path, truth, pivot, person):
    folder = write_folder(tmp_path / "smplx_init", *truth, pivot, BODY_FILE)
    (folder / "4.json").rename(folder / "900000000.json")
    with pytest.raises(UserError, match="900000000"):
        read(folder, person)


def test_a_real_dance_is_carried_over(shared_folder, person, body):
    path = shared_folder / "data" / "motion" / "jesse_dance.bvh"
    if not path.is_file():
        pytest.skip("there is no motion capture here")
    motion = read(path, person, Span(0, 300))
    assert motion.fps == pytest.approx(100 / 3) and len(motion) == 101
    assert "LeftInHandIndex" in motion.unused and "left_index2" in motion.told
    placed = place(motion, body, person.identity)
    joints = posed_joints(placed.rotation, rest_joints(body, person.identity), body.parents)
    height = joints[:, joint_index("head"), 1] + placed.transl[:, 1]
    assert 1.4 < float(height.min()) and float(height.max()) < 1.9  # she hops
