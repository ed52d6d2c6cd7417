"""The auxiliary stage: guidance, the texture, the crop, folders of others, and when nothing is made."""

import dataclasses
import json
import shutil

import cv2
import numpy as np
import pytest
import torch

from pipeline.body import (
    joint_index,
    pose_body,
    pose_frame,
    posed_vertices,
    read_poses,
    rest_joints,
    vertex_normals,
)
from pipeline.clip.camera import project
from pipeline.clip.frames import read_frame, read_mask, write_frame, write_video
from pipeline.clip.keypoints import FACE, read_keypoints
from pipeline.clip.plan import write_plan
from pipeline.clip.records import read_cameras
from pipeline.errors import UserError
from pipeline.texture import (
    VertexColors,
    fine_surface,
    gather_colors,
    paint,
    robust_mean,
    weighted_median,
)
from pipeline.texture.completion import shading
from pipeline.texture.membrane import neighbours, screened_membrane
from stages.auxiliary import run as stage
from stages.auxiliary.crop import find_framing
from stages.auxiliary.folder import read_folder
from stages.auxiliary.publish import NOTHING_NEW
from stages.auxiliary.reference import score_frames
from stages.auxiliary.settings import AuxiliarySettings
from stages.auxiliary.skeleton import OCCLUDED, body_18, draw_skeleton, turntable_keypoints
from stages.auxiliary.texture_generator import complete
from stages.auxiliary.turntable_motion import ID_OFFSET, make_turntable_motion
from tests.made.body import BODY_FILE, open_body, open_landmarks
from tests.made.mannequin_clip import context_for, read, write_clip
from tests.made.plans import plan_of


@pytest.fixture(scope="module")
def full(tmp_path_factory):
    return write_clip(tmp_path_factory.mktemp("full"))


@pytest.fixture(scope="module")
def head(tmp_path_factory):
    return write_clip(tmp_path_factory.mktemp("head"), "head")


@pytest.fixture(scope="module")
def painted(full, tmp_path_factory):
    """The stage's whole result with the texture generator."""
    context = context_for(full, tmp_path_factory.mktemp("out") / "painted", generator="texture")
    stage.run(context)
    return context


def small(**changes):
    return AuxiliarySettings(frames=8, width=144, height=256, **changes)


# The turn


@pytest.mark.parametrize("motion", ["relaxed", "clip"])
def test_the_turn_goes_once_round_and_stays_in_the_picture(full, motion):
    clip = read(full)
    turn = make_turntable_motion(clip, small(motion=motion))
    pelvis = rest_joints(clip.body, clip.identity)[0]
    headings = []
    for row in range(8):
        vertices, joints = pose_frame(clip.body, clip.identity, turn.poses.pose(row))
        pixels = project(turn.camera, vertices)
        assert bool((pixels >= 0).all()) and bool((pixels < torch.tensor([144.0, 256.0])).all())
        assert torch.allclose(joints[0], pelvis + turn.poses.transl[row], atol=1e-5)
        hips = joints[joint_index("left_hip")] - joints[joint_index("right_hip")]
        headings.append(float(torch.atan2(-hips[2], hips[0])))
    assert turn.azimuth == pytest.approx(np.arange(8) * np.pi / 4)
    steps = np.diff(np.unwrap(headings))
    assert steps == pytest.approx(np.full(7, np.pi / 4), abs=0.01 if motion == "relaxed" else 0.5)
    assert headings[0] == pytest.approx(0, abs=0.01 if motion == "relaxed" else 0.5)


def test_a_turned_away_face_has_no_points_and_a_hidden_limb_a_lower_score(full):
    clip, landmarks = read(full), open_landmarks()
    points = turntable_keypoints(clip, make_turntable_motion(clip, small()), landmarks)
    assert points[0, FACE, 2].mean() > 0.9 and points[4, FACE, 2].mean() < 0.1
    assert points[0, 0, 2] == 1 and points[4, 0, 2] == 0
    assert np.isclose(points[2, :, 2], OCCLUDED).any()


