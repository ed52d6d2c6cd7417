"""The table of a fit's quality, and the frames that a reader of the clip gets."""

import dataclasses

import numpy as np
import pytest

from pipeline.clip.fit_quality import (
    FIT_QUALITY,
    LEAST_COVERED,
    MOST_OUTSIDE,
    MOST_REPROJECTION,
    read_fit_quality,
    write_fit_quality,
)
from pipeline.clip.fitted_clip import read_fitted_clip
from pipeline.errors import UserError
from tests.made.body import open_body
from tests.made.fit_quality import good_fit
from tests.made.portrait import write_subject


def test_what_is_written_is_read(tmp_path):
    quality = dataclasses.replace(good_fit([3, 5, 9]), accepted=np.array([True, False, True]))
    write_fit_quality(tmp_path, quality)
    read = read_fit_quality(tmp_path)
    for field in dataclasses.fields(quality):
        np.testing.assert_array_equal(getattr(read, field.name), getattr(quality, field.name))
    assert read.of([5, 9, 11]).frames.tolist() == [5, 9]


def test_each_of_the_three_numbers_fails_a_frame_by_itself():
    good = good_fit(range(4))
    error, covered, outside = good.error.copy(), good.covered.copy(), good.outside.copy()
    error[1] = 1.01 * MOST_REPROJECTION * good.size[1]
    covered[2], outside[3] = LEAST_COVERED - 0.01, MOST_OUTSIDE + 0.01
    spoilt = dataclasses.replace(good, error=error, covered=covered, outside=outside)
    assert spoilt.passed.tolist() == [True, False, False, False]


def test_an_error_counts_by_the_size_of_the_person():
    good = good_fit(range(2))
    near_and_far = dataclasses.replace(good, error=np.array([20.0, 20.0]), size=np.array([400.0, 40.0]))
    assert near_and_far.passed.tolist() == [True, False]


def test_readers_get_the_accepted_frames_only(tmp_path):
    write_subject(tmp_path)
    ingest, fit = tmp_path / "ingest", tmp_path / "fit"
    whole = read_fitted_clip(ingest, fit, open_body())
    quality = good_fit(whole.poses.frames)
    accepted = ~np.isin(quality.frames, [whole.split.train[1], *whole.split.test])
    write_fit_quality(fit, dataclasses.replace(quality, accepted=accepted))
    clip = read_fitted_clip(ingest, fit, open_body())
    assert clip.split.train == (whole.split.train[0], *whole.split.train[2:]) and clip.split.test == ()
    only_test = np.isin(quality.frames, whole.split.test)
    write_fit_quality(fit, dataclasses.replace(quality, accepted=only_test))
    with pytest.raises(UserError, match=r"no training frame.*fit\.accept=any"):
        read_fitted_clip(ingest, fit, open_body())


def test_a_table_without_an_accepted_frame_is_refused(tmp_path):
    write_fit_quality(tmp_path, dataclasses.replace(good_fit([1, 2]), accepted=np.zeros(2, bool)))
    with pytest.raises(UserError, match=f"{FIT_QUALITY} accepts no frame"):
        read_fit_quality(tmp_path)
    with pytest.raises(UserError, match="is missing"):
        read_fit_quality(tmp_path / "nowhere")
