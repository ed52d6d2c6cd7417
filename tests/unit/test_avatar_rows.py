"""Some rows and back, and an avatar whose pose heads are asked for some Gaussians only."""

import dataclasses

import pytest
import torch

from pipeline.avatar.sparse import gather_rows, scatter_rows
from stages.train.body_regions import unmixed
from stages.train.frame_visibility_cache import FrameVisibilityCache
from tests.unit.test_bake import WITH_RESIDUALS, a_pose, an_avatar, one_thread  # noqa: F401
from tests.unit.test_train_losses import PATH


def test_take_and_put_are_indexing_with_gradients():
    values, rows = torch.randn(6, 2, dtype=torch.float64, requires_grad=True), torch.tensor([4, 0, 3])
    assert torch.equal(gather_rows(values, rows), values[rows])
    back = scatter_rows(values[:3], rows, 5)
    assert torch.equal(back[rows], values[:3]) and (back[[1, 2]] == 0).all()
    assert torch.autograd.gradcheck(lambda x: gather_rows(x, rows), values)
    assert torch.autograd.gradcheck(lambda x: scatter_rows(x[:3], rows, 5), values)


@pytest.mark.parametrize("place", ["canonical", "posed"])
def test_rows_that_are_asked_for_are_posed_as_ever_and_teach_as_ever(body, place):
    architecture = dataclasses.replace(WITH_RESIDUALS, residual_place=place, subdivisions=0)
    avatar, rows = an_avatar(body, architecture).train(), torch.arange(1, 2000, 3)
    others = torch.ones(len(avatar), dtype=torch.bool).index_fill(0, rows, False)
    results = []
    for asked in (None, rows):
        posed = avatar.pose(avatar.decode(), a_pose(), time=1.0, rows=asked)
        values = [posed.pose_offset, posed.log_scale, posed.color_logit, posed.color_residual]
        loss = sum((value[rows] * value[rows].detach().cos()).sum() for value in values)
        results.append((values, torch.autograd.grad(loss, list(avatar.parameters()))))
    (whole, gradients), (some, same) = results
    for mine, theirs in zip(some, whole, strict=True):
        torch.testing.assert_close(mine[rows], theirs[rows], rtol=1e-4, atol=1e-5)
    assert (some[0][others] == 0).all() and (some[3][others] == 0).all()
    for mine, theirs in zip(same, gradients, strict=True):
        assert (mine - theirs).norm() < 1e-3 * theirs.norm() + 1e-5


def test_visibility_cache_remembers_each_frame_and_survives_a_checkpoint():
    cache, weights = FrameVisibilityCache((3, 8), 21), torch.zeros(21)
    weights[[0, 7, 8, 20]] = torch.tensor([1.0, 1e-7, 0.0, 3.0])
    assert cache.visible_rows(3, 1, 21) is None
    cache.record(3, 1, weights)
    other = FrameVisibilityCache((3, 8), 21)
    other.load_state_dict(cache.state_dict())
    for one in (cache, other):
        assert one.visible_rows(3, 1, 21).tolist() == [0, 7, 20]
        assert one.visible_rows(8, 1, 21) is None and one.visible_rows(3, 0, 10) is None
    cache.record(3, 0, weights[:10])
    assert cache.visible_rows(3, 0, 10).tolist() == [0, 7]


def test_smoothness_is_told_where_all_neighbours_are_of_one_kind():
    # A path of three vertices.
    assert unmixed(torch.tensor([0]), PATH, 3).flatten().tolist() == [0, 0, 1]
    assert unmixed(torch.tensor([0, 1, 2]), PATH, 3).flatten().tolist() == [1, 1, 1]
    assert unmixed(torch.tensor([], dtype=torch.long), PATH, 3).flatten().tolist() == [1, 1, 1]


def test_visibility_cache_of_a_gated_surface_covers_the_whole_one():
    cache, kept = FrameVisibilityCache((3,), 20), torch.tensor([2, 5, 11, 19])
    cache.record(3, 1, torch.tensor([1.0, 0.0, 2.0, 3.0]), kept)
    assert cache.visible_rows(3, 1, 4, kept).tolist() == [0, 2, 3]
    assert cache.visible_rows(3, 1, 20).tolist() == [2, 11, 19]  # the gate opened: what came back is unseen
    assert cache.visible_rows(3, 1, 2, torch.tensor([1, 11])).tolist() == [1]