# Skeletons


def test_eighteen_points_from_seventeen():
    whole = np.zeros((133, 3), np.float32)
    whole[:17, 0] = np.arange(17)
    whole[5] = (10, 20, 0.9)
    whole[6] = (30, 40, 0.5)
    points = body_18(whole)
    assert points[1].tolist() == [20, 30, 0.5]
    assert points[[0, 2, 5, 8, 14], 0].tolist() == [0, 30, 10, 12, 2]


def test_a_skeleton_is_drawn_by_confidence():
    whole = np.zeros((133, 3), np.float32)
    whole[5], whole[6] = (80, 40, 1.0), (20, 40, 1.0)
    drawn = draw_skeleton(whole, 100, 100)
    # The limb from the neck to the right shoulder is pure red at 0.6 of full brightness.
    assert drawn[40, 35].tolist() == [153, 0, 0]
    assert drawn[40, 20].tolist() == [255, 170, 0], "joints are not dimmed"
    whole[[5, 6], 2] = 0.5
    assert drawn[40, 35, 0] > draw_skeleton(whole, 100, 100)[40, 35, 0] > 60
    whole[6, 2] = 0.29
    assert not draw_skeleton(whole, 100, 100)[40, 35].any()
    whole[FACE] = (50, 80, 1.0)
    assert draw_skeleton(whole, 100, 100)[80, 50].tolist() == [255, 255, 255]


# Texture


def test_weighted_median_follows_the_weight():
    values = np.array([[10], [20], [200]], np.uint8)
    assert weighted_median(values, np.array([[1], [1], [1]], np.float32)) == 20
    assert weighted_median(values, np.array([[1], [1], [5]], np.float32)) == 200


def test_a_frame_that_slipped_is_outvoted():
    colors = np.full((5, 1, 3), 100, np.uint8)
    colors[0] = 250
    assert robust_mean(colors, np.ones((5, 1), np.float32)) == pytest.approx(100)


def test_a_membrane_without_a_screen_is_straight_between_its_ends():
    count = 11
    chain = np.stack([np.arange(count - 1), np.arange(1, count)], 1)
    values, hold = np.zeros((count, 1)), np.zeros(count)
    values[-1], hold[[0, -1]] = 10, 1e4
    found = screened_membrane(neighbours(chain, count), values, hold, np.full(count, 1e-9))
    assert found[:, 0] == pytest.approx(np.arange(count), abs=1e-2)


def test_a_screen_lets_a_membrane_fade_away_from_what_is_held():
    count = 41
    chain = np.stack([np.arange(count - 1), np.arange(1, count)], 1)
    hold = np.where(np.arange(count) == 0, 1e4, 0.0)
    sink = np.full(count, 0.04)  # a reach of five edges
    found = screened_membrane(neighbours(chain, count), np.full((count, 1), 3.0), hold, sink)[:, 0]
    assert found[0] == pytest.approx(3, abs=1e-2) and found[-1] < 0.02 and (np.diff(found) < 1e-6).all()
    assert found[10] / found[5] == pytest.approx(1 / np.e, rel=0.05)


def test_the_unseen_side_is_the_mirror_of_the_seen_one():
    """Known on the left only, with a pattern: the right gets the pattern, not a blur."""
    body = open_body()
    surface = fine_surface(body, 0)
    points = body.v_template.numpy()
    pattern = 128 + 100 * np.sin(30 * points[:, 1:2]) * np.ones((1, 3))
    known = points[:, 0] > 0
    color, weight = np.where(known[:, None], pattern, 0).astype(np.float32), known.astype(np.float32)
    seen = VertexColors(color, weight, known, np.zeros_like(points))
    found = complete(surface, seen)
    right = points[:, 0] < -0.02
    error = np.abs(found - pattern)[right]
    assert np.median(error) < 5 and error.mean() < 12


