"""One person of several is found, followed, and chosen; cuts are found."""

import dataclasses

import cv2
import numpy as np
import pytest

from pipeline.clip.boxes import Box
from pipeline.detection.mediapipe import Estimate
from pipeline.errors import UserError
from stages.ingest.cameras.calibration import CalibratedCamera, pinhole_lens
from stages.ingest.cuts import FilmShot, choose_shot, film_shots, find_cuts
from stages.ingest.people import Track, color_overlap, link_detections, track_people
from stages.ingest.person_detector import (
    Person,
    change_since,
    distinct,
    inner_edges,
    is_cut,
    squares,
    torso_colors,
)
from stages.ingest.same_person import KnownPerson, rays_meet

RED, GREEN = np.array([0.9, 0.1, 0.0]), np.array([0.0, 0.1, 0.9])


def person(x, size=30.0, y=50.0, colors=None, change=None, score=0.9):
    return Person(np.array([x, y + size]), np.array([x, y]), 1.8 * size, score, colors, change)


# Cuts.


def scene(seed, shift=0):
    """A picture of its own texture, moved to the side; [24, 32] grey."""
    texture = np.random.default_rng(seed).integers(0, 255, (96, 768)).astype(np.float32)
    large = cv2.GaussianBlur(texture, (0, 0), 12)[:, shift : shift + 128]
    large = (large - large.min()) / (large.max() - large.min())
    return 255 * cv2.resize(large, (32, 24), interpolation=cv2.INTER_AREA)


