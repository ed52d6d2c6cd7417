"""Pictures for people, by hand."""

import cv2
import numpy as np
import pytest

from pipeline.pictures import PAPER, caption, contact_sheet, resized, shrunk, side_by_side


def flat(height, width, value):
    return np.full((height, width, 3), value, np.uint8)


def test_side_by_side_with_a_gap():
    row = side_by_side([flat(2, 1, 10), flat(2, 3, 20)], gap=2)
    assert row[0, :, 0].tolist() == [10, PAPER, PAPER, 20, 20, 20]
    assert side_by_side([flat(2, 1, 10), flat(2, 3, 20)]).shape == (2, 4, 3)


def test_a_contact_sheet_fills_rows_and_pads_to_the_largest():
    sheet = contact_sheet([flat(2, 2, 10), flat(1, 2, 20), flat(2, 1, 30)], columns=2, paper=7)
    assert sheet[..., 0].tolist() == [[10, 10, 20, 20], [10, 10, 7, 7], [30, 7, 7, 7], [30, 7, 7, 7]]
    assert contact_sheet([flat(2, 2, 10)], columns=2).shape == (2, 4, 3)


def test_labels_lie_above_their_pictures():
    sheet = contact_sheet([flat(30, 60, 10), flat(30, 60, 20)], 2, ["one", "two"], PAPER, gap=4)
    assert sheet.shape == (30 + 22 + 4, 2 * (60 + 4), 3)
    assert (sheet[22:52, :60] == 10).all() and (sheet[22:52, 64:124] == 20).all()
    assert sheet[:22].min() < PAPER and (sheet[52:] == PAPER).all() and (sheet[:, 60:64] == PAPER).all()


@pytest.mark.parametrize("width", [30, 400])
def test_a_caption_ends_within_its_band(width):
    band = caption("frame 12, 31.20 dB", width)
    assert band.shape == (26, width, 3) and band.min() < 200 and (band[:, -2:] == PAPER).all()


def test_proportions_are_kept():
    assert resized(flat(40, 30, 9), 20).shape == (20, 15, 3)
    assert resized(flat(40, 30, 9), 80, cv2.INTER_LINEAR).shape == (80, 60, 3)
    assert shrunk(flat(40, 30, 9), 20).shape == (20, 15, 3)
    assert shrunk(flat(40, 30, 9), 60).shape == (40, 30, 3)
