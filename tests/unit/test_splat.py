"""The numba rasterizer against its dense twin, against finite differences and against pencil and paper."""

import math
import subprocess
import sys

import pytest
import torch

from pipeline.clip.camera import Camera, facing_camera, project
from pipeline.splat import Gaussians, picture_sums, render
from pipeline.splat.render import plain_picture_sums
from tests.made.splat_scene import NAMES, draw, images, leaves, scene


def relative_error(value, reference):
    return float((value - reference).detach().abs().max() / reference.detach().abs().max())


def single(mean, scale, opacity, color=(0.2, 0.5, 0.9)):
    """One round Gaussian."""
    rows = [[mean], [[1.0, 0, 0, 0]], [[scale] * 3], [color], [opacity]]
    return Gaussians(*(torch.tensor(row, dtype=torch.float64) for row in rows))


@pytest.mark.parametrize("backend", ["numba", "dense"])
def test_one_gaussian_is_the_bell_that_it_projects_to(backend):
    camera = facing_camera(15, 15, focal=20.0).to(torch.float64)
    rendering = render(single((0.0, 0.0, -2.0), 0.1, 0.8), camera, backend)
    variance = (20.0 * 0.1 / 2.0) ** 2 + 0.3
    centres = torch.arange(15, dtype=torch.float64) + 0.5 - 7.5
    bell = 0.8 * torch.exp(-(centres[:, None] ** 2 + centres**2) / (2 * variance))
    bell = torch.where(bell >= 1 / 255, bell, 0.0)
    assert torch.allclose(rendering.alpha, bell, atol=1e-12)
    assert torch.allclose(rendering.depth, 2.0 * bell, atol=1e-12)
    assert torch.allclose(
        rendering.color, bell[..., None] * torch.tensor([0.2, 0.5, 0.9]).double(), atol=1e-7
    )
    assert rendering.weights.item() == pytest.approx(bell.sum().item())


@pytest.mark.parametrize("backend", ["numba", "dense"])
def test_the_nearer_gaussian_covers_the_farther_one(backend):
    near, far = single((0.0, 0.0, -2.0), 5.0, 0.75, (1, 0, 0)), single((0.0, 0.0, -4.0), 10.0, 0.5, (0, 1, 0))
    both = Gaussians(*(torch.cat(pair) for pair in zip(far.tensors(), near.tensors(), strict=True)))
    rendering = render(both, facing_camera(1, 1, focal=1.0).to(torch.float64), backend)
    assert rendering.color[0, 0].tolist() == pytest.approx([0.75, 0.25 * 0.5, 0], abs=1e-3)
    assert rendering.alpha.item() == pytest.approx(1 - 0.25 * 0.5, abs=1e-3)
    assert rendering.depth.item() == pytest.approx(0.75 * 2 + 0.125 * 4, abs=1e-2)
    assert rendering.weights.tolist() == pytest.approx([0.125, 0.75], abs=1e-3)


@pytest.mark.parametrize("backend", ["numba", "dense"])
def test_a_gaussian_appears_where_the_camera_projects_its_mean(backend):
    _, camera = scene(1, 60, 40)
    mean = torch.tensor([[0.31, -0.17, 0.2]], dtype=torch.float64)
    alpha = render(single(mean[0].tolist(), 1e-3, 0.9), camera, backend).alpha
    x, y = torch.arange(60).double() + 0.5, torch.arange(40).double() + 0.5
    centroid = torch.stack([(alpha.sum(0) * x).sum(), (alpha.sum(1) * y).sum()]) / alpha.sum()
    assert torch.allclose(centroid, project(camera, mean)[0], atol=0.1)


