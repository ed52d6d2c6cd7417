"""The gsplat backend, with a stand-in for gsplat: no test machine has a GPU."""

import inspect
import shutil
import sys
import types

import pytest
import torch

from pipeline.clip.camera import Camera
from pipeline.errors import UserError
from pipeline.splat import Gaussians
from pipeline.splat.dense import alphas, blending_weights, project_gaussians, render_dense
from pipeline.splat.gsplat_backend import render_gsplat
from tests.made.splat_scene import images, leaves, scene


def rasterization(
    means, quats, scales, opacities, colors, viewmats, Ks, width, height, near_plane, far_plane, eps2d,
    render_mode, packed,
):  # fmt: skip
    """What gsplat.rasterization does with these arguments, without its tolerance of NaN."""
    assert (near_plane, far_plane, eps2d, render_mode) == (0.01, 1e10, 0.3, "RGB+D")
    assert all(tensor.isfinite().all() for tensor in (means, quats, scales, opacities, colors))
    camera = Camera(width, height, Ks[0], viewmats[0, :3, :3], viewmats[0, :3, 3])
    order = torch.argsort((means @ camera.rotation.mT + camera.translation)[:, 2])
    drawn = Gaussians(means, quats, scales, colors[:, :3], opacities).select(order)
    projected = project_gaussians(drawn, camera)
    weights = blending_weights(alphas(projected, drawn.opacities, camera))
    channels = torch.cat([colors[order], projected.depths[:, None]], 1)
    image = torch.einsum("nhw,nc->hwc", weights, channels)
    return image[None], weights.sum(0)[None, ..., None], {}


@pytest.fixture
def gsplat(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", types.SimpleNamespace(rasterization=rasterization))


def test_it_renders_what_the_dense_twin_renders(gsplat):
    gaussians, camera = scene(30, 24, 20, torch.float32)
    gaussians.means[3] = float("nan")
    gaussians.colors[5, 1] = float("inf")
    results = []
    for backend in (render_gsplat, render_dense):
        moved, moved_camera, tensors = leaves(gaussians, camera)
        rendering = backend(moved, moved_camera)
        sum(image.square().sum() for image in images(rendering)).backward()
        assert not rendering.weights.requires_grad
        results.append([*images(rendering), rendering.weights, *(tensor.grad for tensor in tensors)])
    for ours, twin in zip(*results, strict=True):
        assert torch.allclose(ours, twin, rtol=1e-4, atol=1e-5)
        assert ours.isfinite().all()


def test_no_graph_is_kept_where_none_is_wanted(gsplat):
    with torch.no_grad():
        rendering = render_gsplat(*scene(5, 8, 8, torch.float32))
    assert rendering.weights.sum() > 0
    assert not any(image.requires_grad for image in images(rendering))


def test_nothing_usable_is_an_empty_image(gsplat):
    gaussians, camera = scene(5, 8, 8, torch.float32)
    rendering = render_gsplat(Gaussians(gaussians.means - 100, *gaussians.tensors()[1:]), camera)
    assert not rendering.alpha.any() and rendering.weights.shape == (5,)


def test_without_gsplat_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(UserError, match="gsplat"):
        render_gsplat(*scene(5, 8, 8, torch.float32))


@pytest.mark.parametrize(
    "error",
    [
        AttributeError("'NoneType' object has no attribute 'projection'"),
        ImportError("gsplat_cuda.so: cannot open shared object file"),
        RuntimeError("Ninja is required to load C++ extensions"),
    ],
)
def test_a_build_that_failed_names_the_tools_that_are_missing(monkeypatch, error):
    def fails(**_):
        raise error

    monkeypatch.setitem(sys.modules, "gsplat", types.SimpleNamespace(rasterization=fails))
    monkeypatch.setattr(shutil, "which", lambda name: "/usr/bin/g++" if name == "g++" else None)
    with pytest.raises(UserError, match="this machine lacks nvcc, ninja"):
        render_gsplat(*scene(5, 8, 8, torch.float32))


def test_another_error_of_gsplat_is_not_taken_for_a_build_that_failed(monkeypatch):
    def fails(**_):
        raise RuntimeError("CUDA out of memory")

    monkeypatch.setitem(sys.modules, "gsplat", types.SimpleNamespace(rasterization=fails))
    with pytest.raises(RuntimeError, match="out of memory"):
        render_gsplat(*scene(5, 8, 8, torch.float32))


def test_the_stand_in_takes_what_gsplat_takes():
    theirs = inspect.signature(pytest.importorskip("gsplat").rasterization).parameters
    assert set(inspect.signature(rasterization).parameters) <= set(theirs)
