"""The one way to render: ``render(gaussians, camera)``."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from pipeline.clip.camera import Camera
from pipeline.splat.gaussians import Gaussians, Rendering

BACKENDS = ("auto", "numba", "gsplat", "dense")


def render(gaussians: Gaussians, camera: Camera, backend: str = "auto") -> Rendering:
    """Render Gaussians over black, differentiably.

    Gradients reach every tensor of ``gaussians`` and the camera's rotation and translation (not its
    intrinsics). A Gaussian that cannot be drawn (a number that is not finite, no orientation, behind the
    camera, ...: see ``image_formation.py``) is left out and has a gradient of zero; the others do not notice.

    Args:
        gaussians: in world coordinates. float64 is kept, everything else is computed in float32.
        camera: moved to the Gaussians' device and dtype.
        backend: "numba" (CPU), "gsplat" (CUDA), "dense" (plain torch, for small cases and as a reference), or
            "auto": gsplat for CUDA tensors, else numba.

    Returns:
        The image, in the dtype of the computation.

    Raises:
        ValueError: no such backend, an empty image, or tensors on a device that the backend does not serve.
        UserError: gsplat is asked for and not installed.

    A single red Gaussian, two metres before the camera:

    >>> from pipeline.clip.camera import facing_camera
    >>> mean, quaternion = torch.tensor([[0.0, 0.0, -2.0]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]])
    >>> scale, color = torch.full((1, 3), 0.2), torch.tensor([[1.0, 0.0, 0.0]])
    >>> red = Gaussians(mean, quaternion, scale, color, torch.tensor([0.9]))
    >>> rendering = render(red, facing_camera(32, 32, focal=32.0))
    >>> rendering.color.shape, [round(value, 1) for value in rendering.color[16, 16].tolist()]
    (torch.Size([32, 32, 3]), [0.9, 0.0, 0.0])
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend must be one of {', '.join(BACKENDS)}, not {backend!r}")
    if camera.width < 1 or camera.height < 1:
        raise ValueError(f"an image of {camera.width} x {camera.height} pixels cannot be rendered")
    device = gaussians.means.device
    if backend == "auto":
        backend = "gsplat" if device.type == "cuda" else "numba"
    if backend == "numba" and device.type != "cpu":
        raise ValueError(f"backend 'numba' renders CPU tensors, not {device.type}")
    if backend == "gsplat" and device.type != "cuda":
        raise ValueError(f"backend 'gsplat' renders CUDA tensors, not {device.type}")

    dtype = torch.float64 if gaussians.means.dtype == torch.float64 else torch.float32
    gaussians, camera = gaussians.to(dtype), camera.to(device=device, dtype=dtype)
    # Each backend's libraries are heavy, and a machine may have one of them only.
    if backend == "numba":
        from pipeline.splat.numba_backend import render_numba

        return render_numba(gaussians, camera)
    if backend == "gsplat":
        from pipeline.splat.gsplat_backend import render_gsplat

        return render_gsplat(gaussians, camera)
    from pipeline.splat.dense import render_dense

    return render_dense(gaussians, camera)


@torch.no_grad()
def picture_sums(
    gaussians: Gaussians,
    camera: Camera,
    picture: Tensor,  # [H, W, 4]
) -> tuple[Tensor, Tensor]:
    """The sums over the pixels of each Gaussian's blending weight times a picture, and of the weight alone.

    Equal to ``plain_picture_sums``, in 0.4 of its time on the CPU.

    Args:
        gaussians: N of them, in world coordinates.
        camera: that looks.
        picture: of the camera's size, on the Gaussians' device.

    Returns:
        [N, 4], and [N] as in ``Rendering.weights``.
    """
    if gaussians.means.device.type != "cpu":
        return plain_picture_sums(gaussians, camera, picture)
    from pipeline.splat.numba_backend import picture_sums_numba

    dtype = torch.float64 if gaussians.means.dtype == torch.float64 else torch.float32
    return picture_sums_numba(gaussians.to(dtype), camera.to(device="cpu", dtype=dtype), picture.to(dtype))


def plain_picture_sums(
    gaussians: Gaussians,
    camera: Camera,
    picture: Tensor,  # [H, W, 4]
) -> tuple[Tensor, Tensor]:
    """What ``picture_sums`` means, by the renderer's backward pass.

    The derivative of ``sum(rendering * picture)`` with respect to a Gaussian's colour is the sum of the
    pixels that it covers, each times its blending weight there.
    """
    with torch.enable_grad():
        weighed = dataclasses.replace(gaussians, colors=gaussians.colors.detach().clone().requires_grad_())
        rendering = render(weighed, camera)
        pictures = picture[..., :3], picture[..., 3:].expand(-1, -1, 3)
        losses = [(rendering.color * one).sum() for one in pictures]
        three = torch.autograd.grad(losses[0], weighed.colors, retain_graph=True)[0]
        fourth = torch.autograd.grad(losses[1], weighed.colors)[0]
    return torch.cat([three, fourth[:, :1]], 1), rendering.weights
