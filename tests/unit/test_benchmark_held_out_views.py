"""The geometry of the held-out-view benchmark, on a made-up rig."""

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.held_out_views import (
    MIRRORED,
    POINTS,
    Watched,
    along_rays,
    headline,
    table,
    triangulated,
    without_exchanges,
)

MATRIX = np.array([[300.0, 0, 160], [0, 300.0, 120], [0, 0, 1]])


def rig(points):
    """Four cameras about the origin that see every point exactly."""
    cameras = []
    for angle in (0, 70, 150, 250):
        rotation = Rotation.from_euler("y", angle, degrees=True).as_matrix()
        projection = MATRIX @ np.concatenate([rotation, [[0], [0.2], [4]]], axis=1)
        one = Watched(projection, np.zeros((*points.shape[:2], 2)), np.ones(points.shape[:2], bool), 200.0)
        cameras.append(Watched(projection, one.project(points), one.seen, 200.0))
    return cameras


def some_points():
    return np.random.default_rng(0).normal(0, 0.4, (5, len(POINTS), 3))


def test_points_come_back_from_their_projections():
    points = some_points()
    np.testing.assert_allclose(triangulated(rig(points)[1:]), points, atol=1e-9)


def test_a_point_that_one_camera_alone_sees_has_no_place():
    watched = rig(some_points())[1:]
    for one in watched[1:]:
        one.seen[2, 3] = False
    found = triangulated(watched)
    assert np.isnan(found[2, 3]).all() and np.isfinite(found[2, 4]).all()


def test_frames_with_left_and_right_exchanged_are_left_out():
    watched = rig(some_points())
    watched[1].pixels[3] = watched[1].pixels[3][list(MIRRORED)]
    cleaned = without_exchanges(watched)
    np.testing.assert_array_equal(cleaned[1].seen.all(1), [True, True, True, False, True])
    assert all(one.seen.all() for one in (cleaned[0], *cleaned[2:]))


def test_a_depth_that_one_camera_cannot_know_is_taken_out():
    points = some_points()
    watched = rig(points)
    centre = watched[0].centre
    scales = np.array([0.8, 0.9, 1.0, 1.1, 1.25])[:, None, None]
    far = centre + scales * (points - centre)
    assert watched[0].error(far).max() < 1e-6  # the first camera sees no difference
    assert watched[1].error(far)[[0, 4]].mean() > 10
    assert watched[1].error(along_rays(far, watched)).mean() < 1


def test_the_table_counts_and_averages():
    points = some_points()
    watched = rig(points)
    shifted = points + [0, 0.04, 0]
    contestants = {"fit": shifted, "initialisation": shifted + [0, 0.04, 0]}
    contestants |= {f"floor {k}": points for k in (1, 2, 3, 4)}
    rows = list(table(watched, contestants))
    found = {(row.contestant, row.camera, row.joints): row for row in rows}
    assert len(found) == len(rows) == 3 * (4 + 1 + 6)
    fit = found["fit", "2-4", "all"]
    assert fit.points == 3 * 5 * len(POINTS) and found["fit", "2-4", "hips"].points == 3 * 5 * 2
    expected = np.mean([one.error(shifted).mean() for one in watched[1:]])
    np.testing.assert_allclose([fit.mean, fit.percent_of_height], [expected, expected / 2], rtol=1e-6)
    assert found["floor", "2-4", "all"].mean < 1e-6 < fit.mean < found["initialisation", "2-4", "all"].mean
    assert f"fit {fit.mean:.2f} px" in headline([dataclasses.asdict(row) for row in rows])
