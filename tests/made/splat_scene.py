"""A small cloud of Gaussians before a turned camera, drawn from a seed."""

import math

import torch
from torch import Tensor

from pipeline.clip.camera import Camera
from pipeline.splat import Gaussians, Rendering, render

NAMES = ("means", "quaternions", "scales", "colors", "opacities", "rotation", "translation")


def scene(
    count: int,
    width: int,
    height: int,
    dtype: torch.dtype = torch.float64,
    seed: int = 0,
    size: float = 0.15,
) -> tuple[Gaussians, Camera]:
    """``count`` Gaussians of about ``size`` metres, about 3 m away, some beyond the image's edge."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    gaussians = Gaussians(
        means=(uniform(count, 3) - 0.5) * torch.tensor([2.2, 2.2, 1.5]),
        quaternions=torch.randn(count, 4, generator=generator, dtype=torch.float64),
        scales=size * (0.3 + uniform(count, 3)),
        colors=uniform(count, 3),
        opacities=0.2 + 0.75 * uniform(count),
    )
    cos, sin = math.cos(0.3), math.sin(0.3)
    rotation = torch.tensor([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]], dtype=torch.float64)
    intrinsics = [[1.3 * width, 0, width / 2 - 0.7], [0, 1.25 * width, height / 2 + 0.4], [0, 0, 1]]
    translation = torch.tensor([0.05, -0.02, 3.0], dtype=torch.float64)
    camera = Camera(width, height, torch.tensor(intrinsics, dtype=torch.float64), rotation, translation)
    return gaussians.to(dtype), camera.to(dtype)


def leaves(gaussians: Gaussians, camera: Camera) -> tuple[Gaussians, Camera, list[Tensor]]:
    """The same scene with tensors that gather gradients, and those tensors in the order of NAMES."""
    tensors = [*gaussians.tensors(), camera.rotation, camera.translation]
    tensors = [tensor.detach().clone().requires_grad_() for tensor in tensors]
    moved = Camera(camera.width, camera.height, camera.intrinsics, *tensors[5:])
    return Gaussians(*tensors[:5]), moved, tensors


def images(rendering: Rendering) -> tuple[Tensor, Tensor, Tensor]:
    """What a loss may be put on."""
    return rendering.color, rendering.alpha, rendering.depth


def draw(gaussians: Gaussians, camera: Camera, backend: str) -> tuple[Rendering, dict[str, Tensor]]:
    """A rendering, and the gradients of a loss that weighs every number of its images differently."""
    gaussians, camera, tensors = leaves(gaussians, camera)
    rendering = render(gaussians, camera, backend)
    generator = torch.Generator().manual_seed(1)
    loss = torch.zeros((), dtype=rendering.color.dtype)
    for image in images(rendering):
        loss = (
            loss
            + (image * torch.randn(image.shape, generator=generator, dtype=torch.float64).to(image)).sum()
        )
    loss.backward()
    return rendering, {name: tensor.grad for name, tensor in zip(NAMES, tensors, strict=True)}
