"""The parts of ingest that need no estimator: people, scores, masks, background, split, settings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.clip.background import learn_background, subtract_background
from pipeline.clip.keypoints import BODY, FACE, FACE_MESH_TO_IBUG68, FEET, LEFT_HAND, NAMES, RIGHT_HAND
from pipeline.detection.mediapipe import estimator_scale
from pipeline.detection.wholebody import PixelLandmarks, detour, score_faces, score_hands, to_keypoints
from pipeline.errors import UserError
from stages.ingest import people
from stages.ingest.mask_edges import follow_edges
from stages.ingest.mask_smoothing import smooth_masks
from stages.ingest.masks import (
    fill_holes,
    fuse,
    main_component,
    overlap,
    read_segmentations,
    selfie_share,
    write_segmentations,
)
from stages.ingest.person_detector import Person
from stages.ingest.split import split_frames
from tests.made.videos import walking_blob

# People.


def person(x: float, size: float, y: float = 50.0) -> Person:
    return Person(np.array([x, y + size]), np.array([x, y]), 1.8 * size, 0.9)


def test_the_larger_person_is_kept_and_the_other_counted() -> None:
    looks = [(frame, [person(60 + frame, 20), person(150 - frame, 40)]) for frame in range(0, 30, 5)]
    found = people.track_people(looks, 200, 100)
    assert found.count == 2 and found.subject is not None
    assert {one.radius for one in found.subject.people.values()} == {1.8 * 40}
    assert len(found.others) == 1


def test_of_equal_people_the_central_one_is_kept() -> None:
    looks = [(frame, [person(10, 30), person(105, 30)]) for frame in range(5)]
    found = people.track_people(looks, 200, 100)
    assert found.subject is not None and found.subject.at(0).hips[0] == 105


def test_a_false_alarm_does_not_count() -> None:
    looks = [(frame, [person(100, 30), *([person(20, 10)] if frame == 4 else [])]) for frame in range(20)]
    assert people.track_people(looks, 200, 100).count == 1


def test_a_person_lost_and_found_elsewhere_is_not_another() -> None:
    looks = [(frame, [person(30 if frame < 10 else 160, 30)]) for frame in range(20)]
    found = people.track_people(looks, 200, 100)
    assert found.count == 1 and found.others == ()
    assert people.subject_region(5, found, 200, 100) is None


def test_nobody() -> None:
    assert people.track_people([(0, []), (1, [])], 200, 100) == people.ClipPeople(None, (), 0)


def test_tracks_follow_people_who_pass_each_other_slowly() -> None:
    looks = [(frame, [person(40 + 4 * frame, 30), person(160 - 4 * frame, 12, y=20)]) for frame in range(30)]
    sizes = [{one.radius for one in track.people.values()} for track in people.link_detections(looks)]
    assert sorted(sizes, key=min) == [{1.8 * 12}, {1.8 * 30}]


def test_the_picture_is_shared_out_and_the_rest_painted_over() -> None:
    looks = [(frame, [person(60, 30), person(160, 20)]) for frame in range(5)]
    found = people.track_people(looks, 200, 100)
    own = people.subject_region(2, found, 200, 100)
    assert own is not None and own.shape == (100, 200)
    assert own[60, 60] and not own[60, 160]
    image = np.zeros((100, 200, 3), np.uint8)
    image[:, 150:] = 200
    shown = people.hide_others(image, own)
    assert (shown[60, 160] == 50).all() and (shown[60, 60] == 0).all()
    assert people.hide_others(image, None) is image


# Scores.


def hand_at(x: float, y: float, palm: float) -> np.ndarray:
    """A hand of 21 points whose wrist lies at (x, y), [21, 4]."""
    rng = np.random.default_rng(5)
    points = np.zeros((21, 4), np.float32)
    points[:, :2] = rng.uniform(-0.5, 0.5, (21, 2)) * palm + [x, y - palm]
    points[0, :2] = x, y
    for knuckle, side in ((5, -0.3), (9, 0.0), (13, 0.2), (17, 0.4)):
        points[knuckle, :2] = x + side * palm, y - palm
    points[:, 3] = 1
    return points


def hands_and_wrists(count: int = 11) -> tuple[np.ndarray, np.ndarray]:
    hands = np.stack([hand_at(100 + 2 * frame, 90, 20) for frame in range(count)])
    wrists = np.zeros((count, 4), np.float32)
    wrists[:, 0], wrists[:, 1], wrists[:, 3] = 100 + 2 * np.arange(count), 95, 1
    return hands, wrists


def test_a_steady_hand_at_the_wrist_is_trusted() -> None:
    assert (score_hands(*hands_and_wrists(), magnification=1.0) > 0.9).all()


@pytest.mark.parametrize(
    ("x", "palm"), [(110, 4), (110, 60), (200, 20)], ids=["collapsed", "merged with the other", "jumped away"]
)
def test_a_failed_hand_is_not_trusted(x: float, palm: float) -> None:
    hands, wrists = hands_and_wrists()
    hands[5] = hand_at(x, 90, palm)
    scores = score_hands(hands, wrists, magnification=1.0)
    assert scores[5] < 0.1
    assert (np.delete(scores, 5) > 0.8).all()


def test_a_hand_that_is_not_there_scores_nothing() -> None:
    hands, wrists = hands_and_wrists()
    hands[3] = 0
    assert score_hands(hands, wrists, 1.0)[3] == 0
    assert (score_hands(np.zeros_like(hands), wrists, 1.0) == 0).all()


def test_tiny_hands_are_not_trusted_unless_enlarged() -> None:
    hands, wrists = hands_and_wrists()
    hands[..., :2] /= 6
    wrists[..., :2] /= 6
    assert (score_hands(hands, wrists, 1.0) < 0.1).all()
    assert (score_hands(hands, wrists, 6.0) > 0.9).all()


def landmarks_at(shift: float = 0.0) -> PixelLandmarks:
    pose = np.zeros((33, 4), np.float32)
    pose[:, 0], pose[:, 1], pose[:, 3] = 40 + np.arange(33), 60, 0.8
    face = np.ones((478, 4), np.float32)
    rng = np.random.default_rng(2)
    face[:, :2] = rng.uniform(30, 60, (478, 2))
    face[10, :2], face[152, :2] = (45, 30), (45, 70)
    face[4, :2] = pose[0, :2] = 45, 50
    pose[:, 0] += shift
    face[:, 0] += shift
    hands = np.zeros((2, 21, 4), np.float32)
    hands[0] = hand_at(pose[15, 0], pose[15, 1], 20)
    return PixelLandmarks(pose, np.zeros((33, 4), np.float32), face, hands)


def test_landmarks_become_the_133_points() -> None:
    marks = landmarks_at()
    points = to_keypoints(np.arange(3), [marks] * 3, 200, 150, 1.0)
    whole = points.whole_body[1]
    pose_of = {"left_shoulder": 11, "right_wrist": 16, "left_hip": 23, "right_ankle": 28, "left_heel": 29,
               "right_big_toe": 32}  # fmt: skip
    for name, index in pose_of.items():
        np.testing.assert_allclose(whole[NAMES.index(name)], marks.pose[index, [0, 1, 3]], err_msg=name)
    assert whole[NAMES.index("left_small_toe"), 2] < whole[NAMES.index("left_big_toe"), 2]
    np.testing.assert_array_equal(whole[FACE][:, :2], marks.face[list(FACE_MESH_TO_IBUG68), :2])
    np.testing.assert_array_equal(whole[LEFT_HAND][:, :2], marks.hands[0, :, :2])
    assert (whole[RIGHT_HAND] == 0).all() and (points.hands[1, 1] == 0).all()
    np.testing.assert_array_equal(whole[0, :2], marks.face[4, :2])  # the nose from the mesh


def test_points_outside_the_picture_score_nothing() -> None:
    marks = landmarks_at(shift=-52.5)
    whole = to_keypoints(np.arange(1), [marks], 200, 150, 1.0).whole_body[0]
    outside = marks.pose[[11, 12, 23], 0] < 0
    assert outside.any() and not outside.all()
    np.testing.assert_array_equal(whole[[5, 6, 11], 2] == 0, outside)
    beyond = marks.face[list(FACE_MESH_TO_IBUG68), 0] < 0
    np.testing.assert_array_equal(whole[FACE][:, 2] == 0, beyond)


def test_no_face_leaves_the_pose_points() -> None:
    marks = landmarks_at()
    marks.face[:] = 0
    whole = to_keypoints(np.arange(1), [marks], 200, 150, 1.0).whole_body[0]
    np.testing.assert_allclose(whole[0], marks.pose[0, [0, 1, 3]])
    assert (whole[FACE] == 0).all()
    assert (whole[BODY, 2] > 0).all() and (whole[FEET, 2] > 0).all()


def test_a_face_far_from_the_nose_is_not_trusted() -> None:
    marks = [landmarks_at() for _ in range(5)]
    pose, face = (np.stack([getattr(one, name) for one in marks]) for name in ("pose", "face"))
    assert (score_faces(face, pose, 1.0) > 0.9).all()
    face[2, :, 0] += 60
    assert score_faces(face, pose, 1.0)[2] < 0.1


def test_detour_measures_jumps_not_motion() -> None:
    points = np.stack([4.0 * np.arange(9), np.zeros(9)], axis=1)
    points[4, 1] = 30
    distances = detour(points, np.ones(9, bool))
    assert distances[4] == pytest.approx(30, abs=1)
    assert np.delete(distances, 4).max() <= 8


# Masks.


def test_raw_masks_round_trip(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    body, selfie = rng.uniform(0, 1, (2, 20, 30)).astype(np.float32)
    write_segmentations(tmp_path, 3, body, selfie)
    for written, read in zip((body, selfie), read_segmentations(tmp_path, 3), strict=True):
        assert np.abs(written - read).max() <= 0.5 / 255 + 1e-6


def test_the_selfie_mask_counts_as_far_as_it_agrees() -> None:
    assert selfie_share([0.97, 0.96, 0.2]) == 0.5
    assert selfie_share([0.7, 0.75, 0.6]) == 0
    assert 0 < selfie_share([0.84]) < 0.5


def test_fusing_keeps_what_both_say_and_weighs_the_rest() -> None:
    body, selfie = np.array([[1.0, 0.0, 0.99, 0.4]]), np.array([[1.0, 0.0, 0.4, 0.01]])
    fused = fuse(body, selfie, 0.5)[0]
    assert fused[0] > 0.98 and fused[1] < 0.02 and fused[2] > 0.8 and fused[3] < 0.2
    np.testing.assert_allclose(fuse(body, selfie, 0.0), np.clip(body, 0.01, 0.99), atol=1e-6)


def test_overlap() -> None:
    first, second = np.zeros((10, 10)), np.zeros((10, 10))
    first[:, :6], second[:, 4:] = 1, 1
    assert overlap(first, second) == pytest.approx(0.2)
    assert overlap(np.zeros((3, 3)), np.zeros((3, 3))) == 0


def test_the_component_under_the_points_is_kept() -> None:
    alpha = np.zeros((60, 100), np.float32)
    alpha[10:30, 10:30] = 1  # the person
    alpha[5:55, 60:95] = 1  # larger: a wardrobe
    kept = main_component(alpha, np.array([[20.0, 20.0], [22.0, 25.0], [500.0, -3.0]]))
    assert kept[20, 20] > 0.999 and kept[:, 60:].max() == 0
    assert main_component(alpha, np.zeros((0, 2)))[20, 20] == 0


def test_small_holes_are_filled_and_gaps_are_not() -> None:
    alpha = np.zeros((100, 100), np.float32)
    alpha[10:90, 10:90] = 0.98
    alpha[40:43, 40:43] = 0.1  # a mistake
    alpha[60:75, 20:40] = 0.1  # under an arm
    alpha[10:12, 50:52] = 0.1  # a notch in the outline
    filled = fill_holes(alpha)
    assert filled[40:43, 40:43].min() > 0.9
    assert filled[60:75, 20:40].max() < 0.2 and filled[10:12, 50:52].max() < 0.2
    assert (filled[:10] == 0).all()


def test_a_mask_without_a_sure_pixel_stays() -> None:
    faint = np.full((8, 8), 0.3, np.float32)
    np.testing.assert_array_equal(main_component(faint, np.zeros((0, 2))), faint)


def test_the_edge_moves_to_the_pictures_edge() -> None:
    image = np.full((300, 300, 3), 40, np.uint8)
    image[:, 150:] = 200
    blurred = np.repeat(np.clip((np.arange(300) - 147) / 6, 0, 1)[None], 300, 0).astype(np.float32)
    truth = (image[..., 0] > 100).astype(np.float32)
    before, after = (np.abs(mask - truth).mean() for mask in (blurred, follow_edges(blurred, image, 1.0)))
    assert after < 0.7 * before
    np.testing.assert_array_equal(follow_edges(blurred, image, 0.0), blurred)


def test_the_edge_stays_where_the_colours_tell_nothing() -> None:
    image = np.full((60, 60, 3), 128, np.uint8)
    blurred = np.repeat(np.clip((np.arange(60) - 25) / 10, 0, 1)[None], 60, 0).astype(np.float32)
    assert np.abs(follow_edges(blurred, image, 1.0) - blurred).max() < 0.1


def test_a_still_background_is_taken_out_and_the_person_is_not() -> None:
    frames, masks = walking_blob(16)
    truth = [mask.astype(np.float32) / 255 for mask in masks]
    background = learn_background(zip(frames, truth, strict=True))
    assert background is not None
    sloppy = truth[8].copy()
    sloppy[20:40, 5:20] = 0.7  # a piece of wall that the segmentation took in
    assert truth[8][20:40, 5:20].max() == 0
    cleaned = subtract_background(sloppy, frames[8], background)
    assert cleaned[22:38, 7:18].max() < 0.3
    assert cleaned[truth[8] > 0].min() > 0.9


def test_a_moving_background_is_left_alone() -> None:
    rng = np.random.default_rng(0)
    frames = [rng.integers(0, 256, (40, 50, 3), dtype=np.uint8) for _ in range(12)]
    nowhere = [np.zeros((40, 50), np.float32)] * 12
    background = learn_background(zip(frames, nowhere, strict=True))
    assert background is not None and background.confidence.max() == 0
    mask = rng.uniform(0.1, 0.9, (40, 50)).astype(np.float32)
    np.testing.assert_allclose(subtract_background(mask, frames[0], background), mask, atol=1e-5)


def test_no_frames_no_background() -> None:
    assert learn_background([]) is None


@pytest.mark.parametrize(("count", "reach"), [(1, 2), (3, 2), (9, 2), (9, 0)])
def test_one_mask_a_frame_comes_out(count: int, reach: int) -> None:
    frames, masks = walking_blob(count)
    pairs = [(frame, mask / np.float32(255)) for frame, mask in zip(frames, masks, strict=True)]
    out = list(smooth_masks(iter(pairs), reach))
    assert len(out) == count
    for (_, mask), steadied in zip(pairs, out, strict=True):
        assert overlap(mask, steadied) > 0.9
    if reach == 0:
        np.testing.assert_array_equal(out[4], pairs[4][1])


def test_flicker_is_averaged_away() -> None:
    frames, masks = walking_blob(9)
    still = [frames[0]] * 9
    rng = np.random.default_rng(0)
    flickering = [np.clip(masks[0] / 255 + rng.normal(0, 0.2, masks[0].shape), 0, 1) for _ in still]
    pairs = [(image, mask.astype(np.float32)) for image, mask in zip(still, flickering, strict=True)]

    def flicker(sequence: list[np.ndarray]) -> float:
        return float(np.abs(np.diff(np.stack(sequence), axis=0)).mean())

    assert flicker(list(smooth_masks(iter(pairs), 2))) < 0.5 * flicker([mask for _, mask in pairs])


# Split, sizes, settings.


def test_the_clips_end_is_held_out() -> None:
    split = split_frames(list(range(0, 100, 2)), fraction=0.1, last=0)
    assert split.test == (90, 92, 94, 96, 98) and split.train == tuple(range(0, 90, 2))
    assert split_frames(list(range(50)), 0.1, last=7).test == tuple(range(43, 50))
    assert len(split_frames([1, 2], 0.1, 0).test) == 1
    assert split_frames([1, 2, 3], 0.0, 0).test == ()


def test_nothing_left_to_learn_from() -> None:
    with pytest.raises(UserError, match=r"5 frames are to be held out of 5 .*lower ingest\.test_frames"):
        split_frames(range(5), 0.1, 5)


@pytest.mark.parametrize(
    ("size", "scale"),
    [((640, 360), 1.0), ((193, 144), 3.0), ((320, 240), 2.0), ((3840, 2160), 0.5), ((1080, 1920), 1.0)],
)
def test_the_estimator_sees_a_reasonable_size(size: tuple[int, int], scale: float) -> None:
    assert estimator_scale(*size, short_side=400, long_side=1920) == pytest.approx(scale)
