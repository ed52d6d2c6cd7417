"""The driving signal of linear bases: pose and expression along the principal directions of the clip.

A direction has unit variance over the training frames. Outside of what these showed, the signal stays at the
edge of their range: a dance on the avatar of a head clip stays calm.

Linear in pose and face is too little for a mouth that opens wide. So the strongest directions may have
*bends*: the same direction once more, at 0 on one side of ``BEND_AT`` and linear beyond. A bend is a
direction whose least and greatest value lie on one side of the mean, so nothing else has to know of it.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor
from torch.nn import functional

from pipeline.finite import require_finite

LEAST = 1e-3  # standard deviation of a direction that counts: a twentieth of a degree, or of an expression's
SLACK = 0.1  # of the training frames' range, on either side of it
BEND_AT = 0.7  # standard deviations from the mean at which a bend begins to act
BEND_REACH = 0.3  # standard deviations beyond, that the range of the clip with its slack has to reach


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
        """The signal of one frame, [D] -> [K]; 0 at the mean."""
        signal, (low, high) = self.components @ (features - self.mean), self.limits
        # A bend's values all lie to one side of the mean: what it has there is taken off.
        return torch.minimum(torch.maximum(signal, low), high) - low.clamp_min(0) - high.clamp_max(0)

    @property
    def bends(self) -> int:
        """How many of the K are bends; they are the last ones."""
        return int(((self.limits[0] > 0) | (self.limits[1] < 0)).sum())

    def bent(self, most: int) -> DrivingSignal:
        """The signal with bends behind it, those of the strongest direction first.

        There are fewer than asked for where the clip does not reach far enough from its mean.
        """
        low, high = self.limits
        beyond = torch.stack([high, -low], 1) >= BEND_AT + BEND_REACH
        rows, sides = beyond.nonzero()[:most].T
        at, end = torch.full_like(low[rows], BEND_AT), self.limits.flip(0)[sides, rows]
        bends = torch.where(sides == 0, torch.stack([at, end]), torch.stack([end, -at]))
        components = torch.cat([self.components, self.components[rows]])
        return DrivingSignal(self.mean, components, torch.cat([self.limits, bends], 1))


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
