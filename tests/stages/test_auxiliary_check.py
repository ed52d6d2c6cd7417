"""Which generated frames are refused: another person's, shuffled ones, a painted-out arm, flicker."""

import dataclasses
import json

import cv2
import numpy as np
import pytest
import torch

from pipeline.body import PARTS, part_labels, posed_vertices, rasterize
from pipeline.clip.frames import write_frame
from stages.auxiliary import frame_checks
from stages.auxiliary import run as stage
from stages.auxiliary.detect_generated import DetectedPicture
from stages.auxiliary.register import MIRRORED, register
from stages.auxiliary.skeleton import turntable_keypoints
from stages.auxiliary.turntable_motion import make_turntable_motion
from tests.made.body import open_landmarks
from tests.made.mannequin_clip import context_for, films, read, write_clip

FRAMES, SIZE = 8, (360, 640)
NEEDED = ("mediapipe", "dlib", "identity")


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """A head large enough to be known again."""
    return write_clip(tmp_path_factory.mktemp("clip"), "head", 192)


@pytest.fixture(scope="module")
def settings():
    return {"frames": FRAMES, "width": SIZE[0], "height": SIZE[1], "generator": "folder", "folder": "x"}


@pytest.fixture(scope="module")
def turn(clip, settings, tmp_path_factory):
    context = context_for(clip, tmp_path_factory.mktemp("t") / "t", **settings)
    return make_turntable_motion(read(clip), context.settings)


@pytest.fixture(scope="module")
def own(turn):
    return films(turn, 0)


@pytest.fixture
def judged(clip, settings, assets_folder, tmp_path):
    """A function: pictures -> kept frames, and reason -> count."""
    assets = {name: assets_folder / name for name in NEEDED}
    if not all(path.is_dir() for path in assets.values()):
        pytest.skip("the assets mediapipe, dlib and identity are not there")

    def judge(images):
        folder = tmp_path / "made"
        folder.mkdir()
        for number, image in enumerate(images):
            write_frame(folder, number, image)
        changes = {**settings, "folder": str(folder), "unseen_only": False}
        context = context_for(clip, tmp_path / "out", assets, **changes)
        stage.run(context)
        counts = json.loads((context.output / "auxiliary.json").read_text())
        assert counts["kept"] or "auxiliary.check=false" in context.logged[-1]
        frames = [int(path.stem) % 100_000 for path in sorted((context.output / "frames").iterdir())]
        return frames, counts["refused"], counts["identity_distance"]

    return judge


@pytest.mark.assets
def test_the_subjects_own_frames_are_kept_and_one_without_an_arm_is_not(clip, turn, own, judged):
    images = list(own)
    images[1] = without_arm(read(clip), turn, 1, own[1])
    frames, refused, distance = judged(images)
    assert frames == [0, 2, 3, 4, 5, 6, 7]
    assert refused == {frame_checks.MASK: 1}
    assert distance < 0.5


@pytest.mark.assets
def test_another_persons_frames_are_all_refused(turn, judged):
    frames, refused, _ = judged(films(turn, 5))
    assert frames == [] and refused[frame_checks.FACE_OF] == FRAMES


@pytest.mark.assets
def test_shuffled_frames_are_refused_and_those_in_their_place_kept(own, judged):
    order = [0, 5, 6, 7, 4, 1, 2, 3]
    frames, refused, _ = judged([own[place] for place in order])
    assert frames == [0, 4]
    assert sum(refused.values()) == 6 and set(refused) <= {
        frame_checks.POSE,
        frame_checks.AWAY,
        frame_checks.MASK,
    }


def without_arm(clip, turn, row, image):
    """A frame whose left arm is painted over with what is beside it."""
    vertices = posed_vertices(clip.body, clip.identity, turn.poses.pose(row))
    raster = rasterize(turn.camera, vertices, clip.body.faces)
    labels = part_labels(clip.body).numpy()[clip.body.faces[:, 0].numpy()]
    parts = np.where(raster.covered, labels[np.maximum(raster.face, 0)], -1)
    arm = np.isin(parts, [PARTS.index("left_arm"), PARTS.index("left_hand")]).astype(np.uint8)
    return cv2.inpaint(image, cv2.dilate(arm, np.ones((21, 21), np.uint8)), 3, cv2.INPAINT_TELEA)


def look(frame, thumb, **changes):
    blank = DetectedPicture(
        frame, np.zeros((133, 3), np.float32), True, np.zeros((0, 0), np.uint8), None, thumb
    )
    return dataclasses.replace(blank, **changes)


def test_a_frame_that_jumps_flickers():
    thumbs = [np.full((4, 4, 3), 100.0 + k, np.float32) for k in range(9)]
    thumbs[4] = thumbs[4] + 60
    assert frame_checks.flickering([look(k, t) for k, t in enumerate(thumbs)], 3.0) == [
        k == 4 for k in range(9)
    ]


def test_a_lasting_change_is_no_flicker():
    thumbs = [np.full((4, 4, 3), 100.0 + k + 60 * (k > 4), np.float32) for k in range(9)]
    assert not any(frame_checks.flickering([look(k, t) for k, t in enumerate(thumbs)], 3.0))


def test_one_bad_face_is_one_frame_and_most_of_them_are_everybody():
    subject = np.zeros(128)
    near, far = np.full(128, 0.02), np.full(128, 0.09)  # 0.23 and 1.02 away
    thumb = np.zeros((2, 2, 3), np.float32)
    looks = [look(k, thumb, embedding=far if k == 0 else near) for k in range(4)]
    distances, stranger = frame_checks.other_faces(looks, [1.0, 1.0, 1.0, 0.0], subject, 0.55)
    assert distances[0] > 1 and distances[1] == pytest.approx(0.226, abs=0.01)
    assert distances[3] is None and not stranger
    assert frame_checks.other_faces([looks[0]] * 3, [1.0] * 3, subject, 0.55)[1]
    assert frame_checks.other_faces(looks, [1.0] * 4, None, 0.55) == ([None] * 4, False)


def test_exchanged_sides_are_noticed(clip, turn):
    points = turntable_keypoints(read(clip), turn, open_landmarks())[4]
    exchanged = points.copy()
    exchanged[:23] = points[MIRRORED]
    straight, mirrored = (
        frame_checks.match_keypoints(points, points),
        frame_checks.match_keypoints(exchanged, points),
    )
    assert straight.distance == 0 and not straight.mirrored
    assert mirrored.distance == 0 and mirrored.mirrored
    assert np.array_equal(frame_checks.usable_points(exchanged, mirrored), points[:23])


def test_a_body_that_moved_is_found_again(clip, turn):
    """Keypoints of a pose 6 cm to the side with an arm lowered: the registration goes there."""
    person, landmarks = read(clip), open_landmarks()
    rotation, transl = turn.poses.rotation.clone(), turn.poses.transl.clone()
    rotation[:, 16, 2] -= 0.3
    transl[:, 0] += 0.06
    there = dataclasses.replace(turn, poses=dataclasses.replace(turn.poses, rotation=rotation, transl=transl))
    target = turntable_keypoints(person, there, landmarks)
    target[:, :23, 2] = 1
    found = register(person, landmarks, turn.poses, [turn.camera] * FRAMES, target[:, :23])
    moved = dataclasses.replace(turn, poses=found)
    before = turntable_keypoints(person, turn, landmarks)[:, :23, :2] - target[:, :23, :2]
    after = turntable_keypoints(person, moved, landmarks)[:, :23, :2] - target[:, :23, :2]
    assert np.abs(after).mean() < 0.2 * np.abs(before).mean()
    assert torch.equal(found.expression, turn.poses.expression)
