"""Degenerate Gaussians: nothing that is not finite comes out, and the healthy ones do not notice.

Every case is a change to a healthy scene, or another scene, rendered in single precision.
"""

import math
import sys
import types

import pytest
import torch

from pipeline.clip.camera import Camera
from pipeline.splat import Gaussians, render
from pipeline.splat.gsplat_backend import render_gsplat
from tests.made.splat_scene import NAMES, draw, images, leaves, scene
from tests.unit.test_splat_gsplat import rasterization

COUNT = 20
BACKENDS = ["numba", "dense"]


def healthy():
    return scene(COUNT, 40, 24, torch.float32)


def spoilt(name, value, index=0):
    """The healthy scene with one number, or row, of Gaussian ``index`` replaced."""
    gaussians, camera = healthy()
    getattr(gaussians, name)[index] = torch.as_tensor(value)
    return gaussians, camera


def in_camera(point):
    """The world coordinates of a point that is given in the camera's."""
    _, camera = healthy()
    return camera.rotation.mT @ (torch.tensor(point) - camera.translation)


def first(value, size):
    """A row whose first number is ``value``."""
    return [value, *[0.1] * (size - 1)]


# Gaussian 0 cannot be drawn.
UNUSABLE = {
    "behind the camera": ("means", in_camera([0.0, 0.0, -2.0])),
    "in the camera's plane": ("means", in_camera([0.1, 0.0, 0.0])),
    "nearer than the near plane": ("means", in_camera([0.0, 0.0, 0.0099])),
    "far beside the image": ("means", in_camera([1e4, 0.0, 3.0])),
    "at the end of the numbers": ("means", [1e38, -1e38, 3e38]),
    "scale 1e18": ("scales", first(1e18, 3)),
    "scale inf": ("scales", first(math.inf, 3)),
    "zero quaternion": ("quaternions", [0.0] * 4),
    "tiny quaternion": ("quaternions", [1e-15, 0.0, 0.0, 0.0]),
    "huge quaternion": ("quaternions", [1e20, 1e20, 0.0, 0.0]),
    "opacity 0": ("opacities", 0.0),
    "opacity -1": ("opacities", -1.0),
    **{
        f"{value} in {name}": (name, first(value, size) if size else value)
        for value in (math.nan, math.inf, -math.inf)
        for name, size in (("means", 3), ("quaternions", 4), ("scales", 3), ("colors", 3), ("opacities", 0))
    },
}

# Gaussian 0 is drawn all the same.
EXTREME = {
    "just behind the near plane": ("means", in_camera([0.001, 0.0, 0.0101])),
    "near and beside the image": ("means", in_camera([0.02, 0.01, 0.02])),
    "scale 1e3": ("scales", first(1e3, 3)),
    "no extent": ("scales", [0.0] * 3),
    "needle": ("scales", [2.0, 1e-9, 1e-9]),
    "quaternion of length 1e10": ("quaternions", [1e10, 0.0, 1e9, 0.0]),
    "negative scale": ("scales", [-0.1, 0.1, 0.1]),
    "opacity 1": ("opacities", 1.0),
    "opacity 2": ("opacities", 2.0),
    "opacity just visible": ("opacities", 1.001 / 255),
}


def assert_finite(rendering, gradients):
    assert all(image.isfinite().all() for image in [*images(rendering), rendering.weights])
    for name, gradient in gradients.items():
        assert gradient.isfinite().all(), name


def assert_same(ours, twin):
    """Renderings and gradients of the two backends, to single precision."""
    for image, reference in zip(images(ours[0]), images(twin[0]), strict=True):
        assert torch.allclose(image, reference, rtol=1e-4, atol=1e-4)
    for name in NAMES:
        largest = twin[1][name].abs().max()
        assert ((ours[1][name] - twin[1][name]).abs() <= 1e-2 * largest + 1e-5).all(), name


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("case", UNUSABLE)
def test_an_unusable_gaussian_is_left_out(case, backend):
    gaussians, camera = spoilt(*UNUSABLE[case])
    rendering, gradients = draw(gaussians, camera, backend)
    assert_finite(rendering, gradients)
    assert rendering.weights[0] == 0
    without, expected = draw(gaussians.select(torch.arange(1, COUNT)), camera, backend)
    for image, reference in zip(images(rendering), images(without), strict=True):
        assert torch.equal(image, reference)
    assert torch.equal(rendering.weights[1:], without.weights)
    for name in NAMES[:5]:
        assert not gradients[name][0].any(), name
        assert torch.allclose(gradients[name][1:], expected[name], rtol=1e-5, atol=1e-6), name
    for name in NAMES[5:]:
        assert torch.allclose(gradients[name], expected[name], rtol=1e-4, atol=1e-4), name


@pytest.mark.parametrize("case", EXTREME)
def test_an_extreme_gaussian_is_drawn_as_the_dense_twin_draws_it(case):
    gaussians, camera = spoilt(*EXTREME[case])
    ours, twin = draw(gaussians, camera, "numba"), draw(gaussians, camera, "dense")
    assert_finite(*ours)
    assert_finite(*twin)
    assert_same(ours, twin)
    assert (ours[0].weights > 0).equal(twin[0].weights > 0)


def test_all_gaussians_unusable_is_an_empty_image():
    gaussians, camera = healthy()
    for tensor in gaussians.tensors():
        tensor[:] = math.nan
    for backend in BACKENDS:
        rendering, gradients = draw(gaussians, camera, backend)
        assert not rendering.alpha.any() and not rendering.weights.any()
        assert all(not gradient.any() for gradient in gradients.values())


