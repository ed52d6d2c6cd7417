"""The mannequin: what it shows is what its truth says."""

import contextlib
import dataclasses
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from pipeline.body import is_face, joint_index, load_body, load_landmarks, pose_body, rasterize, read_poses
from pipeline.camera import project, to_camera
from pipeline.errors import UserError
from pipeline.frames import read_frame, read_mask
from pipeline.keypoints import BODY, FACE, LEFT_HAND, read_keypoints
from pipeline.records import read_cameras, read_footage, read_split
from stages.ingest.mannequin import FRAMINGS, MannequinSpec
from stages.ingest.mannequin.bvh import read_bvh
from stages.ingest.mannequin.footage import Filming, film_view, make_mannequin
from stages.ingest.mannequin.framing import unseen_camera
from stages.ingest.mannequin.motion import make_motion
from stages.ingest.mannequin.person import make_identity
from stages.ingest.mannequin.publish import run_mannequin
from stages.ingest.mannequin.spec import spec_of
from stages.ingest.mannequin.truth import HIDDEN, OUTSIDE, SEEN, read_truth, seen_vertices, states

BODY_FOLDER = Path(__file__).parents[2] / "data" / "body"
SIZE, FRAMES = 96, 5
HALF_WAY = 2  # frame; a turning body faces away by then
THRESHOLD = 0.4  # the score under which the method masks a point


@pytest.fixture(scope="module")
def body():
    return load_body(BODY_FOLDER / "open_body.npz")


@pytest.fixture(scope="module")
def landmarks(body):
    return load_landmarks(body, BODY_FOLDER)


def spec_for(framing, **changes):
    return MannequinSpec(framing=framing, frames=FRAMES, size=SIZE, fps=FRAMES, seed=3, identity=1, **changes)


@pytest.fixture(scope="module")
def clips(body, landmarks):
    """A clip in each framing; the full one turns once round."""
    return {f: make_mannequin(spec_for(f, hand_failures=0.0), body, landmarks) for f in FRAMINGS}


def joint_pixels(clip):
    return project(clip.cameras[0], torch.from_numpy(clip.truth.joints)).numpy()


def test_equal_specs_give_equal_clips(body, landmarks, clips):
    again = make_mannequin(spec_for("upper", hand_failures=0.0), body, landmarks)
    first = clips["upper"]
    assert (again.frames == first.frames).all() and (again.masks == first.masks).all()
    for field in dataclasses.fields(first.keypoints):
        assert (getattr(again.keypoints, field.name) == getattr(first.keypoints, field.name)).all()
    assert (again.truth.joints == first.truth.joints).all()


def test_other_seeds_give_other_people_and_motions(body):
    joints = body.joint_regressor @ body.v_template
    first, other = (make_motion(MannequinSpec(seed=seed), joints, body.parents, 5) for seed in (0, 1))
    assert (first.rotation - other.rotation).abs().max() > 0.1
    assert torch.equal(make_identity(body, 1).betas, make_identity(body, 1).betas)
    one, somebody = make_identity(body, 1), make_identity(body, 2)
    for field in ("betas", "joint_offset", "face_offset"):
        assert not torch.allclose(getattr(one, field), getattr(somebody, field))
    mirrored = one.joint_offset[joint_index("left_knee")] * torch.tensor([-1.0, 1, 1])
    assert torch.equal(mirrored, one.joint_offset[joint_index("right_knee")])
    assert not one.face_offset[~is_face(body)].any()


@pytest.mark.parametrize("framing", FRAMINGS)
def test_mask_is_the_posed_truth(clips, body, framing):
    """The mask is the silhouette of the LBS-posed truth, averaged over the samples of a pixel."""
    clip = clips[framing]
    poses = clip.truth.poses
    for row in (0, HALF_WAY):
        frame = slice(row, row + 1)
        vertices, _ = pose_body(
            body, clip.truth.surface, poses.rotation[frame], poses.expression[frame], poses.transl[frame]
        )
        camera = clip.cameras[row].resized(2 * SIZE, 2 * SIZE)
        covered = rasterize(camera, vertices[0], body.faces).covered
        alpha = covered.reshape(SIZE, 2, SIZE, 2).mean((1, 3)) * 255
        assert (np.abs(alpha - clip.masks[row]) > 1).mean() < 1e-3
        assert 0.005 < ((alpha > 0) & (alpha < 255)).mean() < 0.2  # the edge is soft


@pytest.mark.parametrize("framing", FRAMINGS)
def test_seen_joints_lie_inside_the_mask(clips, framing):
    clip = clips[framing]
    pixels = joint_pixels(clip)
    seen = clip.truth.joint_state == SEEN
    assert seen.sum() > 20 * FRAMES if framing == "full" else seen.any()
    for row, joint in zip(*np.nonzero(seen), strict=True):
        x, y = pixels[row, joint].astype(int)
        near = clip.masks[row, max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2]
        assert near.max() > 0, (framing, row, joint)


