"""The driving signal of linear bases: pose and expression along the principal directions of the clip.

A direction has unit variance over the training frames. Outside of what these showed, the signal stays at the
edge of their range: a dance on the avatar of a head clip stays calm.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor
from torch.nn import functional

from pipeline.finite import require_finite

LEAST = 1e-3  # standard deviation of a direction that counts: a twentieth of a degree, or of an expression's
SLACK = 0.1  # of the training frames' range, on either side of it


@dataclasses.dataclass(frozen=True)
class DrivingSignal:
    """A map from a frame's features to K numbers.

    Attributes:
        mean: [D], of the training frames' features.
        components: [K, D], what a feature's difference from the mean is multiplied with.
        limits: [2, K], the least and the greatest value.
    """

    mean: Tensor  # [D]
    components: Tensor  # [K, D]
    limits: Tensor  # [2, K]

    def __len__(self) -> int:
        """K."""
        return len(self.components)

    def __call__(self, features: Tensor) -> Tensor:
        """The signal of one frame, [D] -> [K]."""
        signal = self.components @ (features - self.mean)
        return torch.minimum(torch.maximum(signal, self.limits[0]), self.limits[1])


def signal_features(
    theta: Tensor,  # [..., P]
    expression: Tensor,  # [..., E]
    expressions: int,
) -> Tensor:
    """Pose and expression side by side, [..., P + expressions].

    Args:
        theta: pose features.
        expression: cut or padded with zeros to as many as the body has.
        expressions: of the body.
    """
    padded = functional.pad(expression, (0, expressions - expression.shape[-1]))
    return torch.cat([theta, padded], -1)


def fit_driving_signal(features: Tensor, most: int) -> DrivingSignal:
    """The principal directions of a clip, the strongest first.

    There are fewer than asked for where the frames differ in fewer directions: at most one less than frames,
    none for one frame or a clip that stands still. The greatest entry of each direction is positive.

    Args:
        features: [F, D] of the training frames.
        most: directions asked for.

    Raises:
        NotFiniteError: a feature is not finite.
    """
    require_finite({"the training frames' pose or expression": features}, "training", "before the first "
                   "step", "run the fit stage again")  # fmt: skip
    # Float64 on the CPU: signs and order do not hang on the last bits of a device's float32.
    values = features.detach().cpu().double()
    mean = values.mean(0)
    _, lengths, directions = torch.linalg.svd(values - mean, full_matrices=False)
    deviations = lengths / len(values) ** 0.5
    count = min(most, int((deviations >= LEAST).sum()))
    directions = directions[:count]
    greatest = directions.abs().argmax(1, keepdim=True) if count else directions[:, :1].long()
    components = directions * directions.gather(1, greatest).sign() / deviations[:count, None]
    signal = (values - mean) @ components.T
    low, high = signal.amin(0), signal.amax(0)
    slack = SLACK * (high - low)
    found = (mean, components, torch.stack([low - slack, high + slack]))
    return DrivingSignal(*(one.float().to(features.device) for one in found))