def test_gaussians_in_one_place_are_drawn_in_order_of_index():
    gaussians, camera = healthy()
    gaussians.means[:] = gaussians.means[:1].clone()
    assert_same(draw(gaussians, camera, "numba"), draw(gaussians, camera, "dense"))
    nearest_first = render(gaussians, camera).weights[0] / gaussians.scales[0].prod()
    assert nearest_first > 0


def test_thousands_in_one_tile():
    generator = torch.Generator().manual_seed(1)
    _, camera = healthy()
    gaussians = Gaussians(
        torch.randn(3000, 3, generator=generator) * 0.02,
        torch.randn(3000, 4, generator=generator),
        torch.rand(3000, 3, generator=generator) * 0.02 + 0.005,
        torch.rand(3000, 3, generator=generator),
        torch.rand(3000, generator=generator) * 0.9 + 0.1,
    )
    ours, twin = draw(gaussians, camera, "numba"), draw(gaussians, camera, "dense")
    assert_finite(*ours)
    assert_same(ours, twin)


def test_opaque_gaussians_do_not_exhaust_the_transmittance():
    generator = torch.Generator().manual_seed(1)
    _, camera = healthy()
    gaussians = Gaussians(
        torch.randn(400, 3, generator=generator) * 0.05,
        torch.randn(400, 4, generator=generator),
        torch.full((400, 3), 0.3),
        torch.rand(400, 3, generator=generator),
        torch.full((400,), 0.9995),
    )
    ours, twin = draw(gaussians, camera, "numba"), draw(gaussians, camera, "dense")
    assert_finite(*ours)
    assert_same(ours, twin)
    assert ours[0].alpha.max() <= 1


@pytest.mark.parametrize(("width", "height"), [(1, 1), (37, 19), (16, 16), (17, 15), (3, 500)])
def test_any_size_of_image(width, height):
    gaussians, camera = healthy()
    camera = Camera(width, height, camera.intrinsics, camera.rotation, camera.translation)
    ours, twin = draw(gaussians, camera, "numba"), draw(gaussians, camera, "dense")
    assert ours[0].color.shape == (height, width, 3)
    assert_finite(*ours)
    assert_same(ours, twin)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_camera_that_is_not_finite_shows_nothing(backend):
    gaussians, camera = healthy()
    broken = Camera(40, 24, camera.intrinsics, camera.rotation * math.nan, camera.translation)
    assert not render(gaussians, broken, backend).color.any()


# Sums that overflow, and what gsplat must never be given


@pytest.mark.parametrize("value", [1e3, 1e30, -1e30, 3e38])
def test_colours_beyond_their_range_are_drawn_or_left_out_finite(value):
    gaussians, camera = spoilt("colors", first(value, 3))
    rendering = render(gaussians, camera)
    assert rendering.color.isfinite().all() and rendering.alpha.isfinite().all()


@pytest.mark.parametrize("size", [0.0, 1e-30, 1e-9, 1.0, 1e3, 1e9, 1e18])
@pytest.mark.parametrize("axes", [1, 3], ids=["one axis", "all axes"])
def test_scales_from_nothing_to_1e18(size, axes):
    gaussians, camera = spoilt("scales", [size] * axes + [0.1] * (3 - axes))
    for backend in BACKENDS:
        assert_finite(*draw(gaussians, camera, backend))


@pytest.mark.parametrize("depth", [-1.0, 0.0, 1e-30, 0.00999, 0.01, 0.0100001, 0.02, 1e3, 1e9, 1e11])
def test_depths_from_behind_the_camera_to_beyond_the_far_plane(depth):
    gaussians, camera = spoilt("means", in_camera([1e-4, 0.0, depth]))
    for backend in BACKENDS:
        assert_finite(*draw(gaussians, camera, backend))


@pytest.mark.parametrize("length", [0.0, 1e-30, 1e-15, 1e-11, 1.0, 1e10, 1e13, 1e19, 3e38])
def test_quaternions_of_any_length(length):
    gaussians, camera = healthy()
    gaussians.quaternions[0] *= length / gaussians.quaternions[0].norm()
    for backend in BACKENDS:
        assert_finite(*draw(gaussians, camera, backend))


@pytest.mark.parametrize("count", [0, 1])
@pytest.mark.parametrize("size", [(1, 1), (16, 16), (17, 33)])
def test_none_and_one_in_small_images(count, size):
    gaussians, camera = healthy()
    gaussians = gaussians.select(torch.arange(count))
    camera = Camera(*size, camera.intrinsics, camera.rotation, camera.translation)
    for backend in BACKENDS:
        assert_finite(*draw(gaussians, camera, backend))


@pytest.mark.parametrize("case", UNUSABLE)
def test_what_gsplat_fails_on_never_reaches_it(case, monkeypatch):
    """gsplat lets NaN through its projection and draws it: a stand-in refuses to be given any."""
    monkeypatch.setitem(sys.modules, "gsplat", types.SimpleNamespace(rasterization=rasterization))
    gaussians, camera = spoilt(*UNUSABLE[case])
    moved, moved_camera, tensors = leaves(gaussians, camera)
    rendering = render_gsplat(moved, moved_camera)
    sum(image.square().sum() for image in images(rendering)).backward()
    assert all(image.isfinite().all() for image in images(rendering)) and rendering.weights[0] == 0
    assert all(tensor.grad.isfinite().all() for tensor in tensors)
    assert not tensors[0].grad[0].any()
