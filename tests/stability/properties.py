"""What must hold of the pure functions whatever they are given, and what they are given.

``PROPERTIES`` maps a name to a strategy and a check; ``test_properties.py`` draws from them, a little by
default and much in the soak.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import roma
import torch
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from pipeline.avatar.otsu_threshold import (
    LARGEST_LOSS,
    evidence_threshold,
    histogram,
    otsu_threshold,
    share_below,
)
from pipeline.body import Poses, linear_blend_skinning, uniform_laplacian, vertex_normals
from pipeline.clip.camera import facing_camera, project
from pipeline.clip.composite import composite_frame
from pipeline.finite import finite
from pipeline.metrics import interior, psnr, ssim, ssim_loss
from pipeline.metrics.ssim import plain_ssim_loss
from pipeline.splat import Gaussians, render
from stages.fit import terms
from stages.fit.initialise import continuous
from stages.fit.observations import drop_guesses, visible
from stages.fit.outlier_frames import isolated_outliers, left_right_swapped
from stages.fit.parameters import orthonormalised
from stages.fit.smoothing import nearest_branch, smooth
from stages.fit.windows import bumps, windows
from stages.ingest.masks import fill_holes, fuse, main_component
from stages.ingest.split import split_frames
from stages.train import losses, schedule

PROPERTIES: dict[str, tuple[st.SearchStrategy, Callable[[Any], None]]] = {}


def property_of(*strategies: st.SearchStrategy):
    """Registers a check of what the strategies give, under its function's name."""

    def register(check: Callable[..., None]) -> Callable[..., None]:
        PROPERTIES[check.__name__] = st.tuples(*strategies), lambda drawn: check(*drawn)
        return check

    return register


def floats(low: float = -1e6, high: float = 1e6) -> st.SearchStrategy[float]:
    """Finite numbers, with 0, the ends and numbers near 0 more often."""
    low, high = float(np.float32(low)), float(np.float32(high))
    special = [value for value in (0.0, low, high, 1e-30, 1e-7, -1e-7, 1.0) if low <= value <= high]
    return st.one_of(st.sampled_from(special), st.floats(low, high, width=32))


def arrays(
    *shape: int | st.SearchStrategy, low: float = -1e6, high: float = 1e6
) -> st.SearchStrategy[np.ndarray]:
    """float32 arrays."""
    sides = [side if isinstance(side, st.SearchStrategy) else st.just(side) for side in shape]
    return st.tuples(*sides).flatmap(lambda size: hnp.arrays(np.float32, size, elements=floats(low, high)))


def tensor(array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.array(array))


SCORES = arrays(st.integers(1, 300), low=0.0, high=1.0)
COUNT = st.integers(1, 12)
RIGHT = 1e-4


# The gate's threshold


@property_of(SCORES)
def a_histogram_counts_every_score(scores):
    assert histogram(scores).sum() == len(scores)


@property_of(hnp.arrays(np.int64, 256, elements=st.integers(0, 10**9)).filter(lambda counts: counts.any()))
def otsu_threshold_lies_within_the_range(counts):
    tau, separability, low = otsu_threshold(counts)
    assert 0 <= tau <= 1 and 0 <= separability <= 1 + 1e-9 and 0 <= low <= max(tau, 1e-12)


@property_of(SCORES)
def a_threshold_takes_no_more_than_it_may_and_never_everything(scores):
    found = evidence_threshold(scores)
    values = (found.tau, found.otsu, found.separability, found.low_mean, found.cut, found.lost)
    assert np.isfinite(values).all()
    assert (scores >= found.tau).any()
    if found.closed:
        assert found.lost <= LARGEST_LOSS


@property_of(SCORES, floats(0.0, 1.0))
def a_higher_threshold_loses_more(scores, tau):
    (cut, lost), (more_cut, more_lost) = share_below(scores, tau / 2), share_below(scores, tau)
    assert 0 <= cut <= more_cut <= 1 and 0 <= lost <= more_lost <= 1 + 1e-6


# Rotations


@property_of(arrays(COUNT, 3, low=-300.0, high=300.0))
def a_rotation_vector_is_a_rotation(vectors):
    matrices = roma.rotvec_to_rotmat(tensor(vectors))
    assert (matrices @ matrices.mT - torch.eye(3)).abs().max() < 1e-5
    assert torch.linalg.det(matrices).min() > 0.99