def test_truth_joints_are_those_of_the_posed_body(clips, body):
    truth = clips["full"].truth
    _, joints = pose_body(
        body, truth.identity, truth.poses.rotation, truth.poses.expression, truth.poses.transl
    )
    torch.testing.assert_close(torch.from_numpy(truth.joints), joints, atol=1e-5, rtol=0)


@pytest.mark.parametrize("framing", FRAMINGS)
def test_points_that_are_not_seen_score_low_and_are_wrong(clips, framing):
    clip = clips[framing]
    found, truth = clip.keypoints.whole_body, clip.truth
    seen = truth.keypoint_state == SEEN
    assert (found[~seen][:, 2] < THRESHOLD).all()
    assert (found[~seen][:, 2] > 0).all()
    hidden = found[~seen][:, :2]
    assert ((hidden >= 0) & (hidden <= SIZE)).all()
    away = np.linalg.norm(found[..., :2] - truth.keypoints, axis=-1)
    trusted = found[..., 2] >= THRESHOLD
    assert trusted.sum() > 0.25 * seen.sum()
    assert np.median(away[trusted]) < 2
    assert np.median(away[~seen]) > 3 * np.median(away[trusted])


def test_noise_zero_gives_the_truth_for_seen_points(body, landmarks):
    clip = make_mannequin(
        dataclasses.replace(spec_for("upper", noise=0.0, hand_failures=0.0), frames=2), body, landmarks
    )
    found = clip.keypoints.whole_body
    trusted = found[..., 2] >= THRESHOLD
    assert trusted.any()
    np.testing.assert_allclose(found[trusted][:, :2], clip.truth.keypoints[trusted], atol=1e-3)


def test_hands_fail_when_told_to(body, landmarks):
    """A failing hand is far from the truth although some of them score well."""
    clip = make_mannequin(
        dataclasses.replace(spec_for("full", hand_failures=1.0), motion="stand+curl", frames=3),
        body,
        landmarks,
    )
    away = np.linalg.norm(
        clip.keypoints.whole_body[:, LEFT_HAND, :2] - clip.truth.keypoints[:, LEFT_HAND], axis=-1
    )
    assert np.median(away) > 2


def test_a_face_that_is_turned_away_is_not_trusted(clips):
    clip = clips["full"]
    back = np.abs(clip.truth.poses.rotation[:, 0, 1].numpy() - math.pi) < 0.7
    assert back.any()
    assert (clip.keypoints.face_mesh[back][..., 3] < THRESHOLD).all()
    assert (clip.keypoints.whole_body[back][:, FACE, 2] < THRESHOLD).all()
    assert (clip.keypoints.face_mesh[0, :, 3] >= THRESHOLD).mean() > 0.5


def test_world_points_are_metres_about_the_hips(clips):
    clip = clips["full"]
    camera = clip.cameras[0]
    joints = to_camera(camera, torch.from_numpy(clip.truth.joints)).numpy()
    hips = joints[:, [1, 2]].mean(1)
    found = clip.keypoints.pose_world
    for landmark, joint in ((11, "left_shoulder"), (25, "left_knee"), (28, "right_ankle")):
        trusted = found[:, landmark, 3] >= THRESHOLD
        expected = joints[:, joint_index(joint)] - hips
        assert trusted.any()
        np.testing.assert_allclose(found[trusted, landmark, :3], expected[trusted], atol=0.2)


def test_framings_show_what_they_say(clips):
    names = {"ankle": "left_ankle", "waist": "spine1", "wrist": "left_wrist", "head": "head", "neck": "neck"}
    heights = {
        f: {k: joint_pixels(c)[:, joint_index(n), 1] for k, n in names.items()} for f, c in clips.items()
    }
    assert (clips["full"].truth.joint_state != OUTSIDE).all()
    assert (clips["full"].masks[:, [0, -1]] == 0).all() and (clips["full"].masks[:, :, [0, -1]] == 0).all()
    assert (heights["upper"]["ankle"] > SIZE).all() and (heights["upper"]["neck"] < 0.6 * SIZE).all()
    assert abs(np.median(heights["upper"]["waist"]) - SIZE) < 0.05 * SIZE
    assert (heights["head"]["waist"] > SIZE).all() and (heights["head"]["neck"] < SIZE).all()
    for framing in ("upper", "head"):
        assert (clips[framing].masks[:, -1] > 0).any(1).all()  # the body goes on below the picture
        assert (clips[framing].truth.joint_state[:, joint_index("left_ankle")] == OUTSIDE).all()


def test_a_turning_body_hides_its_points(clips):
    states = clips["full"].truth.keypoint_state
    assert (states[0, BODY] == SEEN).mean() > 0.8
    assert (states[HALF_WAY, :5] == HIDDEN).sum() >= 3  # nose and eyes from behind


def test_pictures_have_texture_and_the_background_none_of_it(clips):
    image = clips["head"].frames[0].astype(float)
    mask = clips["head"].masks[0]
    detail = np.abs(np.diff(image.mean(2), axis=1))
    inside, outside = mask[:, 1:] == 255, mask[:, 1:] == 0
    assert detail[inside].mean() > 2 * detail[outside].mean()


