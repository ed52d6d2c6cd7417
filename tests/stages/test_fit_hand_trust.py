"""Which hands the fit believes, of those at the picture's edge as well."""

import math

import numpy as np
import pytest

from stages.fit.hand_trust import trusted_hands
from stages.fit.observations import observe
from stages.fit.registration import views_of
from stages.ingest.mannequin.footage import make_mannequin
from stages.ingest.mannequin.spec import MannequinSpec
from tests.made.detections import make_clip


def hand_track(count=9):
    """Two open hands, 100 pixels apart, of 20 pixels' palm; wrists where the pose says."""
    rng = np.random.default_rng(0)
    hand = np.zeros((21, 3), np.float32)
    for finger, angle in enumerate((-0.8, -0.3, 0.0, 0.3, 0.6)):
        for knuckle, reach in enumerate((20, 28, 34, 39)):
            hand[1 + 4 * finger + knuckle, :2] = reach * math.sin(angle), -reach * math.cos(angle)
    hands = np.ones((count, 2, 21, 4), np.float32)
    hands[..., :3] = hand + rng.normal(0, 0.1, (count, 2, 21, 3))
    hands[:, 0, :, :2] += (200, 100)
    hands[:, 1, :, :2] += (100, 100)
    pose, world = np.ones((count, 33, 4), np.float32), np.ones((count, 33, 4), np.float32)
    pose[:, 15, :2], pose[:, 16, :2] = (200, 100), (100, 100)
    return hands, pose, world


def test_good_hands_are_trusted():
    assert trusted_hands(*hand_track(), 0.4).all()


def test_bad_hands_are_not():
    hands, pose, world = hand_track()
    wrist = hands[1, 0, :1, :3].copy()
    hands[1, 0, 1:, :3] = wrist + 0.2 * (hands[1, 0, 1:, :3] - wrist)  # collapsed
    knuckles = hands[2, 0, [5, 9, 13, 17], :3].repeat(4, axis=0)
    hands[2, 0, 5:, :3] = knuckles + 0.3 * (hands[2, 0, 5:, :3] - knuckles)  # stumps for fingers
    hands[3, 0, :, 0] += 60  # away from the wrist
    pose[4, 15, 3], hands[4, 0, :, 1] = 0.1, hands[4, 0, :, 1] - 200  # leaps, the wrist unseen
    hands[8, 1, :, :2] = hands[8, 0, :, :2]  # both on the left hand
    pose[8, 16, :2] = pose[8, 15, :2]
    world[8, 15, 2], world[8, 16, 2] = 0.3, 0.1  # ... which is the farther
    hands[6, 1, :, 3] = 0  # not found
    hands[7, 1, 3, 0] = np.nan
    trusted = trusted_hands(hands, pose, world, 0.4)
    assert trusted[:, 0].tolist() == [True, False, False, False, False, True, True, True, False]
    assert trusted[:, 1].tolist() == [True, True, True, True, True, True, False, False, True]


def cut(hands, frame, side, left_of):
    """What the ingest stage writes of a hand of which only what lies left of a column is in the picture."""
    hands[frame, side][hands[frame, side, :, 0] >= left_of] = 0


def test_a_hand_at_the_pictures_edge_is_judged_by_what_is_in_the_picture():
    hands, pose, world = hand_track()
    for frame, column in ((1, 210), (2, 200), (3, 195)):
        cut(hands, frame, 0, column)
    assert ((hands[1:4, 0, :, 3] > 0).sum(1) < [21, 16, 11]).all()
    cut(hands, 4, 0, 184)  # of which nothing is left
    cut(hands, 5, 0, 205)
    knuckles = hands[5, 0, [5, 9, 13, 17], :3].repeat(4, axis=0)
    hands[5, 0, 5:, :3] = np.where(
        hands[5, 0, 5:, 3:] > 0, knuckles + 0.3 * (hands[5, 0, 5:, :3] - knuckles), 0
    )
    cut(hands, 6, 0, 205)
    hands[6, 0, hands[6, 0, :, 3] > 0, 1] += 80  # away from the arm's wrist, all of it
    trusted = trusted_hands(hands, pose, world, 0.4)
    assert trusted[:, 0].tolist() == [True, True, True, True, False, False, False, True, True]
    assert trusted[:, 1].all()


def test_hands_that_are_never_whole_are_trusted():
    hands, pose, world = hand_track()
    for frame in range(len(hands)):
        cut(hands, frame, 0, 200)
    assert trusted_hands(hands, pose, world, 0.4).all()
    hands[:, 0, 0] = 0  # nor is their wrist ever in the picture
    assert trusted_hands(hands, pose, world, 0.4).all()


def test_a_clip_without_hands():
    hands, pose, world = hand_track()
    assert not trusted_hands(0 * hands, pose, world, 0.4).any()


def test_a_hand_without_its_wrist_leaves_the_arms(model):
    clip = make_clip(*model, count=4)
    draw = np.random.default_rng(0)
    hands = clip.keypoints.hands
    hands[:, 0, :, :2] = clip.keypoints.pose_image[:, None, 15, :2] + draw.uniform(-9, 9, (21, 2))
    hands[:, 0, :, 3] = 1
    sizes = views_of(clip.keypoints, clip.cameras).size.numpy()
    whole = observe(clip.keypoints, model[1], 0.4, sizes)
    assert not whole.mask[:, [15, 17, 19, 21]].any() and whole.mask[:, 33:54].all()
    hands[:, 0, 0] = 0
    cropped = observe(clip.keypoints, model[1], 0.4, sizes)
    assert cropped.mask[:, 15].all() and not cropped.mask[:, [17, 19, 21, 33]].any()


@pytest.mark.slow
def test_hands_of_a_cropped_mannequin_are_told_from_failures(model):
    """Against the truth: most good hands are kept, though half of them are cut off, and no others."""
    right, kept = [], []
    for identity, seed in ((1, 11), (4, 407), (5, 507)):
        spec = MannequinSpec(
            framing="upper", identity=identity, seed=seed, frames=30, size=128, hand_failures=0.1
        )
        made = make_mannequin(spec, *model)
        found, truth = made.keypoints, made.truth
        true = truth.keypoints[:, 91:].reshape(30, 2, 21, 2)
        pixels_of_metre = float(made.cameras[0].intrinsics[0, 0]) / -truth.joints[:, [20, 21], 2]
        there = found.hands[..., 3] > 0
        error = np.linalg.norm(found.hands[..., :2] - true, axis=-1) * there
        error = error.sum(2) / np.maximum(there.sum(2), 1) / pixels_of_metre
        trusted = trusted_hands(found.hands, found.pose_image, found.pose_world, 0.4)
        asked = there.any(2)
        right.append((error < 0.02)[asked])
        kept.append(trusted[asked])
    right, kept = np.concatenate(right), np.concatenate(kept)
    assert right.sum() > 40 and (~right).sum() > 5
    assert (right & kept).sum() > 0.75 * right.sum()
    assert (right & kept).sum() > 0.95 * kept.sum()
