"""The GPU rasterizer: gsplat 1.5.3."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from pipeline.clip.camera import Camera
from pipeline.errors import UserError
from pipeline.splat import image_formation as constants
from pipeline.splat.dense import usable
from pipeline.splat.gaussians import Gaussians, Rendering

BUILD_TOOLS = {"nvcc": ("nvcc",), "a C++ compiler": ("c++", "g++", "clang++", "cl"), "ninja": ("ninja",)}
# What a build that failed leaves behind, or torch says of it; gsplat itself passes over it in silence.
BUILD_FAILED = ("'NoneType' object has no attribute", "Ninja is required", "building extension", "CUDA_HOME")


def render_gsplat(gaussians: Gaussians, camera: Camera) -> Rendering:
    """Render as ``constants`` says, on CUDA, in float32.

    gsplat lets NaN through its projection and treats what is not finite as drawn, so only usable Gaussians
    reach it.

    Raises:
        UserError: gsplat is not installed, or could not build its CUDA code.
    """
    rasterization = _rasterization()
    dtype = gaussians.means.dtype
    index = usable(gaussians, camera).nonzero()[:, 0]
    drawn = gaussians.select(index).to(torch.float32)
    camera = camera.to(torch.float32)
    # gsplat does not say how much of each Gaussian is seen. The sum over the image of weight * value has each
    # Gaussian's summed weight as its derivative, so a fourth colour, whose value does not matter, tells.
    with torch.enable_grad():
        probe = torch.ones(len(drawn), 1, device=drawn.means.device, requires_grad=True)
        image, alpha, _ = rasterization(
            means=drawn.means,
            quats=drawn.quaternions,
            scales=drawn.scales,
            opacities=drawn.opacities,
            colors=torch.cat([drawn.colors, probe], 1),
            viewmats=camera.world_to_camera[None],
            Ks=camera.intrinsics.detach()[None],
            width=camera.width,
            height=camera.height,
            near_plane=constants.NEAR,
            far_plane=constants.FAR,
            eps2d=constants.DILATION,
            render_mode="RGB+D",
            packed=False,
        )
        (seen,) = torch.autograd.grad(image[..., 3].sum(), probe, retain_graph=True)
    weights = torch.zeros(len(gaussians), device=seen.device).index_copy(0, index, seen[:, 0])
    tensors: list[Tensor] = [image[0, ..., :3], alpha[0, ..., 0], image[0, ..., 4], weights]
    if not torch.is_grad_enabled():
        tensors = [tensor.detach() for tensor in tensors]  # from the graph that the probe brought in
    return Rendering(*(tensor.to(dtype) for tensor in tensors))


def _rasterization() -> Callable[..., Any]:
    """The entry point of gsplat, which says what is missing where its CUDA code could not be built."""
    try:
        from gsplat import rasterization
    except ImportError as error:
        raise _unusable(error) from error

    def checked(**arguments: Any) -> Any:
        try:
            return rasterization(**arguments)
        except (ImportError, AttributeError, RuntimeError) as error:
            if isinstance(error, ImportError) or any(sign in str(error) for sign in BUILD_FAILED):
                raise _unusable(error) from error
            raise

    return checked


def missing_tools() -> list[str]:
    """The tools that gsplat needs to compile its CUDA code and this machine lacks."""
    return [tool for tool, names in BUILD_TOOLS.items() if not any(map(shutil.which, names))]


def _unusable(error: Exception) -> UserError:
    missing = missing_tools()
    found = f"this machine lacks {', '.join(missing)}" if missing else "all three are here"
    return UserError(
        f"rendering on CUDA needs gsplat 1.5.3, which cannot be used ({error}): "
        "pip install 'flexiavatar[gpu]'. It compiles on first use, with nvcc, a C++ compiler and ninja; "
        f"{found}. Or stay on the CPU, train.device=cpu"
    )
