"""Parameters of each Gaussian's own, and linear bases that add to them what follows pose and face.

Offset, log scale and colour are plain parameters. Of offset and colour there are K bases more; a frame adds
their sum, each times one number of the driving signal (``driving_signal.py``). No network takes part:
decoding is reading, and posing is one product of [6 N, K] with [K].
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor, nn

from pipeline.avatar.color_bounds import ANYWHERE, ColorBounds
from pipeline.avatar.driving_signal import DrivingSignal, fit_driving_signal, signal_features
from pipeline.avatar.representation import (
    BakedRepresentation,
    Change,
    ClipConditions,
    Condition,
    Decoded,
    LinearChange,
    Normals,
    Representation,
)
from pipeline.avatar.sparse import gather_rows, scatter_rows
from pipeline.avatar.surface import Surface
from pipeline.finite import require_finite


class BasesRepresentation(Representation):
    """Plain parameters and K linear bases for N Gaussians.

    Attributes:
        offset: [N, 3], in ``offset_unit``.
        log_scale: [N, 3].
        color: [N, 3] logits, added to the base colour.
        bases: [N, 6 K], K values each of red, green, blue (logits), x, y and z (``pose_offset_unit``).
        signal_mean, signal_components, signal_limits: of the driving signal; zero before ``set_clip``.
    """

    half_stored = frozenset({"offset", "log_scale", "color", "bases", "base_color", "trust"})
    offset: nn.Parameter
    log_scale: nn.Parameter
    color: nn.Parameter
    signal_mean: Tensor
    signal_components: Tensor
    signal_limits: Tensor

    def __init__(
        self, count: int, bases: int, pose: int, expressions: int, offset_unit: float, bends: int = 0
    ):
        """Zeros: the fitted body in its base colours.

        Args:
            count: Gaussians of the finest level, N.
            bases: K.
            pose: length of theta.
            expressions: of the body.
            offset_unit: metres that an offset of 1 stands for.
            bends: how many of the bases are bends, see ``DrivingSignal.bent``.
        """
        super().__init__()
        self._expressions, self._offset_unit, self._bends = expressions, offset_unit, bends
        for name in ("offset", "log_scale", "color"):
            self.register_parameter(name, nn.Parameter(torch.zeros(count, 3)))
        self.bases = nn.Parameter(torch.zeros(count, 6 * bases))
        self.register_buffer("signal_mean", torch.zeros(pose + expressions))
        self.register_buffer("signal_components", torch.zeros(bases, pose + expressions))
        self.register_buffer("signal_limits", torch.zeros(2, bases))

    def __len__(self) -> int:
        """K."""
        return len(self.signal_components)

    @property
    def signal(self) -> DrivingSignal:
        """The driving signal."""
        return DrivingSignal(self.signal_mean, self.signal_components, self.signal_limits)

    def decode(self, surface: Surface, base_color: Tensor) -> Decoded:
        """The parameters of the surface's Gaussians."""
        return Decoded(
            surface=surface,
            features=self.bases if torch.is_grad_enabled() else self.bases.detach(),
            offset=_picked(self.offset, surface) * self._offset_unit,
            log_scale=_picked(self.log_scale, surface),
            color_logit=base_color + _picked(self.color, surface),
        )

    def change(
        self, decoded: Decoded, condition: Condition, normals: Normals, rows: Tensor | None = None
    ) -> Change | None:
        """The bases' sum, weighted by the driving signal; no gradient reaches the pose.

        Raises:
            NotFiniteError: pose or expression is not finite.
        """
        if not len(self):
            return None
        linear = self.linear_change(decoded, condition)
        bases = _picked(decoded.features, decoded.surface)
        return _change(bases, linear.signal, rows)

    def linear_change(self, decoded: Decoded, condition: Condition) -> LinearChange:
        """The bases where they lie, and the driving signal; no gradient reaches the pose.

        Raises:
            NotFiniteError: pose or expression is not finite.
        """
        signal = _driven(self.signal, self._expressions, condition)
        return LinearChange(decoded.features, signal, decoded.surface.rows)

    def set_clip(self, clip: ClipConditions) -> None:
        """Finds the driving signal.

        Raises:
            ValueError: the clip has fewer directions than there are bases.
        """
        features = signal_features(clip.theta, clip.expression, self._expressions)
        found = fit_driving_signal(features, len(self) - self._bends).bent(self._bends)
        if len(found) < len(self):
            raise ValueError(f"the clip drives {len(found)} bases, not {len(self)}")
        self.signal_mean.copy_(found.mean)
        self.signal_components.copy_(found.components)
        self.signal_limits.copy_(found.limits)

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """A group for each kind of parameter."""
        groups = {
            "color_learning_rate": [self.color],
            "scale_learning_rate": [self.log_scale],
            "offset_learning_rate": [self.offset],
        }
        return groups | ({"bases_learning_rate": [self.bases]} if len(self) else {})

    def bake(self, decoded: Decoded, pose_dependent: bool, residuals: bool) -> BakedRepresentation:
        """The bases as they are: there is nothing that could be computed beforehand."""
        bases = _picked(decoded.features, decoded.surface)
        return BakedBases(self.signal, self._expressions, bases if pose_dependent else bases[:, :0])

    @torch.no_grad()
    def forget_unseen(self, seen: Tensor) -> None:
        """Sets the bases of Gaussians that no frame showed to zero: smoothness alone has moved them."""
        self.bases[~seen] = 0.0

    @torch.no_grad()
    def hold_colors(self, bounds: ColorBounds, base_color: Tensor) -> None:
        """Keeps colours within bounds; ``base_color``, [N, 3] logits, is what ``color`` is added to."""
        rows = torch.nonzero(bounds.around < ANYWHERE)[:, 0]
        color = torch.sigmoid(base_color[rows] + self.color[rows])
        held = bounds.pick(rows).held(color)
        moved = held != color
        self.color[rows] = torch.where(moved, torch.logit(held) - base_color[rows], self.color[rows])

    @torch.no_grad()
    def take_completion(self, rows: Tensor, completed: Decoded, base_color: Tensor, share: Tensor) -> bool:
        """Takes the values as its own parameters: True."""
        # What is fully trusted, and has its size, stays as it is, to the byte.
        some = (share < 1).any(1) | (completed.log_scale != self.log_scale[rows]).any(1)
        chosen = rows[some]
        self.offset[chosen] = completed.offset[some] / self._offset_unit
        self.log_scale[chosen] = completed.log_scale[some]
        self.color[chosen] = (completed.color_logit - base_color)[some]
        each = share[some].repeat_interleave(3, 1)  # red, green, blue, x, y, z
        self.bases[chosen] *= each.repeat_interleave(len(self), 1)
        return True