@property_of(arrays(COUNT, 3, low=-300.0, high=300.0))
def a_matrix_gives_its_vector_back(vectors):
    matrices = roma.rotvec_to_rotmat(tensor(vectors).double())
    again = roma.rotvec_to_rotmat(roma.rotmat_to_rotvec(matrices))
    assert (matrices - again).abs().max() < 1e-6


@property_of(arrays(COUNT, 3, 2, low=-1e9, high=1e9))
def six_numbers_are_a_rotation_with_a_finite_slope(columns):
    leaf = tensor(columns).requires_grad_()
    matrices = orthonormalised(leaf)
    away = matrices.detach() @ matrices.detach().mT - torch.eye(3)
    assert away.abs().max() < 5e-3 and torch.linalg.det(matrices.detach()).min() > 0.9
    (matrices * torch.arange(9.0).view(3, 3)).sum().backward()
    assert leaf.grad.isfinite().all()


@property_of(arrays(COUNT, 2, 3, low=-50.0, high=50.0))
def branches_keep_the_rotation(vectors):
    rotation = tensor(vectors)
    expected = roma.rotvec_to_rotmat(rotation.double())
    for found in (continuous(rotation), nearest_branch(rotation, rotation.roll(1, 0))):
        assert (roma.rotvec_to_rotmat(found.double()) - expected).abs().max() < 1e-3


@property_of(
    st.integers(1, 20).flatmap(
        lambda count: st.tuples(
            arrays(count, 3, low=-10.0, high=10.0),
            hnp.arrays(bool, count),
            st.lists(st.integers(1, 30), min_size=count, max_size=count),
        )
    ),
    st.sampled_from([3, 5, 9]),
)
def smoothing_any_motion_is_finite(motion, window):
    turns, valid, gaps = motion
    rotation = torch.zeros(len(turns), 55, 3)
    rotation[:, 0] = tensor(turns)
    frames = tuple(np.cumsum(gaps).tolist())
    transl = tensor(turns)
    poses = Poses(frames, rotation, torch.zeros(len(turns), 1), transl, torch.from_numpy(valid))
    found = smooth(poses, window)
    assert found.rotation.isfinite().all() and found.transl.isfinite().all()


# Body and meshes


@property_of(
    arrays(8, 4, low=0.0, high=1.0), arrays(8, 3, low=-1e3, high=1e3), arrays(4, 3, low=-50.0, high=50.0)
)
def skinning_stays_among_where_the_joints_put_a_point(weights, points, turns):
    share = tensor(weights) + 1e-6
    share = share / share.sum(1, keepdim=True)
    transforms = torch.cat([roma.rotvec_to_rotmat(tensor(turns)), tensor(turns)[..., None]], -1)
    found = linear_blend_skinning(transforms[None], share, tensor(points))[0]
    each = torch.einsum("jab,nb->nja", transforms[..., :3], tensor(points)) + transforms[..., 3]
    slack = 1e-4 * (1 + each.abs().max())
    assert ((found >= each.amin(1) - slack) & (found <= each.amax(1) + slack)).all()


@property_of(arrays(5, 3, low=-1e3, high=1e3))
def normals_are_of_length_one_or_short_and_have_finite_slopes(vertices):
    leaf = tensor(vertices).requires_grad_()
    normals = vertex_normals(leaf, torch.tensor([[0, 1, 2], [0, 2, 3], [1, 1, 4]]))
    assert normals.norm(dim=1).max() < 1 + 1e-4
    normals.sum().backward()
    assert leaf.grad.isfinite().all()


@property_of(hnp.arrays(np.int64, (6, 3), elements=st.integers(0, 7)))
def a_laplacian_of_equal_values_is_zero(faces):
    matrix = uniform_laplacian(torch.from_numpy(faces), 8).to_dense()
    assert matrix.isfinite().all() and matrix.sum(1).abs().max() < 1e-5


# Cameras and rendering


@property_of(arrays(6, 3, low=-1e12, high=1e12), floats(2.0**-10, 1e6))
def projecting_any_point_is_finite(points, focal):
    leaf = tensor(points).requires_grad_()
    pixels = project(facing_camera(64, 48, max(focal, 2.0**-10)), leaf)
    assert pixels.isfinite().all()
    pixels.sum().backward()
    assert leaf.grad.isfinite().all()


