"""The mannequin: what it shows is what its truth says."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from pipeline.body import is_face, joint_index, pose_body, rasterize, read_poses
from pipeline.clip.camera import project, to_camera
from pipeline.clip.frames import read_frame, read_mask
from pipeline.clip.keypoints import BODY, FACE, LEFT_HAND, read_keypoints
from pipeline.clip.records import read_cameras, read_footage, read_split
from stages.ingest.mannequin import FRAMINGS, MannequinSpec
from stages.ingest.mannequin.footage import Filming, film_view, make_mannequin, run_mannequin
from stages.ingest.mannequin.framing import unseen_camera
from stages.ingest.mannequin.motion import make_motion
from stages.ingest.mannequin.person import make_identity
from stages.ingest.mannequin.spec import mannequin_spec
from stages.ingest.mannequin.truth import HIDDEN, OUTSIDE, SEEN, point_states, read_truth, seen_vertices
from stages.ingest.settings import IngestSettings
from tests.made.context import stage_context

SIZE, FRAMES = 96, 5
HALF_WAY = 2  # frame; a turning body faces away by then
THRESHOLD = 0.4  # the score under which the method masks a point


def spec_for(framing, **changes):
    return MannequinSpec(framing=framing, frames=FRAMES, size=SIZE, fps=FRAMES, seed=3, identity=1, **changes)


@pytest.fixture(scope="module")
def clips(body, landmarks):
    """A clip in each framing; the full one turns once round."""
    return {f: make_mannequin(spec_for(f, hand_failures=0.0), body, landmarks) for f in FRAMINGS}


def distance_outside(pixels):
    """How far points [..., 2] lie outside the picture, [...] pixels."""
    return np.linalg.norm(np.clip(pixels, 0, SIZE) - pixels, axis=-1)


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
    first, other = (
        make_motion(MannequinSpec(seed=seed), joints, body.parents, torch.zeros(5)) for seed in (0, 1)
    )
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
def test_a_heatmap_puts_what_is_outside_inside_and_scores_every_point(body, landmarks, framing):
    clip = make_mannequin(spec_for(framing, detector="heatmap", hand_failures=0.0), body, landmarks)
    found, truth = clip.keypoints.whole_body, clip.truth
    assert ((found[..., :2] >= 0) & (found[..., :2] <= SIZE)).all()
    assert (found[..., 2] > 0).all()
    assert not clip.keypoints.pose_image.any() and not clip.keypoints.face_mesh.any()
    away = np.linalg.norm(found[..., :2] - truth.keypoints, axis=-1)
    seen = truth.keypoint_state == SEEN
    assert np.median(away[seen]) < 2
    far = distance_outside(truth.keypoints) > 0.3 * SIZE
    assert far.any() != (framing == "full")
    assert (found[far][:, 2] < THRESHOLD).all()
    assert (away[far] > 0.3 * SIZE).all()


@pytest.mark.parametrize("framing", ["upper", "head"])
def test_mediapipe_guesses_outside_the_picture_with_scores_that_fall(clips, framing):
    """Far outside they are masked by their score; just outside only by their place."""
    clip = clips[framing]
    found = clip.keypoints.pose_image
    hips, ankles = (found[:, rows] for rows in (slice(23, 25), slice(27, 29)))
    assert (found[:, 23:, 1] > SIZE).all()
    assert (ankles[..., 3] < 0.2).all()
    assert (hips[..., 3].mean() > 0.2) == (framing == "upper")
    steps = np.abs(np.diff(ankles[..., :2], axis=0)).max()
    assert 0 < steps < 0.5 * SIZE
    kept = clip.keypoints.whole_body[..., 2] > 0  # as ingest writes them: nothing outside
    assert (
        (clip.keypoints.whole_body[kept][:, :2] >= 0) & (clip.keypoints.whole_body[kept][:, :2] < SIZE)
    ).all()


def test_points_that_are_hidden_are_near_and_score_well(clips):
    clip = clips["full"]
    hidden = clip.truth.keypoint_state[:, BODY] == HIDDEN
    found = clip.keypoints.whole_body[:, BODY][hidden]
    away = np.linalg.norm(found[:, :2] - clip.truth.keypoints[:, BODY][hidden], axis=-1)
    assert (found[:, 2] >= THRESHOLD).mean() > 0.8
    assert 0.2 < np.median(away) < 0.05 * SIZE


def test_noise_zero_gives_the_truth_for_seen_points(body, landmarks):
    clip = make_mannequin(
        dataclasses.replace(spec_for("upper", noise=0.0, hand_failures=0.0), frames=2), body, landmarks
    )
    found = clip.keypoints.whole_body
    trusted = (found[..., 2] >= THRESHOLD) & (clip.truth.keypoint_state == SEEN)
    assert trusted.sum() > 100
    np.testing.assert_allclose(found[trusted][:, :2], clip.truth.keypoints[trusted], atol=1e-3)


def test_a_hand_of_which_nothing_is_seen_is_not_found(clips):
    clip = clips["head"]
    assert (clip.truth.keypoint_state[:, LEFT_HAND] != SEEN).all()
    assert not clip.keypoints.hands.any() and not clip.keypoints.whole_body[:, LEFT_HAND].any()
    assert clips["full"].keypoints.hands.any()


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
    point_states = clips["full"].truth.keypoint_state
    assert (point_states[0, BODY] == SEEN).mean() > 0.8
    assert (point_states[HALF_WAY, :5] == HIDDEN).sum() >= 3  # nose and eyes from behind


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


@pytest.mark.parametrize(
    "wrong", [{"framing": "feet"}, {"motion": "fly"}, {"frames": 1}, {"views": ("below",)}, {"noise": -1.0}]
)
def test_specs_are_checked(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        MannequinSpec(**wrong)


def test_what_ingest_publishes_is_published(tmp_path, body):
    settings = IngestSettings(
        mannequin="head", mannequin_frames=4, mannequin_size=48, mannequin_views=("left",),
        mannequin_view_stride=2, test_fraction=0.25,
    )  # fmt: skip
    assert mannequin_spec(settings) == MannequinSpec(
        "head", frames=4, size=48, views=("left",), view_stride=2
    )
    outputs = []
    for name in ("a", "b"):
        output = tmp_path / name
        run_mannequin(stage_context("ingest", settings, output))
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
    assert point_states(camera, picture, places, 0)[elbow] == SEEN
    x, y = (project(camera, places.world[0, elbow]) * 2).long().tolist()
    for limb, nearer, expected in ((1, 0.15, SEEN), (1, 0.4, HIDDEN), (2, 0.15, HIDDEN), (0, 0.15, HIDDEN)):
        depth, limbs = picture.depth.copy(), picture.limb.copy()
        depth[y, x], limbs[y, x] = -places.world[0, elbow, 2] - nearer, limb
        changed = dataclasses.replace(picture, depth=depth, limb=limbs)
        assert point_states(camera, changed, places, 0)[elbow] == expected
