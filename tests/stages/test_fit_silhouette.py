"""The silhouette term: distances to masks, what clothes add, and a body drawn to where its mask is."""

import numpy as np
import pytest
import torch

from pipeline.body import PARTS, BodyModel, joint_index, rasterize
from pipeline.clip.camera import facing_camera
from stages.fit.camera_batch import stack
from stages.fit.parameters import Parameters, parameters_of
from stages.fit.silhouette import (
    DistanceFields,
    Silhouette,
    border,
    segment_medians,
    segments,
    signed_distance,
)
from tests.made.body import open_body

SIZE, T = 96, 3


def disc(size: int, radius: float) -> np.ndarray:
    rows, columns = np.mgrid[:size, :size] - (size - 1) / 2
    return np.where(np.hypot(rows, columns) <= radius, 255, 0).astype(np.uint8)


def test_distances_are_in_pixels_of_512_and_negative_inside():
    fields = DistanceFields(signed_distance(disc(256, 64))[None])
    middle, beside = torch.tensor([[[128.0, 128.0], [128.0 + 80, 128.0]]]), torch.tensor([[256.0, 256.0]])
    inside, outside = fields.sample(middle, beside, slice(None))[0].tolist()
    assert inside == -60.0  # 128, and no more is told apart
    assert outside == pytest.approx(2 * 16, abs=2)


def test_a_picture_without_an_outline_pulls_nowhere():
    for level in (0, 255):
        assert not signed_distance(np.full((40, 30), level, np.uint8)).any()


def test_where_the_picture_ends_is_no_outline():
    covered = np.zeros((40, 40), bool)
    covered[20:, 10:30] = True
    found = border(covered)
    assert found[20, 10:30].all() and found[25, [10, 29]].all() and not found[-2:].any()


def test_clothes_are_the_median_of_a_segment_and_take_nothing_away():
    values = torch.tensor([[3.0] * 20 + [-5.0] * 20, [5.0] * 20 + [-7.0] * 20])
    segment = torch.tensor([[0] * 20 + [1] * 20] * 2)
    there = torch.ones_like(values, dtype=torch.bool)
    assert segment_medians(values, segment, there)[:, [0, 20]].tolist() == [[3.0, 0.0]] * 2
    there[:, 5:20] = False  # too few to tell
    assert not segment_medians(values, segment, there).any()


def test_left_and_right_are_one_segment():
    body = open_body()
    joints = [joint_index(f"{side}_shoulder") for side in ("left", "right")]
    left, right = (int(body.skinning_weights[:, joint].argmax()) for joint in joints)
    assert segments(body)[left] == segments(body)[right] != segments(body)[0]


@pytest.fixture(scope="module")
def body() -> BodyModel:
    return open_body()


def standing(body: BodyModel, shift: torch.Tensor) -> Parameters:
    """A body in T pose, two and a half metres away; ``shift`` [T, 3] metres."""
    transl = torch.tensor([[0.0, 0.3, -2.5]]) + shift
    sizes = (4, body.expression_directions.shape[2], 1)
    return parameters_of(torch.zeros(T, 55, 3), transl, sizes)


def silhouette(body: BodyModel, parts: tuple[str, ...] = PARTS) -> Silhouette:
    """The term of a clip whose masks show a body that stands still; keypoints speak for ``parts``."""
    camera = facing_camera(SIZE, SIZE, focal=1.2 * SIZE)
    vertices = body.v_template + standing(body, torch.zeros(T, 3)).transl[0]
    mask = 255 * rasterize(camera.resized(256, 256), vertices, body.faces).covered.astype(np.uint8)
    fields = DistanceFields(signed_distance(mask).expand(T, -1, -1))
    cameras = [camera] * T
    counted = np.tile([part in parts for part in PARTS], (T, 1))
    return Silhouette(body, fields, cameras, stack(cameras), 4, counted)


def loss_of(term: Silhouette, parameters: Parameters) -> torch.Tensor:
    return term.loss(parameters, parameters.matrices, slice(None))


def test_a_body_beside_its_mask_is_drawn_back(body):
    term = silhouette(body)
    aside = standing(body, torch.tensor([[0.0, 0, 0], [0.06, 0, 0], [-0.06, 0, 0]])).leaves()
    assert not loss_of(term, aside).any()  # before outlines are found
    term.find(aside, aside.matrices)
    loss = loss_of(term, aside)
    assert loss[1] > 3 * loss[0] and loss[2] > 3 * loss[0]
    loss.sum().backward()
    pull = -aside.transl.grad[:, 0]
    assert pull[1] < 0 < pull[2]


def test_what_no_keypoint_speaks_for_does_not_count(body):
    term, aside = silhouette(body, parts=()), standing(body, torch.full((T, 3), 0.05))
    term.find(aside, aside.matrices)
    assert not loss_of(term, aside).any()


def test_a_shoulders_outline_swings_no_arm_that_nobody_sees(body):
    row = joint_index("left_shoulder") - 1
    for parts, swings in ((("torso",), False), (PARTS, True)):
        term, aside = silhouette(body, parts), standing(body, torch.full((T, 3), 0.05)).leaves()
        term.find(aside, aside.matrices)
        loss_of(term, aside).sum().backward()
        assert aside.body_pose.grad[:, row].any().item() is swings
        assert aside.transl.grad.any()