def test_unseen_cameras_look_at_the_same_body(clips, body):
    clip = clips["full"]
    spec = spec_for("full", views=("left", "back"), view_stride=4)
    (row, camera, picture), (second, _, _) = film_view(spec, clip.scene, "left")
    assert (row, second) == (0, 4)
    pixels = project(camera, torch.from_numpy(clip.truth.joints[0])).numpy().astype(int)
    assert (picture.mask[pixels[:, 1], pixels[:, 0]] > 0).mean() > 0.9
    assert camera.centre[0] > 1  # the subject's left is +X
    back = unseen_camera(clip.scene.shot, "back")
    facing = to_camera(back, clip.scene.shot.centre[None])[0]
    torch.testing.assert_close(facing, -clip.scene.shot.centre, atol=1e-4, rtol=0)


def test_seen_vertices_face_the_camera(clips):
    clip = clips["upper"]
    vertices = clip.scene.vertices(0)
    camera = clip.cameras[0]
    depth = rasterize(camera, vertices, clip.scene.body.faces).depth
    seen = seen_vertices(camera, depth, vertices)
    assert 0.1 < seen.mean() < 0.7
    assert vertices[torch.from_numpy(seen), 1].min() > vertices[:, 1].min() + 0.4  # no feet


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
    return make_motion(spec, body.joint_regressor @ body.v_template, body.parents, 5)


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


@pytest.mark.parametrize(
    "wrong", [{"framing": "feet"}, {"motion": "fly"}, {"frames": 1}, {"views": ("below",)}, {"noise": -1.0}]
)
def test_specs_are_checked(wrong):
    with pytest.raises(ValueError, match="mannequin"):
        MannequinSpec(**wrong)


def test_what_ingest_publishes_is_published(tmp_path, body):
    settings = SimpleNamespace(
        mannequin="head", mannequin_frames=4, mannequin_size=48,
        mannequin_views=("left",), mannequin_view_stride=2, test_fraction=0.25, test_frames=0,
    )  # fmt: skip
    assert spec_of(settings) == MannequinSpec("head", frames=4, size=48, views=("left",), view_stride=2)
    outputs = []
    for name in ("a", "b"):
        output = tmp_path / name
        output.mkdir()
        run_mannequin(
            SimpleNamespace(
                settings=settings,
                source=None,
                output=output,
                body=BODY_FOLDER,
                body_file=BODY_FOLDER / "open_body.npz",
                log=lambda message: None,
                timing=lambda name, value: None,
                progress=lambda total, label: contextlib.nullcontext(SimpleNamespace(advance=lambda: None)),
            )  # fmt: skip
        )
        outputs.append(
            {str(f.relative_to(output)): f.read_bytes() for f in sorted(output.rglob("*")) if f.is_file()}
        )
    assert outputs[0] == outputs[1]
    frames, masks = read_frame(output / "frames", 3), read_mask(output / "masks", 3)
    assert frames.shape == (48, 48, 3) and masks.shape == (48, 48)
    assert read_keypoints(output / "keypoints.parquet").frames.tolist() == [0, 1, 2, 3]
    assert read_split(output / "split.json").test == (3,)
    assert read_footage(output / "footage.json").kept == 4
    assert set(read_cameras(output / "cameras.parquet")) == {0, 1, 2, 3}
    assert set(read_cameras(output / "views" / "left" / "cameras.parquet")) == {0, 2}
    assert read_mask(output / "views" / "left" / "masks", 2).any()
    truth = read_truth(output, body)
    assert torch.equal(read_poses(output / "truth_poses.parquet").rotation, truth.poses.rotation)
    assert truth.joints.shape == (4, 55, 3) and truth.surface.face_offset.abs().max() > 0.01


def test_a_limb_hides_its_own_joints_less_than_others_do(body, landmarks):
    """An elbow behind its own hand is seen; behind the trunk it is not."""
    spec = dataclasses.replace(spec_for("full", hand_failures=0.0), motion="stand", frames=2)
    filming = Filming(spec, body, landmarks)
    picture, camera, places = next(filming.pictures()), filming.scene.shot.camera, filming.places
    elbow = joint_index("left_elbow")
    assert states(camera, picture, places, 0)[elbow] == SEEN
    x, y = (project(camera, places.world[0, elbow]) * 2).long().tolist()
    for limb, nearer, expected in ((1, 0.15, SEEN), (1, 0.4, HIDDEN), (2, 0.15, HIDDEN), (0, 0.15, HIDDEN)):
        depth, limbs = picture.depth.copy(), picture.limb.copy()
        depth[y, x], limbs[y, x] = -places.world[0, elbow, 2] - nearer, limb
        changed = dataclasses.replace(picture, depth=depth, limb=limbs)
        assert states(camera, changed, places, 0)[elbow] == expected
