"""The renderer's input and output: Gaussians, and an image of them."""

from __future__ import annotations

import dataclasses

from torch import Tensor


@dataclasses.dataclass(frozen=True)
class Gaussians:
    """Anisotropic 3D Gaussians in world coordinates.

    All tensors share one device. ``render`` works in the dtype of ``means`` (float64 if that is, else
    float32).

    Attributes:
        means: [N, 3], metres.
        quaternions: [N, 4], (w, x, y, z), of any length but zero, turning the Gaussian's axes to the world's.
        scales: [N, 3], standard deviations along the Gaussian's axes, metres.
        colors: [N, 3], RGB in the space that the images are in.
        opacities: [N], in [0, 1].

    Raises:
        ValueError: the shapes do not agree.
    """

    means: Tensor  # [N, 3]
    quaternions: Tensor  # [N, 4]
    scales: Tensor  # [N, 3]
    colors: Tensor  # [N, 3]
    opacities: Tensor  # [N]

    def __post_init__(self) -> None:
        """Refuse shapes that do not agree."""
        n = self.means.shape[0]
        shapes = {
            "means": (n, 3),
            "quaternions": (n, 4),
            "scales": (n, 3),
            "colors": (n, 3),
            "opacities": (n,),
        }
        for name, shape in shapes.items():
            found = tuple(getattr(self, name).shape)
            if found != shape:
                raise ValueError(f"Gaussians.{name} must have shape {shape}, not {found}")

    def __len__(self) -> int:
        """The number of Gaussians."""
        return self.means.shape[0]

    def to(self, *args, **kwargs) -> Gaussians:
        """The same Gaussians with their tensors moved or cast as by ``Tensor.to``."""
        return Gaussians(*(tensor.to(*args, **kwargs) for tensor in self.tensors()))

    def select(self, index: Tensor) -> Gaussians:
        """The Gaussians at ``index`` (int64 [M], or bool [N]), differentiably."""
        return Gaussians(*(tensor[index] for tensor in self.tensors()))

    def tensors(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """The five tensors in the order of declaration."""
        return self.means, self.quaternions, self.scales, self.colors, self.opacities


@dataclasses.dataclass(frozen=True)
class Rendering:
    """An image of Gaussians.

    Attributes:
        color: [H, W, 3], premultiplied: over black. Over a background b it is ``color + (1 - alpha) b``.
        alpha: [H, W], in [0, 1].
        depth: [H, W], metres, weighted as the colour is: divide by ``alpha`` for the mean depth of a pixel.
        weights: [N], each Gaussian's blending weight summed over the image, in pixels; no gradient. Zero is
            a Gaussian that nothing of is seen.
    """

    color: Tensor  # [H, W, 3]
    alpha: Tensor  # [H, W]
    depth: Tensor  # [H, W]
    weights: Tensor  # [N]
