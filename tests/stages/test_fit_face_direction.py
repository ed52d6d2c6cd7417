"""Faces that are turned away, hands that were found twice, and the ablation that trusts everything."""

import dataclasses

import numpy as np
import pytest
import roma
import torch

from pipeline.body import locate, mean_identity, pose_body
from pipeline.clip.camera import facing_camera, project
from pipeline.clip.keypoints import FACE, LEFT_HAND, empty_keypoints
from stages.fit.camera_batch import stack
from stages.fit.face_direction import TURNED, mesh_facing, points_facing, pose_facing
from stages.fit.hand_trust import trusted_flat_hands
from stages.fit.observations import detected, observe
from tests.made.detections import make_clip, whole_body

ANGLES = (0.0, 0.5, -0.8, 1.4, 2.4, 3.14)  # radians to either side


@pytest.fixture(scope="module")
def turned(model):
    """The mean body turned about the vertical, its points seen as if it were of glass."""
    count = len(ANGLES)
    rotation = torch.zeros(count, 55, 3)
    rotation[:, 0, 1] = torch.tensor(ANGLES)
    transl = torch.tensor([0.0, -0.3, -2.0]).expand(count, 3)
    vertices, joints = pose_body(model[0], mean_identity(model[0]), rotation, torch.zeros(count, 1), transl)
    camera = facing_camera(256, 256, 300.0)

    def seen(points):
        places = locate(points, joints, vertices)
        return torch.cat([project(camera, places), -300 / 2 * places[..., 2:]], -1).numpy()

    whole = seen(model[1].whole_body)
    whole[..., 2] = 1.0
    return rotation, stack([camera] * count), seen(model[1].face_mesh), whole


def test_the_cosine_is_found_from_mesh_points_and_pose(model, turned):
    rotation, views, mesh, whole = turned
    cosine = np.cos(ANGLES)
    assert pose_facing(rotation, model[0].parents, views) == pytest.approx(cosine, abs=1e-5)
    assert mesh_facing(mesh) == pytest.approx(cosine, abs=0.15)
    flat = points_facing(whole[:, FACE], whole[:, 3:5], 0.4)
    assert flat == pytest.approx(cosine, abs=0.25)
    assert ((flat >= TURNED) == (cosine >= TURNED)).all()


def test_a_rolled_head_still_faces_the_camera(turned):
    whole = turned[3]
    roll = roma.rotvec_to_rotmat(torch.tensor([0.0, 0.0, 1.9])).numpy()[:2, :2]
    rolled = whole.copy()
    rolled[..., :2] = whole[..., :2] @ roll.T
    before, after = (points_facing(w[:, FACE], w[:, 3:5], 0.4) for w in (whole, rolled))
    assert after == pytest.approx(before, abs=1e-4)


def test_a_face_imagined_on_the_back_of_a_head_is_told_by_its_ears(turned):
    whole = turned[3].copy()
    front, back = 0, len(ANGLES) - 1
    whole[back, FACE] = whole[front, FACE]
    assert points_facing(whole[:, FACE], whole[:, 3:5], 0.4)[back] < 0
    whole[back, 3:5, 2] = 0.1  # ears that are not seen say nothing
    assert points_facing(whole[:, FACE], whole[:, 3:5], 0.4)[back] > TURNED


def test_what_was_not_found_faces_nowhere():
    assert (mesh_facing(np.zeros((2, 478, 4))) == 0).all()
    assert (points_facing(np.full((2, 68, 3), np.nan), np.zeros((2, 2, 3)), 0.4) == 0).all()


def test_points_of_a_turned_face_are_masked(model, turned):
    _, views, mesh, whole = turned
    keypoints = empty_keypoints(np.arange(len(ANGLES)))
    keypoints.whole_body[:] = whole
    sizes = views.size.numpy()
    expected = [True, True, True, False, False, False]
    observed = observe(keypoints, model[1], 0.4, sizes)
    assert observed.mask[:, observed.of("face")].any(1).tolist() == expected
    assert observed.mask[:, :5].any(1).tolist() == [not seen for seen in expected]
    pose = np.array([-0.9, 1, 1, 1, 1, 1])  # the initial pose knows better in the first frame
    observed = observe(keypoints, model[1], 0.4, sizes, facing=pose)
    assert observed.mask[:, observed.of("face")].any(1).tolist() == [False, True, True, False, False, False]
    keypoints.pose_image[..., :2], keypoints.pose_image[..., 3] = 100.0, 1.0
    keypoints.face_mesh[..., :3], keypoints.face_mesh[..., 3] = mesh, 1.0
    observed = observe(keypoints, model[1], 0.4, sizes)
    assert observed.mask[:, observed.of("face")].any(1).tolist() == expected
    observed = observe(keypoints, model[1], 0.4, sizes, masked=False)
    assert observed.mask[:, observed.of("face")].all()