@dataclasses.dataclass(frozen=True)
class BakedBases(BakedRepresentation):
    """The bases of a finished avatar.

    Attributes:
        signal: that drives them.
        expressions: of the body.
        bases: [N, 6 K].
    """

    signal: DrivingSignal
    expressions: int
    bases: Tensor  # [N, 6 K]

    def change(self, condition: Condition, normals: Normals) -> Change | None:
        """The bases' sum, weighted by the driving signal."""
        linear = self.linear_change(condition)
        return _change(linear.bases, linear.signal) if len(linear.signal) else None

    def linear_change(self, condition: Condition) -> LinearChange:
        """The bases and the driving signal."""
        found = LinearChange(self.bases, _driven(self.signal, self.expressions, condition))
        return found if self.bases.shape[1] else found.none()


def _driven(signal: DrivingSignal, expressions: int, condition: Condition) -> Tensor:
    """The driving signal of a frame, [K]."""
    theta, expression = condition.theta.detach(), condition.expression.detach()
    told = {"theta": theta, "the expression": expression}
    require_finite(told, "posing", "in the driving signal", "mend the motion or the pose")
    return signal(signal_features(theta, expression, expressions))


def _change(
    bases: Tensor,  # [N, 6 K]
    signal: Tensor,  # [K]
    rows: Tensor | None = None,
) -> Change:
    asked = bases if rows is None else gather_rows(bases, rows)
    answer = (asked.reshape(-1, len(signal)) @ signal).view(-1, 6)
    if rows is not None:
        answer = scatter_rows(answer, rows, len(bases))
    return Change(offset=answer[:, 3:], color_logit=answer[:, :3])


def _picked(values: Tensor, surface: Surface) -> Tensor:
    """The surface's rows of what is known of every Gaussian of the finest level, differentiably."""
    if surface.rows is not None:
        return gather_rows(values, surface.rows)
    count = len(surface.canonical)
    return values if count == len(values) else values[:count]
