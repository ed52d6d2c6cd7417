"""Every Gaussian at every pixel, in plain torch: the plain twin of the other backends.

With its gradients it needs memory for some twenty [N, H, W] tensors. It runs in any floating dtype, on any
device, and its derivatives are autograd's.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from pipeline.clip.camera import Camera, to_camera
from pipeline.splat import image_formation as constants
from pipeline.splat.gaussians import Gaussians, Rendering


@dataclasses.dataclass(frozen=True)
class Projected:
    """Gaussians in the image.

    Attributes:
        means: [N, 2], pixels.
        covariances: [N, 3], entries xx, xy, yy of the dilated covariance, pixels squared.
        determinants: [N], of the covariance.
        depths: [N], metres along the optical axis.
    """

    means: Tensor  # [N, 2]
    covariances: Tensor  # [N, 3]
    determinants: Tensor  # [N]
    depths: Tensor  # [N]


def render_dense(gaussians: Gaussians, camera: Camera) -> Rendering:
    """Render as ``image_formation.py`` says. Extrinsics receive a gradient, intrinsics do not."""
    index = usable(gaussians, camera).nonzero()[:, 0]
    depths = to_camera(camera, gaussians.means.detach()[index])[:, 2]
    index = index[torch.argsort(depths.float(), stable=True)]
    drawn = gaussians.select(index)
    projected = project_gaussians(drawn, camera)

    weights = blending_weights(alphas(projected, drawn.opacities, camera))  # [M, H, W]
    summed = torch.zeros_like(gaussians.opacities)
    summed[index] = weights.detach().sum((1, 2))
    return Rendering(
        color=torch.einsum("nhw,nc->hwc", weights, drawn.colors),
        alpha=weights.sum(0),
        depth=torch.einsum("nhw,n->hw", weights, projected.depths),
        weights=summed,
    )


def project_gaussians(gaussians: Gaussians, camera: Camera) -> Projected:
    """The EWA projection, with no guard: filter by ``usable`` before differentiating through it."""
    focal, centre = _lens(camera)
    points = to_camera(camera, gaussians.means)
    depth = points[:, 2]
    ratio = points[:, :2] / depth[:, None]
    size = torch.tensor([camera.width, camera.height], dtype=ratio.dtype, device=ratio.device)
    margin = constants.JACOBIAN_MARGIN * 0.5 * size / focal
    clamped = torch.clamp(ratio, -centre / focal - margin, (size - centre) / focal + margin)

    # The rows of J R M S, one for each axis of the image.
    rotations = camera.rotation @ rotation_matrices(gaussians.quaternions)  # [N, 3, 3]
    axes = rotations * gaussians.scales[:, None, :]
    scale = (focal / depth[:, None])[:, :, None]
    x_row, y_row = (scale * (axes[:, :2] - clamped[:, :, None] * axes[:, 2:])).unbind(1)
    xx, xy, yy = (x_row * x_row).sum(1), (x_row * y_row).sum(1), (y_row * y_row).sum(1)
    # By Lagrange's identity det(A Aᵀ) = |x_row × y_row|²; xx yy - xy² would cancel for needles.
    cross = torch.linalg.cross(x_row, y_row)
    dilation = constants.DILATION
    determinants = (cross * cross).sum(1) + dilation * (xx + yy) + dilation**2
    covariances = torch.stack([xx + dilation, xy, yy + dilation], 1)
    return Projected(ratio * focal + centre, covariances, determinants, depth)


def rotation_matrices(quaternions: Tensor) -> Tensor:
    """Quaternions (w, x, y, z) of any length but zero as rotation matrices: [N, 4] -> [N, 3, 3]."""
    w, x, y, z = (quaternions / quaternions.norm(dim=1, keepdim=True)).unbind(1)
    entries = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(entries, 1).reshape(-1, 3, 3)


@torch.no_grad()
def usable(gaussians: Gaussians, camera: Camera) -> Tensor:
    """True for Gaussians that can be drawn, bool [N]; the rest show nothing or are not finite."""
    *vectors, opacities = gaussians.tensors()
    finite = torch.cat([*vectors, opacities[:, None]], 1).isfinite().all(1)
    lengths = gaussians.quaternions.norm(dim=1)
    projected = project_gaussians(gaussians, camera)
    variances = projected.covariances[:, ::2]
    # alpha stays under ALPHA_MIN outside this box.
    reach = (2 * torch.log(opacities / constants.ALPHA_MIN)).clamp_min(0).sqrt()
    radius = reach[:, None] * variances.sqrt()
    size = torch.tensor([camera.width, camera.height], device=radius.device)
    touches = (projected.means + radius >= 0) & (projected.means - radius <= size)
    return (
        finite
        & (projected.depths >= constants.NEAR)
        & (projected.depths <= constants.FAR)
        & (opacities >= constants.ALPHA_MIN)
        & (lengths >= constants.QUATERNION_MIN)
        & (lengths <= constants.QUATERNION_MAX)
        & (variances <= constants.COVARIANCE_MAX).all(1)
        & touches.all(1)
    )


def alphas(projected: Projected, opacities: Tensor, camera: Camera) -> Tensor:
    """Each Gaussian's alpha at each pixel, before any blending: [N, H, W]."""
    columns = torch.arange(camera.width, dtype=opacities.dtype, device=opacities.device)
    rows = torch.arange(camera.height, dtype=opacities.dtype, device=opacities.device)
    x = (columns + 0.5 - projected.means[:, :1])[:, None, :]  # [N, 1, W]
    y = (rows + 0.5 - projected.means[:, 1:])[:, :, None]  # [N, H, 1]
    xx, xy, yy = (projected.covariances / projected.determinants[:, None])[:, :, None, None].unbind(1)
    sigma = 0.5 * (yy * x * x + xx * y * y) - xy * x * y  # the conic is the covariance's inverse
    alpha = (opacities[:, None, None] * torch.exp(-sigma)).clamp_max(constants.ALPHA_MAX)
    return torch.where((sigma >= 0) & (alpha >= constants.ALPHA_MIN), alpha, torch.zeros_like(alpha))


def blending_weights(alpha: Tensor) -> Tensor:
    """Alphas from front to back as weights of the sum over Gaussians: [N, H, W] -> [N, H, W]."""
    if not len(alpha):
        return alpha
    transmittance = torch.cumprod(1 - alpha.detach(), 0)
    ended = torch.cummax((transmittance <= constants.TRANSMITTANCE_MIN).to(torch.uint8), 0).values.bool()
    alpha = torch.where(ended, torch.zeros_like(alpha), alpha)
    behind = torch.cumprod(1 - alpha, 0)
    return alpha * torch.cat([torch.ones_like(behind[:1]), behind[:-1]])


def _lens(camera: Camera) -> tuple[Tensor, Tensor]:
    """Focal lengths and principal point, each [2], pixels."""
    intrinsics = camera.intrinsics.detach()
    return torch.stack([intrinsics[0, 0], intrinsics[1, 1]]), intrinsics[:2, 2]