# Hands without depth


def two_hands():
    """Two hands apart, then three times at one place; with the arms' wrists. [4, 2, 21, 3], [4, 2, 3]."""
    draw = np.random.default_rng(0)
    hand = np.concatenate([draw.uniform(0, 20, (21, 2)), np.full((21, 1), 0.9)], axis=1)
    hand[0, :2], hand[9, :2] = (10, 0), (10, 10)
    hands = np.tile(hand, (4, 2, 1, 1))
    hands[:, 1, :, 0] += np.array([100, 1, 1, 1])[:, None]
    return hands, hands[:, :, 0].copy()


def test_hands_apart_are_both_kept():
    hands, wrists = two_hands()
    trusted = trusted_flat_hands(hands, np.ones((4, 2, 21), bool), wrists, np.ones((4, 2), bool))
    assert trusted[0].all()


def test_of_two_hands_at_one_place_the_worse_goes():
    hands, wrists = two_hands()
    seen, known = np.ones((4, 2, 21), bool), np.zeros((4, 2), bool)
    known[1] = True
    wrists[1, 0, 0] += 60.0  # the left arm ends elsewhere
    middle = hands[2, 1, :, :2].mean(0)
    hands[2, 1, :, :2] = middle + 0.75 * (hands[2, 1, :, :2] - middle)  # the right hand is farther
    hands[3, 0, :, 2] = 0.6
    hands[3, 1, :, 2] = 0.7
    trusted = trusted_flat_hands(hands, seen, wrists, known)
    assert trusted.tolist() == [[True, True], [False, True], [True, False], [False, True]]
    seen[1, 1, :15] = False  # of two hands of which one is not seen, the other stays
    assert trusted_flat_hands(hands, seen, wrists, known)[1].tolist() == [True, False]


# Without the mask


def test_without_the_mask_everything_that_was_found_counts(model):
    clip = make_clip(*model, count=2)
    pose, hands = clip.keypoints.pose_image.copy(), clip.keypoints.hands.copy()
    pose[:, 13, 3] = 0.1  # an elbow under tau
    pose[:, 14, :2] = -40.0  # one outside the picture
    pose[:, 15] = np.nan
    pose[:, [25, 26], 3] = 0.0  # knees unseen: the hips would be guesses
    hands[0, 0, :, :2] = 50.0  # no score, yet a place
    keypoints = dataclasses.replace(clip.keypoints, pose_image=pose, hands=hands)
    sizes = np.full((2, 2), 256.0)
    masked = observe(keypoints, model[1], 0.4, sizes)
    trusting = observe(keypoints, model[1], 0.4, sizes, masked=False)
    assert not masked.mask[:, [13, 14, 15, 23, 24, 25]].any()
    assert trusting.mask[:, [13, 14, 23, 24, 25]].all() and not trusting.mask[:, 15].any()
    left = trusting.mask[:, trusting.of("left_hand")]
    assert left[0].all() and not left[1].any()
    assert not trusting.mask[:, trusting.of("face")].any()
    assert torch.isfinite(trusting.pixels).all()


def test_without_the_mask_the_133_points_count_too(model):
    clip = whole_body(make_clip(*model, count=2), *model)
    points = clip.keypoints.whole_body.copy()
    points[0, LEFT_HAND, 2] = 0.05
    points[1, FACE] = 0.0
    keypoints = dataclasses.replace(clip.keypoints, whole_body=points)
    sizes = np.full((2, 2), 256.0)
    assert not observe(keypoints, model[1], 0.4, sizes).mask[0, LEFT_HAND].any()
    trusting = observe(keypoints, model[1], 0.4, sizes, masked=False)
    assert trusting.mask[0].all() and not trusting.mask[1, FACE].any()


def test_detected():
    points = np.array([[0, 0, 0], [0, 0, 0.1], [3, 0, 0], [np.nan, 1, 1]], float)
    assert detected(points).tolist() == [False, True, True, False]
