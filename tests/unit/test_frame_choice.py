"""Which frames of a long clip are drawn."""

import dataclasses
from types import SimpleNamespace

import pytest
import torch

from pipeline.body import Pose
from pipeline.clip.camera import facing_camera
from pipeline.clip.records import Split
from stages.train.data import TrainingData
from stages.train.frame_choice import farthest_first, frames_to_draw


def clip_of(turns: list[float]) -> TrainingData:
    """A head that turns by so many radians, a frame each; held-out frames lie in between."""

    def pose(frame: int) -> Pose:
        rotation = torch.zeros(55, 3)
        rotation[15, 1] = turns[frame // 2]
        return Pose(rotation, torch.zeros(5), torch.tensor([0.0, 0.0, -2.0]))

    train = tuple(range(0, 2 * len(turns), 2))
    cameras = {frame: facing_camera(64, 64, 60.0) for frame in train}
    clip = SimpleNamespace(split=Split(train=train, test=(1,)), cameras=cameras, pose=pose)
    return TrainingData(clip=clip, crops=None, whole=None)


def test_rows_far_from_each_other_come_first():
    line = torch.tensor([[0.0], [0.1], [0.2], [5.0], [-5.0]])
    assert sorted(farthest_first(line, 3)) in ([0, 3, 4], [1, 3, 4])
    assert sorted(farthest_first(line, 5)) == [0, 1, 2, 3, 4]
    assert len(set(farthest_first(torch.zeros(4, 2), 4))) == 4  # equal rows, too, are taken once each


@pytest.mark.parametrize(("steps", "visits"), [(24, 4.0), (100, 4.0), (3, 0.0)])
def test_a_clip_that_the_steps_can_visit_is_drawn_whole(steps, visits):
    data = clip_of([0.0, 0.1, 0.2, 0.3, 0.4, 0.5])
    assert frames_to_draw(data, steps, visits) == data.clip.split.train


def test_of_a_longer_clip_what_differs_most_is_drawn():
    data = clip_of([0.0, 0.001, 0.002, 0.003, 0.004, 0.9, -0.9])
    drawn = frames_to_draw(data, 12, 4.0)
    assert len(drawn) == 3 and {10, 12} <= set(drawn)
    assert dataclasses.replace(data, drawn=drawn).sources == (drawn, ())


def test_one_step_draws_one_frame():
    assert len(frames_to_draw(clip_of([0.0, 0.1, 0.2]), 1, 6.0)) == 1