def test_an_unseen_back_is_shaded_as_the_light_says():
    """White seen from the front under a lamp in front: the slope is found, and the back is not as bright."""
    surface = fine_surface(open_body(), 0)
    normal = vertex_normals(open_body().v_template, surface.faces).numpy()
    known = normal[:, 2] > 0.1
    color = (150 * np.exp(0.4 * normal[:, 2:3]) * np.ones((1, 3))).astype(np.float32)
    weight = known.astype(np.float32)
    shade = shading(color / 255, weight, normal, surface.segments.part)
    assert shade[known].max() - shade[known].min() == pytest.approx(0.34, abs=0.04)
    back = normal[:, 2] < -0.5
    assert shade[back] == pytest.approx(shade[known].min(), abs=0.02)
    seen = VertexColors(np.where(known[:, None], color, 0), weight, known, normal.astype(np.float32))
    assert np.median(complete(surface, seen)[back]) < 165
    assert not shading(color, np.zeros(len(color)), normal, surface.segments.part).any()


def test_projected_colours_are_those_of_the_frames(full):
    """The textured body in a frame of the clip looks like that frame."""
    clip = read(full)
    surface = fine_surface(clip.body, 1)
    seen = gather_colors(surface, clip, clip.split.train[:3])
    colors = complete(surface, seen)
    frame = clip.split.train[1]
    image, mask, _ = paint(clip.cameras[frame], surface, clip.vertices(frame), colors)
    truth, inside = read_frame(clip.folder / "frames", frame), (mask > 250)
    inside &= cv2.erode(read_mask(clip.folder / "masks", frame), np.ones((5, 5), np.uint8)) > 250
    assert 0.1 < seen.known.mean() < 0.9
    assert np.abs(image.astype(float) - truth)[inside].mean() < 12
    overlap = (mask > 127) & (read_mask(clip.folder / "masks", frame) > 127)
    assert overlap.sum() > 0.95 * (mask > 127).sum()


# The whole stage


def test_the_result_is_whole_and_its_numbers_are_their_own(painted):
    output = painted.output
    counts = json.loads((output / "auxiliary.json").read_text())
    poses, cameras = read_poses(output / "poses.parquet"), read_cameras(output / "cameras.parquet")
    assert counts["offered"] == 8 == counts["kept"] + sum(counts["refused"].values())
    assert counts["kept"] == len(poses) > 2 and min(poses.frames) >= ID_OFFSET
    assert {*poses.frames} == {*cameras} == {*read_keypoints(output / "keypoints.parquet").frames.tolist()}
    for frame in poses.frames:
        size = (cameras[frame].height, cameras[frame].width)
        assert read_frame(output / "frames", frame).shape[:2] == size
        assert read_mask(output / "trust", frame).shape == read_mask(output / "masks", frame).shape == size
    assert set(counts["refused"]) <= {NOTHING_NEW}
    assert ID_OFFSET + 4 in poses.frames, "the back is news"


def test_the_camera_of_a_crop_sees_the_person_where_the_picture_has_it(full, painted):
    clip, output = read(full), painted.output
    poses, cameras = read_poses(output / "poses.parquet"), read_cameras(output / "cameras.parquet")
    for frame in poses.frames:
        vertices = posed_vertices(clip.body, clip.identity, poses.pose(frame))
        pixels = project(cameras[frame], vertices).floor().long()
        inside = (pixels >= 0).all(1) & (pixels[:, 0] < cameras[frame].width)
        inside &= pixels[:, 1] < cameras[frame].height
        mask = read_mask(output / "masks", frame)
        on = mask[pixels[inside, 1].numpy(), pixels[inside, 0].numpy()] > 60
        assert inside.float().mean() > 0.99 and on.mean() > 0.93


def test_only_the_unseen_is_trusted(painted):
    output = painted.output
    frame = ID_OFFSET + 4
    mask, trust = read_mask(output / "masks", frame) > 127, read_mask(output / "trust", frame) > 127
    assert trust[mask].mean() > 0.7
    frontal = min(read_poses(output / "poses.parquet").frames)
    mask, other = read_mask(output / "masks", frontal) > 127, read_mask(output / "trust", frontal) > 127
    assert other[mask].mean() < trust[read_mask(output / "masks", frame) > 127].mean()