@property_of(
    arrays(6, 3, low=-5.0, high=5.0),
    arrays(6, 4, low=-1e6, high=1e6),
    arrays(6, 3, low=-1e3, high=1e3),
    arrays(6, 4, low=-2.0, high=3.0),
    st.sampled_from([(1, 1), (16, 16), (17, 5), (40, 24)]),
)
def rendering_anything_is_finite_with_finite_slopes(means, quaternions, scales, rest, size):
    leaves = [tensor(one).requires_grad_() for one in (means, quaternions, scales, rest)]
    gaussians = Gaussians(*leaves[:3], leaves[3][:, :3], leaves[3][:, 3])
    rendering = render(gaussians, facing_camera(*size, 40.0))
    images = (rendering.color, rendering.alpha, rendering.depth)
    assert all(image.isfinite().all() for image in images) and rendering.alpha.max() <= 1 + 1e-5
    sum(image.sum() for image in images).backward()
    assert all(leaf.grad.isfinite().all() for leaf in leaves)


# Metrics and losses

IMAGE = st.integers(11, 14).flatmap(
    lambda side: st.tuples(arrays(side, 12, 3, low=0.0, high=1.0), arrays(side, 12, 3, low=0.0, high=1.0))
)


@property_of(IMAGE)
def scores_are_symmetric_and_bounded(pair):
    image, truth = map(tensor, pair)
    assert psnr(image, truth) == psnr(truth, image) >= 0
    assert abs(ssim(image, truth) - ssim(truth, image)) < 1e-9 and -1 <= ssim(image, truth) <= 1 + 1e-9
    assert abs(ssim(image, image) - 1) < 1e-9


@property_of(IMAGE)
def image_losses_are_finite_with_finite_slopes(pair):
    image, truth = map(tensor, pair)
    leaf = image.requires_grad_()
    fused, plain = ssim_loss(leaf, truth), plain_ssim_loss(leaf, truth)
    assert abs(float((fused - plain).detach())) < 2e-3
    (losses.l1(leaf, truth).mean() + fused + plain).backward()
    assert leaf.grad.isfinite().all()


@property_of(arrays(9, 7, low=0.0, high=1.0), st.integers(0, 40), st.floats(0, 1, exclude_max=True))
def a_crop_lies_in_the_picture(alpha, side, share):
    rows, columns = losses.person_crop(tensor(alpha), side, share)
    assert 0 <= rows.start < rows.stop <= 9 and 0 <= columns.start < columns.stop <= 7


@property_of(arrays(6, 3, low=-1e3, high=1e3), arrays(6, 3, low=-30.0, high=30.0))
def regularisers_are_not_negative_and_have_finite_slopes(offset, log_scale):
    leaf, scale = tensor(offset).requires_grad_(), tensor(log_scale).requires_grad_()
    normals = torch.nn.functional.normalize(torch.ones(6, 3), dim=1)
    values = [
        losses.l2(leaf),
        losses.scale_growth(scale),
        losses.outward_offset(leaf, normals),
        losses.color_variance(leaf),
    ]
    assert all(value.isfinite().all() and (value >= 0).all() for value in values)
    sum(value.mean() for value in values).backward()
    assert leaf.grad.isfinite().all() and scale.grad.isfinite().all()


@property_of(hnp.arrays(np.uint8, (8, 6, 3)), hnp.arrays(np.uint8, (8, 6)), st.integers(0, 9))
def a_composite_and_its_interior_lie_in_the_picture(frame, mask, erosion):
    for background in ("black", "white"):
        image = composite_frame(frame, mask, background)
        assert image.min() >= 0 and image.max() <= 1 + 1e-6
    assert not (interior(mask, erosion).numpy() & (mask <= 127)).any()


# The fit's terms


@property_of(arrays(2, 4, 2), arrays(2, 4, 2), hnp.arrays(bool, (2, 4)), floats(2.0**-10, 1e4))
def a_keypoint_s_error_saturates_and_has_a_finite_slope(points, target, mask, saturation):
    leaf = tensor(points).requires_grad_()
    loss = terms.keypoint_loss(leaf, tensor(target), torch.from_numpy(mask), torch.full((4,), saturation))
    assert (loss >= 0).all() and (loss <= saturation * (1 + 1e-5)).all()
    loss.sum().backward()
    assert leaf.grad.isfinite().all() and not leaf.grad[~torch.from_numpy(mask)].any()


