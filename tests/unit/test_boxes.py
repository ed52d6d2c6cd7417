"""Boxes of pixels, and evenly spread frames."""

import numpy as np
import pytest

from pipeline.clip.boxes import SMALLEST, Box, clip_box, person_box
from pipeline.clip.frames import spread_end_to_end, spread_from_start, write_mask
from pipeline.errors import UserError
from pipeline.metrics.ssim import WINDOW


def test_a_box_by_hand():
    box = Box(2, 3, 5, 7)
    assert (box.width, box.height) == (3, 4)
    assert np.zeros((9, 9, 3))[box.slices].shape == (4, 3, 3)
    assert box.widened(3) == Box(-1, 0, 8, 10)
    assert box.widened(3).clipped(6, 9) == Box(0, 0, 6, 9)
    assert Box.whole(np.zeros((4, 6, 3))) == Box(0, 0, 6, 4)


def test_the_persons_box():
    mask = np.zeros((50, 60), np.uint8)
    mask[20:30, 5:40] = 255
    assert person_box([mask], margin=8) == Box(0, 12, 48, 38)
    mask[45, 50] = 127
    assert person_box([mask], margin=8) == Box(0, 12, 48, 38)
    assert person_box([mask], margin=0, faintest=8) == Box(5, 20, 51, 46)
    assert person_box([np.zeros((5, 7), np.uint8)]) is None


def test_a_clips_box_is_as_large_as_the_window_of_ssim(tmp_path):
    assert SMALLEST == WINDOW
    (tmp_path / "masks").mkdir()
    mask = np.zeros((64, 48), np.uint8)
    mask[60:, 44:] = 255
    write_mask(tmp_path / "masks", 0, mask)
    assert clip_box(tmp_path, (0,), 0) == Box(37, 53, 48, 64)
    write_mask(tmp_path / "masks", 0, mask[-10:])
    with pytest.raises(UserError, match="at least 11 pixels"):
        clip_box(tmp_path, (0,), 0)


def test_masks_without_anybody_say_so(tmp_path):
    (tmp_path / "masks").mkdir()
    for frame in range(3):
        write_mask(tmp_path / "masks", frame, np.zeros((64, 48), np.uint8))
    with pytest.raises(UserError, match="nobody"):
        clip_box(tmp_path, (0, 1, 2), 8)


def test_a_clips_box_holds_every_mask_and_stays_in_the_frame(tmp_path):
    (tmp_path / "masks").mkdir()
    for frame, column in enumerate((3, 30)):
        mask = np.zeros((64, 48), np.uint8)
        mask[20:60, column : column + 10] = 255
        write_mask(tmp_path / "masks", frame, mask)
    box = clip_box(tmp_path, (0, 1), 8)
    assert box == Box(0, 12, 48, 64)


def test_the_two_ways_to_spread():
    assert spread_from_start(range(10), 4) == (0, 2, 5, 7)
    assert spread_end_to_end(range(10), 4) == [0, 3, 6, 9]
    assert spread_from_start(range(10), 1) == (0,) and spread_end_to_end(range(10), 1) == [5]
    assert spread_from_start(range(3), 5) == (0, 1, 2) and spread_end_to_end(range(3), 5) == [0, 1, 2]