def test_guidance_can_be_handed_on(painted):
    folder = painted.output / "guidance"
    assert cv2.imread(str(folder / "reference.png")).shape == (256, 144, 3)
    assert len(list((folder / "poses").glob("*.png"))) == 8
    described = json.loads((folder / "guidance.json").read_text())
    assert described["azimuth_degrees"][4] == 180 and described["reference"]["padded"] is False
    assert (folder / "peers" / "smplx_optimized" / "smplx_params" / "7.json").is_file()


def test_the_same_bytes_again(full, painted, tmp_path):
    context = context_for(full, tmp_path / "again", generator="texture")
    stage.run(context)
    for path in sorted(painted.output.rglob("*")):
        if path.is_file():
            assert path.read_bytes() == (context.output / path.relative_to(painted.output)).read_bytes(), path


def test_off_costs_nothing(full, tmp_path):
    context = context_for(full, tmp_path / "off", generator="off")
    stage.run(context)  # though the plan calls for them
    assert "auxiliary.generator=auto" in context.logged[-1] and len(context.logged) == 1
    context = dataclasses.replace(context, inputs={})
    stage.run(context)
    assert not list(context.output.iterdir())


def test_named_takes_what_is_named_and_nothing_in_its_place(full, tmp_path):
    for named, generator in (({"weights": "w"}, "mimicmotion"), ({"folder": "f"}, "folder")):
        context = context_for(full, tmp_path / generator, generator="named", **named)
        assert stage.chosen_generator(context) == generator
    with pytest.raises(UserError, match="auxiliary.weights"):
        stage.run(context_for(full, tmp_path / "nothing", generator="named"))


def test_auto_goes_by_the_plan(full, tmp_path):
    context = context_for(full, tmp_path / "auto", generator="auto")
    assert stage.chosen_generator(context) == "texture"
    quick = context_for(full, tmp_path / "quick")  # leaves them out, and says what would make them
    assert stage.chosen_generator(quick) == "off" and "auxiliary.generator=auto" in quick.logged[-1]
    shutil.copytree(full / "plan", tmp_path / "plan")
    write_plan(tmp_path / "plan" / "plan.json", plan_of(auxiliary_views=False))
    context = dataclasses.replace(context, inputs={**context.inputs, "plan": tmp_path / "plan"})
    assert stage.chosen_generator(context) == "off"


def test_a_head_is_cropped_out_of_the_whole_body(head, tmp_path):
    context = context_for(head, tmp_path / "head", generator="texture", frames=4)
    stage.run(context)
    output, clip = context.output, read(head)
    shown = find_framing(clip).shown
    assert 0.1 < shown.mean() < 0.8
    cameras = read_cameras(output / "cameras.parquet")
    # Never larger than the head is in the clip: 96 pixels.
    assert all(max(camera.width, camera.height) <= 110 for camera in cameras.values())
    assert json.loads((output / "guidance" / "guidance.json").read_text())["reference"]["padded"] is True
    hips = rest_joints(clip.body, clip.identity)[0]
    poses = read_poses(output / "poses.parquet")
    for row, frame in enumerate(poses.frames):
        place = project(cameras[frame], (hips + poses.transl[row])[None])[0]
        assert place[1] > cameras[frame].height, "the hips are below the picture"
    # The body goes on where the clip never framed it: nothing is learnt there, not even that it is empty.
    vertices, _ = pose_body(clip.body, clip.identity, poses.rotation, poses.expression, poses.transl)
    beyond = 0
    for row, frame in enumerate(poses.frames):
        x, y = project(cameras[frame], vertices[row][shown == 0]).long().unbind(1)
        inside = (x >= 0) & (x < cameras[frame].width) & (y >= 0) & (y < cameras[frame].height)
        at = y[inside].numpy(), x[inside].numpy()
        cut = read_mask(output / "masks", frame)[at] == 0
        assert (read_mask(output / "trust", frame)[at][cut] < 128).mean() > 0.95
        beyond += int(cut.sum())
    assert beyond > 100