@property_of(arrays(2, 4, 3, low=-1e3, high=1e3), arrays(2, 4, 3, low=-1e3, high=1e3))
def a_bone_s_direction_has_a_finite_slope(start, end):
    unit = torch.nn.functional.normalize(torch.ones(2, 4, 3), dim=-1)
    leaf = tensor(start).requires_grad_()
    loss = terms.direction_loss(leaf, tensor(end), unit)
    assert (loss >= -1e-5).all() and (loss <= 2 + 1e-5).all()
    loss.sum().backward()
    assert leaf.grad.isfinite().all()


@property_of(st.lists(st.integers(1, 100), min_size=1, max_size=40), floats(0.0, 6.0), st.integers(1, 50))
def windows_and_bumps_cover_a_clip_once(gaps, width, size):
    times = torch.tensor(np.cumsum(gaps), dtype=torch.float32)
    own = [row for window in windows(len(times), size) for row in range(window.begin, window.end)]
    assert own == list(range(len(times)))
    weight = bumps(times, width if width > 1e-3 else 0.0)[0]
    assert weight.isfinite().all() and (weight.sum(1) - 1).abs().max() < 1e-5


@property_of(arrays(COUNT, 3, 3, low=-100.0, high=200.0), floats(0.0, 1.0))
def what_is_visible_lies_in_the_picture(points, threshold):
    points[0, 0] = math.nan
    seen = visible(points, threshold, np.full((len(points), 2), 64.0))
    assert not seen[0, 0]
    kept = points[seen]
    assert ((kept[:, :2] > 0) & (kept[:, :2] < 64)).all() and (kept[:, 2] >= threshold).all()


@property_of(st.integers(1, 40).flatmap(lambda count: hnp.arrays(bool, (count, 4))))
def guesses_are_only_taken_away(mask):
    after = mask.copy()
    drop_guesses(after, (0, 1), (2, 3))
    assert not (after & ~mask).any() and (after[:, 2:] == mask[:, 2:]).all()


@property_of(
    st.integers(0, 12).flatmap(
        lambda count: st.tuples(
            arrays(count, 4, 3, low=-1e4, high=1e4),
            arrays(count, 4, 3, low=-1e4, high=1e4),
            st.lists(st.integers(1, 5), min_size=count, max_size=count),
        )
    )
)
def outlier_frames_are_never_most_of_a_clip(clip):
    left, right, gaps = clip
    frames = np.cumsum(gaps).astype(np.int64)
    rows = left_right_swapped(frames, left, right)
    assert len(rows) <= len(frames) / 2 and (np.diff(rows) > 0).all()
    assert set(isolated_outliers(frames, left, right)) <= set(range(1, max(1, len(frames) - 1)))


# Masks, splits and draws


@property_of(arrays(12, 10, low=0.0, high=1.0), arrays(12, 10, low=0.0, high=1.0), floats(0.0, 1.0))
def masks_stay_shares(body, selfie, share):
    fused = fuse(body, selfie, share)
    for mask in (fused, main_component(fused, np.array([[3.0, 4.0], [-5.0, 99.0]])), fill_holes(fused)):
        assert np.isfinite(mask).all() and mask.min() >= 0 and mask.max() <= 1 + 1e-6


@property_of(st.integers(2, 500), floats(0.0, 0.375))
def a_split_is_the_clip(count, fraction):
    split = split_frames(range(count), fraction, 0)
    assert (*split.train, *split.test) == tuple(range(count)) and split.train


@property_of(
    st.integers(0, 2**31), st.integers(1, 9), st.integers(0, 4), st.integers(1, 6), st.integers(0, 200)
)
def every_draw_is_one_of_the_frames(seed, captured, generated, every, position):
    first, second = tuple(range(captured)), tuple(range(100, 100 + generated))
    assert schedule.drawn_of_two(seed, first, second, every, position) in (*first, *second)
    assert 0 <= schedule.drawn_share(seed, schedule.TIME, position) < 1
    assert schedule.drawn_noise(seed, position, 8).isfinite().all()


@property_of(hnp.arrays(np.float32, 20, elements=st.floats(width=32)))
def the_guard_sees_what_is_not_finite(values):
    every = bool(np.isfinite(values).all())
    assert not finite([tensor(values)]) or every