def test_a_cut_is_found_and_a_flash_and_a_pan_are_none():
    film = [scene(1, shift // 2) for shift in range(20)] + [scene(2, shift // 2) for shift in range(30)]
    assert find_cuts(film) == [20]
    flash = list(film[:20])
    flash[9] = scene(3)
    assert find_cuts(flash) == []
    darker = [image * (0.4 if place > 10 else 1.0) for place, image in enumerate(film[:20])]
    assert find_cuts(darker) == []
    assert find_cuts([scene(1, 20 * shift) for shift in range(20)]) == []
    assert find_cuts(film[:1]) == [] and find_cuts([]) == []


def test_the_longest_shot_with_a_person_is_taken_unless_a_setting_names_another():
    frames = list(range(0, 120, 2))
    shots = film_shots(frames, [10, 50])
    assert [(shot.first, shot.last, shot.count) for shot in shots] == [
        (0, 18, 10),
        (20, 98, 40),
        (100, 118, 10),
    ]
    assert 18 in shots[0] and 20 not in shots[0]
    assert choose_shot(shots, [(0, 1), (20, 1)], 0, "film.mp4") == shots[1]
    assert choose_shot(shots, [(0, 1), (20, 0), (110, 2)], 0, "film.mp4") == shots[0]  # nobody in the longest
    assert choose_shot(shots, [(20, 1)], 3, "film.mp4") == shots[2]
    with pytest.raises(UserError, match=r"film\.mp4 has 3 shots: ingest\.shot=4"):
        choose_shot(shots, [], 4, "film.mp4")
    assert film_shots([5], []) == [FilmShot(5, 5, 1)]


# Who is who.


def test_two_who_cross_keep_their_names():
    looks = [
        (frame, [person(20 + 8 * frame, colors=RED), person(180 - 8 * frame, 28, colors=GREEN)])
        for frame in range(20)
        if frame not in (9, 10, 11)  # one hides the other
    ]
    found = track_people(looks, 200, 100)
    for track in found.everyone:
        known = [one.colors[0] for one in track.people.values()]
        assert len(set(known)) == 1, "one person has one colour of clothes"
    assert found.count == 2 and not found.absent(10)


def test_somebody_else_is_not_the_subject_lost_and_found_again():
    looks = [
        (frame, [person(50, colors=RED) if frame < 20 else person(150, colors=GREEN)]) for frame in range(35)
    ]
    found = track_people(looks, 200, 100)
    assert [len(track.people) for track in found.everyone] == [20, 15]
    assert found.count == 1 and not found.absent(10) and found.absent(30)
    alone = track_people(looks[:20], 200, 100)
    assert not alone.absent(30)  # the detector overlooks a single person now and then


def test_whoever_looks_the_same_is_one_person_who_went_away_and_came_back():
    looks = [
        (frame, [person(30 if frame < 10 else 160, colors=RED)]) for frame in (*range(10), *range(20, 30))
    ]
    assert len(track_people(looks, 200, 100).everyone) == 1


def test_a_picture_on_a_wall_is_not_the_subject():
    looks = [
        (frame, [person(100, 60, change=0.1), person(20 + frame, 25, change=8.0)]) for frame in range(12)
    ]
    found = track_people(looks, 200, 100)
    assert {one.radius for one in found.subject.people.values()} == {1.8 * 25}
    still = [(frame, [person(100, 60, change=1.0)]) for frame in range(12)]
    assert track_people(still, 200, 100).subject is not None  # nobody else moves either
    sitting = [(f, [person(100, 60, change=2.0), person(20 + f, 25, change=8.0)]) for f in range(12)]
    assert track_people(sitting, 200, 100).subject.at(0).radius == 1.8 * 60


def test_a_setting_names_another_person():
    looks = [(frame, [person(60, 40), person(150, 20)]) for frame in range(6)]
    first, second = (track_people(looks, 200, 100, number).subject.at(0) for number in (1, 2))
    assert first.radius > second.radius
    with pytest.raises(UserError, match=r"clip\.mp4 shows 2 people: lower ingest\.person=3"):
        track_people(looks, 200, 100, 3, "clip.mp4")


def test_between_two_searches_a_person_is_in_between():
    track = Track({0: person(10), 10: person(30, 60)})
    assert track.at(5).shoulders[0] == 20 and track.at(5).radius == pytest.approx(1.8 * 45)
    assert track.at(-3).shoulders[0] == 10 and track.at(99).shoulders[0] == 30
    assert track.away(4) == 4 and track.away(12) == 2


def test_a_track_ends_when_nobody_was_seen_for_long():
    looks = [(frame, [person(50)] if frame < 3 or frame > 20 else []) for frame in range(24)]
    assert len(link_detections(looks)) == 2


# What the detector is shown and what is measured of it.


@pytest.mark.parametrize("size", [(1768, 994), (360, 640), (500, 500), (900, 720), (3000, 200)])
def test_squares_cover_an_oblong_picture(size):
    width, height = size
    parts, short = squares(width, height), min(size)
    if max(size) < 1.2 * short:
        assert parts == []
        return
    covered = np.zeros((height, width), int)
    for left, top, side in parts:
        assert side == short and left + side <= width and top + side <= height
        covered[top : top + side, left : left + side] += 1
    assert covered.min() >= 1


def test_one_person_found_twice_is_one():
    found = distinct([person(50, score=0.6), person(54, score=0.9), person(120, score=0.7)])
    assert [one.score for one in found] == [0.9, 0.7]


def test_clothes_tell_people_apart_and_light_does_not():
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 30, (200, 300, 3), np.uint8)
    picture[40:140, 30:110] += np.array([150, 20, 20], np.uint8)
    picture[40:140, 180:260] += np.array([20, 120, 30], np.uint8)
    one, other = (person(x, 50.0, y=60.0) for x in (70, 220))
    red, green = torso_colors(picture, one), torso_colors(picture, other)
    dim = torso_colors((picture * 0.8).astype(np.uint8), one)
    assert red.sum() == pytest.approx(1) and color_overlap(red, red) == pytest.approx(1)
    assert color_overlap(red, dim) > color_overlap(red, green) + 0.2
    assert torso_colors(picture, person(-90)) is None


def test_a_picture_that_moves_as_a_whole_has_not_changed():
    rng = np.random.default_rng(0)
    noise = cv2.GaussianBlur(rng.integers(0, 255, (240, 340)).astype(np.float32), (0, 0), 8)
    texture = np.uint8(255 * (noise - noise.min()) / np.ptp(noise))
    before, moved, other = texture[20:220, 20:320], texture[23:223, 24:324], texture[::-1][20:220, 20:320]
    one = person(150, 50.0, y=60.0)
    still, panned, changed = (change_since(before, now, one) for now in (before, moved, other))
    assert still < 1e-3 and panned < 0.4 * changed
    assert change_since(before, moved, person(900)) is None


def test_an_estimate_of_a_part_is_placed_in_the_whole():
    height, width, box = 120, 200, Box(60, 20, 160, 120)
    points = np.tile(np.array([[0.5, 0.5, 0.1]], np.float32), (4, 1))
    mask = np.zeros((200, 200), np.float32)  # the part was shown at twice its size
    mask[100, 100] = 1
    part = Estimate(points, points, points, (None, points), mask, mask)
    whole = part.placed(box, width, height)
    np.testing.assert_allclose(whole.pose[0], [110 / 200, 70 / 120, 0.1 * 100 / 200], rtol=1e-6)
    assert whole.hands[0] is None and whole.face is not None
    assert whole.body_mask.shape == (240, 400)
    assert tuple(np.argwhere(whole.body_mask)[0]) == (140, 220)
    np.testing.assert_array_equal(dataclasses.replace(part).world, whole.world)


# The same person in another camera.


def camera_at(angle, distance=4.0):
    """A camera on a circle about the world's origin, looking at it."""
    cosine, sine = np.cos(angle), np.sin(angle)
    rotation = np.array([[cosine, 0, -sine], [0, 1.0, 0], [sine, 0, cosine]])
    lens = pinhole_lens(640, 480, (500.0, 500.0), (320.0, 240.0))
    return CalibratedCamera(lens, rotation, np.array([0.0, 0.0, distance]))


def seen_by(camera, places, first, colors=None):
    """The track of somebody whose shoulders are at some places in the world."""
    track = {}
    for offset, place in enumerate(places):
        x, y, z = camera.rotation @ place + camera.translation
        pixel = np.array([320 + 500 * x / z, 240 + 500 * y / z])
        track[first + offset] = Person(pixel + [0, 250 / z], pixel, 450 / z, 0.9, colors)
    return Track(track)


def test_lines_of_sight_find_the_person_in_another_camera():
    walk = np.linspace(-0.5, 0.5, 6)
    woman = np.stack([walk, 0 * walk, 0 * walk - 0.8], 1)
    man = np.stack([-walk, 0 * walk, 0 * walk + 0.8], 1)
    one, other = camera_at(0.0), camera_at(1.2)
    mine, theirs = (seen_by(camera, woman, 0).at(0).shoulders for camera in (one, other))
    lengths, miss = rays_meet(one, mine, other, theirs)
    assert miss < 1e-9 and lengths[0] == pytest.approx(np.linalg.norm(woman[0] - [0, 0, -4.0]))
    for subject, stranger in ((woman, man), (man, woman)):
        known = KnownPerson(seen_by(one, subject, 0), one, 0)
        tracks = [seen_by(other, who, 100_000) for who in (stranger, subject)]
        assert known.among(tracks, other, 100_000) is tracks[1]


def test_without_a_calibration_colours_find_the_person():
    known = KnownPerson(Track({0: person(50, colors=RED)}), None, 0)
    tracks = [Track({0: person(50, 60, colors=GREEN)}), Track({0: person(150, 20, colors=RED)})]
    assert known.among(tracks, None, 100_000) is tracks[1]
    looks = [(frame, [person(50, 60, colors=GREEN), person(150, 30, colors=RED)]) for frame in range(4)]
    chosen = track_people(looks, 200, 100, choose=lambda people: known.among(people, None, 0))
    assert chosen.subject.at(0).shoulders[0] == 150 and len(chosen.others) == 1


def test_half_a_body_at_a_squares_edge_is_nobody():
    """An arm that a square cut was somebody who stood on the head, and the mask lost the arm."""
    arm = Person(np.array([682.0, 495.0]), np.array([661.0, 636.0]), 277.0, 0.66)
    left, middle = (inner_edges(square, 1280, 720) for square in squares(1280, 720)[:2])
    assert is_cut(arm, left) and not is_cut(arm, middle)


def test_what_the_picture_itself_cuts_is_somebody():
    at_the_border = Person(np.array([20.0, 900.0]), np.array([20.0, 500.0]), 500.0, 0.9)
    for square in [(0, 0, 1280), squares(1280, 720)[0]]:
        assert not is_cut(at_the_border, inner_edges(square, 1280, 720))