def test_the_frontal_frame_is_the_reference(full):
    scores = score_frames(read(full))
    assert all(0 <= value <= 1 for score in scores for value in (score.facing, score.sharpness, score.mask))
    assert [score.total for score in scores] == sorted((score.total for score in scores), reverse=True)


# Folders


def test_our_layout_and_pictures_alone(full, painted, tmp_path):
    clip = read(full)
    turn = make_turntable_motion(clip, small())
    for row in range(4):
        (tmp_path / "frames").mkdir(exist_ok=True)
        write_frame(tmp_path / "frames", row, np.full((256, 144, 3), 10 * row, np.uint8))
    offer = read_folder(tmp_path, clip, turn, BODY_FILE)
    assert [picture.frame for picture in offer.pictures] == [0, 2, 4, 6], "spread over the turn"
    for name in ("poses.parquet", "cameras.parquet"):
        shutil.copy(painted.output / "guidance" / name, tmp_path / name)
    offer = read_folder(tmp_path, clip, turn, BODY_FILE)
    pictures = list(offer.pictures)
    assert [picture.frame for picture in pictures] == [0, 1, 2, 3] and pictures[2].image[0, 0, 0] == 20


def test_a_video(full, tmp_path):
    clip = read(full)
    turn = make_turntable_motion(clip, small())
    write_video(tmp_path / "v.mp4", [np.full((128, 72, 3), 20 * k, np.uint8) for k in range(8)], 15)
    pictures = list(read_folder(tmp_path / "v.mp4", clip, turn, BODY_FILE).pictures)
    assert len(pictures) == 8 and pictures[3].image.shape == (256, 144, 3)
    assert pictures[3].image.mean() == pytest.approx(60, abs=6)


def test_the_peers_generated_folder(full, painted, tmp_path):
    """What their tools would hold of our own turn comes back as the same bodies before the same cameras."""
    clip = read(full)
    turn = make_turntable_motion(clip, small())
    peers = painted.output / "guidance" / "peers"
    theirs = tmp_path / "x_gen"
    for source in ("smplx_optimized/smplx_params", "cam_params"):
        (theirs / source).mkdir(parents=True)
        for file in (peers / source).glob("*.json"):
            shutil.copy(file, theirs / source / f"{int(file.stem) + ID_OFFSET}.json")
    (theirs / "frames").mkdir()
    for row in range(8):
        write_frame(theirs / "frames", row + ID_OFFSET, np.zeros((256, 144, 3), np.uint8))
    (theirs / "frame_list_train.txt").write_text("100001\n100005\n")
    offer = read_folder(theirs, clip, turn, BODY_FILE)
    assert [picture.frame for picture in offer.pictures] == [1, 5] == list(offer.poses.frames)
    person = clip.body, clip.identity
    for frame in offer.poses.frames:
        there = project(offer.cameras[frame], posed_vertices(*person, offer.poses.pose(frame)))
        here = project(turn.camera, posed_vertices(*person, turn.poses.pose(frame)))
        assert torch.allclose(there, here, atol=0.05)


def test_what_cannot_be_read_is_named(full, tmp_path):
    clip = read(full)
    turn = make_turntable_motion(clip, small())
    with pytest.raises(UserError, match="does not exist"):
        read_folder(tmp_path / "nothing", clip, turn, BODY_FILE)
    with pytest.raises(UserError, match="no numbered pictures"):
        read_folder(tmp_path, clip, turn, BODY_FILE)
    (tmp_path / "v.mp4").write_bytes(b"no video")
    with pytest.raises(UserError, match="cannot be read as a video"):
        read_folder(tmp_path / "v.mp4", clip, turn, BODY_FILE)
