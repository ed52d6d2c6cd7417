"""The interface between an avatar and what it learns: a static part, and one that follows pose and face.

Everything else (canonical mesh, skinning, expression, gate, renderer, losses, storage, baking) is the same
for every representation and asks only for what is declared here.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable

from torch import Tensor, nn

from pipeline.avatar.surface import Surface

Normals = Callable[[], Tensor]
"""Computes the posed surface's unit normals, [N, 3]; called only by who needs them."""


@dataclasses.dataclass(frozen=True)
class Decoded:
    """The part of an avatar that does not depend on the pose.

    Attributes:
        surface: the level that was decoded.
        features: what the pose-dependent part reads: the triplane's ``f_i``, [N, C]; or the linear bases
            [M, C], of every Gaussian of the finest level, see ``surface.rows``.
        offset: [N, 3], Delta V_tri, metres.
        log_scale: [N, 3], S_tri, relative to the initial scale.
        color_logit: [N, 3], C_tri, before the sigmoid.
    """

    surface: Surface
    features: Tensor
    offset: Tensor
    log_scale: Tensor
    color_logit: Tensor


@dataclasses.dataclass(frozen=True)
class Condition:
    """One frame as the pose-dependent part is told it.

    Attributes:
        theta: [54 * 6], the pose without the root, see ``pose_features``; noise included.
        expression: [E], as the body model takes it; may be shorter than the body's.
        time: seconds from the clip's start; None where there is no clock.
    """

    theta: Tensor  # [54 * 6]
    expression: Tensor  # [E]
    time: float | None = None


@dataclasses.dataclass(frozen=True)
class ClipConditions:
    """The training frames' conditions, from which a representation takes the ranges that it works in.

    Attributes:
        theta: [F, 54 * 6].
        expression: [F, E].
        seconds: when the frames were filmed, of those where that is known.
    """

    theta: Tensor  # [F, 54 * 6]
    expression: Tensor  # [F, E]
    seconds: tuple[float, ...] = ()


@dataclasses.dataclass(frozen=True)
class Change:
    """The change that the pose-dependent part adds before skinning.

    Attributes:
        offset: [N, 3], Delta V_pose in ``Architecture.pose_offset_unit``, before it is taken off head and
            hands.
        color_logit: [N, 3], Delta C_pose.
        log_scale: [N, 3], Delta S_pose; None where scales do not follow the pose.
    """

    offset: Tensor
    color_logit: Tensor
    log_scale: Tensor | None = None

    def scaled(self, share: Tensor) -> Change:
        """A share of it, [N, 2]: of the colour and of the rest."""
        color, shape = share[:, :1], share[:, 1:]
        log_scale = None if self.log_scale is None else self.log_scale * shape
        return Change(self.offset * shape, self.color_logit * color, log_scale)


@dataclasses.dataclass(frozen=True)
class LinearChange:
    """A change that is a sum of bases, each times one number of a signal.

    Attributes:
        bases: [M, 6 K], K values each of red, green, blue (logits), x, y and z (as ``Change.offset``).
        signal: [K], without gradient.
        rows: [N] int64, the row of ``bases`` that is each Gaussian's; None where it is its own number.
    """

    bases: Tensor  # [M, 6 K]
    signal: Tensor  # [K]
    rows: Tensor | None = None  # [N]

    def none(self) -> LinearChange:
        """The same of no bases: nothing changes."""
        return LinearChange(self.bases[:, :0].detach(), self.signal[:0], self.rows)


class BakedRepresentation(abc.ABC):
    """The pose-dependent part of a finished avatar, ready to be evaluated without gradient."""

    @abc.abstractmethod
    def change(self, condition: Condition, normals: Normals) -> Change | None:
        """The change before skinning; None where there is none."""

    def linear_change(self, condition: Condition) -> LinearChange | None:
        """As ``Representation.linear_change``."""
        return None

    def residuals(self, means: Tensor, condition: Condition) -> list[tuple[Tensor, Tensor]]:
        """Rows, [M], and residual colours of each part, [M, 3], or [M, 6] with moves, after skinning."""
        return []


class Representation(nn.Module, abc.ABC):
    """What of an avatar is learnt.

    Attributes:
        half_stored: names of parameters, and of the avatar's buffers, that a file holds as float16.
    """

    half_stored: frozenset[str] = frozenset()

    @abc.abstractmethod
    def decode(self, surface: Surface, base_color: Tensor) -> Decoded:
        """The pose-independent part on a surface.

        Args:
            surface: a level, gated or not.
            base_color: [N, 3] logits of the surface's vertices, which the colours are added to.
        """

    @abc.abstractmethod
    def change(
        self, decoded: Decoded, condition: Condition, normals: Normals, rows: Tensor | None = None
    ) -> Change | None:
        """The change of one frame before skinning; None where there is none.

        Args:
            decoded: the pose-independent part.
            condition: of the frame.
            normals: of the posed surface.
            rows: [M] int64, each at most once, the Gaussians asked for, of the others the change is zero;
                all if None.
        """

    def linear_change(self, decoded: Decoded, condition: Condition) -> LinearChange | None:
        """The change of all Gaussians as bases and their signal; None where it is not of this kind.

        Who answers has no residual colours: ``change`` is all that follows pose and face.
        """
        return None

    def residual(
        self, decoded: Decoded, means: Tensor, condition: Condition, rows: Tensor | None = None
    ) -> Tensor | None:
        """Residual colours after skinning, [N, 3], or [N, 6] with moves at rest; None where there are none.

        Args:
            decoded: the pose-independent part.
            means: [N, 3], posed centres in the world, metres.
            condition: of the frame.
            rows: as of ``change``.
        """
        return None

    @abc.abstractmethod
    def set_clip(self, clip: ClipConditions) -> None:
        """Takes the ranges of the training frames; called once, before training."""

    @abc.abstractmethod
    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """The parameters by the name of their learning rate (``TrainSettings``)."""

    @abc.abstractmethod
    def bake(self, decoded: Decoded, pose_dependent: bool, residuals: bool) -> BakedRepresentation:
        """The pose-dependent part on what was decoded, without gradient, on the CPU.

        Args:
            decoded: the pose-independent part.
            pose_dependent: ``change`` takes part.
            residuals: ``residual`` takes part.
        """

    def forget_unseen(self, seen: Tensor) -> None:
        """Undoes what was learnt where nothing was to be seen; called once, after training.

        Args:
            seen: [N] bool, the Gaussians of the finest level of which there is any evidence.
        """

    def take_completion(self, rows: Tensor, completed: Decoded, base_color: Tensor, share: Tensor) -> bool:
        """Takes completed values for what it decodes to, and lets what follows the pose fade.

        Args:
            rows: [M] int64, which Gaussians of the finest level.
            completed: their pose-independent part.
            base_color: [M, 3], what their colours are added to.
            share: [M, 2] in [0, 1], of colours and of places that follow the pose that is left.

        Returns:
            False if it cannot, because its values are not a Gaussian's own: the avatar keeps them then.
        """
        return False