@pytest.fixture
def one_thread():
    """Thousands of tiny renderings: a second this way, a minute with two threads on a busy machine."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


# One tile, and two.
@pytest.mark.parametrize(
    ("count", "width", "height", "size", "seed"), [(6, 7, 5, 0.3, 0), (4, 18, 3, 0.5, 3)]
)
def test_gradients_are_finite_differences(count, width, height, size, seed, one_thread):
    gaussians, camera, tensors = leaves(*scene(count, width, height, seed=seed, size=size))
    assert (render(gaussians, camera).weights > 0).all()

    def function(*inputs):
        moved = Camera(width, height, camera.intrinsics, *inputs[5:])
        return images(render(Gaussians(*inputs[:5]), moved, "numba"))

    assert torch.autograd.gradcheck(function, tuple(tensors), eps=1e-7, atol=1e-5, rtol=1e-4, nondet_tol=0.0)


# Not multiples of the tile, one pixel, much overlap, many Gaussians that are beyond the image's edge.
SCENES = [
    (40, 33, 19, 0.05, 2),
    (50, 32, 32, 0.3, 1),
    (30, 1, 1, 0.3, 4),
    (300, 70, 45, 0.2, 5),
    (1, 16, 16, 0.2, 6),
]


@pytest.mark.parametrize(("count", "width", "height", "size", "seed"), SCENES)
def test_double_precision_equals_the_dense_twin(count, width, height, size, seed):
    ours, gradients = draw(*scene(count, width, height, seed=seed, size=size), "numba")
    twin, expected = draw(*scene(count, width, height, seed=seed, size=size), "dense")
    for image, reference in zip([*images(ours), ours.weights], [*images(twin), twin.weights], strict=True):
        assert torch.allclose(image, reference, rtol=1e-10, atol=1e-12)
    for name in NAMES:
        assert relative_error(gradients[name], expected[name]) < 1e-10, name


@pytest.mark.parametrize(("count", "width", "height", "size", "seed"), SCENES)
def test_single_precision_is_near_double(count, width, height, size, seed):
    ours, gradients = draw(*scene(count, width, height, torch.float32, seed, size), "numba")
    exact, expected = draw(*scene(count, width, height, torch.float64, seed, size), "dense")
    for image, reference in zip(images(ours), images(exact), strict=True):
        assert image.dtype == torch.float32
        assert torch.allclose(image.double(), reference, atol=2e-5)
    for name in NAMES:
        assert relative_error(gradients[name].double(), expected[name]) < 1e-3, name


@pytest.mark.parametrize("backend", ["numba", "dense"])
def test_no_gaussians_is_an_empty_image(backend):
    rendering, gradients = draw(*scene(0, 20, 10), backend)
    assert all(not image.any() for image in images(rendering))
    assert rendering.color.shape == (10, 20, 3) and rendering.weights.shape == (0,)
    assert gradients["means"].shape == (0, 3) and not gradients["rotation"].any()


def test_occluded_gaussians_weigh_nothing_and_have_no_gradient():
    gaussians, camera = scene(400, 40, 40, torch.float32, seed=7, size=0.8)
    gaussians = Gaussians(*gaussians.tensors()[:4], torch.full((400,), 0.99))
    rendering, gradients = draw(gaussians, camera, "numba")
    hidden = rendering.weights == 0
    assert 10 < hidden.sum() < 390
    for name in NAMES[:5]:
        assert not gradients[name][hidden].any(), name
        assert gradients[name][~hidden].any(), name
    alone = render(gaussians.select(~hidden), camera)
    assert torch.equal(alone.color, rendering.color)


def test_weights_sum_to_alpha():
    rendering, _ = draw(*scene(100, 50, 50, seed=8), "numba")
    assert rendering.weights.sum().item() == pytest.approx(rendering.alpha.sum().item())
    assert not rendering.weights.requires_grad


@pytest.mark.parametrize(("count", "width", "height", "size", "seed"), SCENES)
def test_sums_over_a_picture_are_the_derivatives_of_the_rendering(count, width, height, size, seed):
    gaussians, camera = scene(count, width, height, size=size, seed=seed)
    picture = torch.rand(height, width, 4, generator=torch.Generator().manual_seed(1)).double()
    sums, weights = picture_sums(gaussians, camera, picture)
    plain, plain_weights = plain_picture_sums(gaussians, camera, picture)
    assert torch.equal(weights, plain_weights) and (sums - plain).abs().max() <= 1e-12 * plain.abs().max()
    single, _ = picture_sums(gaussians.to(torch.float32), camera, picture.float())
    assert (single - plain).abs().max() <= 1e-4 * plain.abs().max()


def test_one_and_two_threads_agree_to_the_bit():
    # Many Gaussians in few tiles, so that every tile's list is long and each Gaussian is in several.
    gaussians, camera = scene(3000, 90, 50, torch.float32, seed=9, size=0.1)
    threads = torch.get_num_threads()
    results = []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            rendering, gradients = draw(gaussians, camera, "numba")
            results.append([*images(rendering), rendering.weights, *gradients.values()])
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(one, two) for one, two in zip(*results, strict=True))


def test_colors_alone_may_be_trained_on_one_output_alone():
    gaussians, camera = scene(20, 30, 20, torch.float32)
    colors = gaussians.colors.clone().requires_grad_()
    means, quaternions, scales, _, opacities = gaussians.tensors()
    render(Gaussians(means, quaternions, scales, colors, opacities), camera).color.sum().backward()
    # The image is linear in the colours, with the weights as factors.
    expected = render(gaussians, camera).weights[:, None].expand(-1, 3)
    assert torch.allclose(colors.grad, expected, rtol=1e-5, atol=1e-6)


def test_half_precision_and_strided_tensors_are_taken():
    gaussians, camera = scene(20, 30, 20, torch.float32)
    strided = Gaussians(*(torch.stack([tensor, tensor], -1)[..., 0] for tensor in gaussians.tensors()))
    assert torch.equal(render(strided, camera).color, render(gaussians, camera).color)
    coarse = render(gaussians.to(torch.bfloat16), camera)
    assert coarse.color.dtype == torch.float32
    assert torch.allclose(coarse.alpha, render(gaussians, camera).alpha, atol=0.1)


def test_changing_the_image_in_place_before_the_backward_pass_is_refused():
    gaussians, camera, _ = leaves(*scene(5, 20, 20))
    rendering = render(gaussians, camera)
    rendering.color.detach().mul_(2)
    with pytest.raises(RuntimeError, match="inplace"):
        rendering.color.sum().backward()


def test_what_cannot_be_rendered_is_refused():
    gaussians, camera = scene(3, 8, 8)
    with pytest.raises(ValueError, match="backend"):
        render(gaussians, camera, "vulkan")
    with pytest.raises(ValueError, match="cpu"):
        render(gaussians, camera, "gsplat")
    with pytest.raises(ValueError, match="0 x 8"):
        render(gaussians, Camera(0, 8, camera.intrinsics, camera.rotation, camera.translation))
    with pytest.raises(ValueError, match="opacities"):
        Gaussians(*gaussians.tensors()[:4], gaussians.opacities[:2])


def test_kernels_are_compiled_once_for_all_processes():
    gaussians, camera = scene(3, 8, 8, torch.float32)
    draw(gaussians, camera, "numba")  # compiles, or finds what an earlier process compiled
    program = (
        "import torch\n"
        "from tests.made.splat_scene import draw, scene\n"
        "from pipeline.splat import blending, projection, tiles\n"
        "draw(*scene(3, 8, 8, torch.float32), 'numba')\n"
        "kernels = (blending.blend_forward, blending.blend_backward, blending.sum_weights,\n"
        "           projection.project_forward,\n"
        "           projection.project_backward, tiles.bin_gaussians)\n"
        "print(*(sum(kernel.stats.cache_misses.values()) for kernel in kernels))\n"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert run.stdout.split() == ["0"] * 6


def test_a_wide_field_of_view_clamps_the_jacobian_alike():
    gaussians, camera = scene(30, 24, 24, seed=11, size=0.4)
    near = Camera(
        24, 24, camera.intrinsics, camera.rotation, camera.translation - torch.tensor([0.0, 0.0, 2.2])
    )
    ours, gradients = draw(gaussians, near, "numba")
    twin, expected = draw(gaussians, near, "dense")
    points = gaussians.means @ near.rotation.mT + near.translation
    beyond = (points[:, :2] / points[:, 2:]).abs().max(1).values > 1.3 * 12 / (1.25 * 24) + 0.1
    assert (beyond & (ours.weights > 0)).any(), "the scene must draw a Gaussian where the clamp acts"
    assert torch.allclose(ours.color, twin.color, atol=1e-12)
    for name in NAMES:
        assert relative_error(gradients[name], expected[name]) < 1e-10, name


def test_the_scene_reaches_beyond_the_image():
    gaussians, camera = scene(300, 70, 45, seed=5, size=0.2)
    pixels = project(camera, gaussians.means)
    outside = (pixels < 0).any(1) | (pixels > torch.tensor([70, 45])).any(1)
    assert 30 < outside.sum() < 270 and math.isfinite(pixels.sum())
