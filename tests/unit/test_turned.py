"""The avatar from all sides, judged without a truth."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.avatar import Architecture, Avatar
from pipeline.body import Pose, load_body, mean_identity
from pipeline.orbit_cameras import relaxed_pose
from stages.evaluate.turned import hole_share, look_around, seen_surface
from stages.evaluate.verdict import worst_side

BODY = load_body(Path(__file__).parents[2] / "data" / "body" / "open_body.npz")


@pytest.fixture(scope="module")
def doll():
    """A bare body of one colour, its back half guessed: surface, and Gaussians in the A pose."""
    sizes = Architecture(plane_resolution=2, plane_channels=1, subdivisions=0, width=16, groups=4)
    avatar = Avatar(BODY, mean_identity(BODY), torch.arange(len(BODY.v_template)), sizes).eval()
    avatar.trust[:, 0] = (avatar.surfaces[0].canonical.frames[:, 2, 2] > 0).float()
    with torch.no_grad():
        gaussians = avatar.gaussians(Pose(relaxed_pose(0.9), torch.zeros(10), torch.zeros(3)))
    return seen_surface(avatar), gaussians


def test_a_whole_body_has_no_holes_and_no_speckle(doll):
    surface, gaussians = doll
    found = look_around(gaussians, surface, lambda picture: False)
    assert found.holes < 0.01 and found.face_behind is False
    assert found.guessed == pytest.approx(float((surface.trust < 0.5).float().mean()))
    assert len(found.pictures) == len(found.marked) == 8
    assert np.abs(found.pictures[4].astype(int) - found.marked[4]).mean() > 5
    assert np.abs(found.pictures[0].astype(int) - found.marked[0]).mean() < 1


def test_shrunken_gaussians_are_a_sieve_and_noise_is_speckle(doll):
    surface, gaussians = doll
    noise = torch.rand(gaussians.colors.shape, generator=torch.Generator().manual_seed(0))
    colors = torch.where((surface.trust < 0.5)[:, None], noise, gaussians.colors + 0.1 * noise)
    broken = dataclasses.replace(gaussians, scales=0.3 * gaussians.scales, colors=colors)
    seen = []
    found = look_around(broken, surface, lambda picture: not seen.append(picture))
    assert found.holes > 0.1 and found.speckle > 5 and found.face_behind is True
    # Straight from behind alone: from its sides a true face can be seen.
    assert len(seen) == 1 and np.array_equal(seen[0], found.pictures[4])


def test_holes_are_counted_inside_the_smaller_silhouette():
    covered = np.zeros((20, 20), bool)
    covered[2:18, 2:18] = True
    alpha = np.where(covered, 1.0, 0.0)
    alpha[:5] = 0  # rows 4 of the inner 4 to 15
    assert hole_share(alpha, covered) == pytest.approx(1 / 12)
    assert hole_share(alpha, np.zeros_like(covered)) == 0


def test_the_worst_side_is_named_and_a_good_avatar_gets_no_sentence():
    good = {"holes": 0.0, "speckle": 1.0, "face_behind": False, "guessed": 0.4}
    assert worst_side(good) == worst_side(None) == ""
    said = [worst_side(good | change) for change in ({"face_behind": True}, {"holes": 0.1}, {"speckle": 3.0})]
    assert all(said) and len(set(said)) == 3
    assert worst_side(good | {"face_behind": True, "holes": 0.1}) == said[0]
