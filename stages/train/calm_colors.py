"""Colours of surface that frames saw from its edge alone: held to its segment's while training ends.

Such a surface learns the colours of whatever stands at that edge of the person: an ear on the cheek, the wall
on a shoulder. From its side that is patches. To take them out after training costs the filmed side up to
three decibels, since they fill the person's rim; so they are taken out in the middle, and held, and what
frames saw squarely learns to fill the rim in their stead.

Only the bases' representation has colours of each Gaussian that can be held; a triplane's stay as learnt.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from pipeline.avatar.bases_representation import BasesRepresentation
from pipeline.avatar.color_bounds import ANYWHERE, ColorBounds
from pipeline.avatar.completion import calm_colors
from pipeline.clip.frames import spread_from_start
from stages.train.frame_evidence import evidence_of
from stages.train.loop import Hook, Trainer

EVERY = 2  # of the frames that completion asks


class CalmColors(nn.Module, Hook):
    """Holds weakly seen colours near their segment's from one iteration on.

    Attributes:
        field, around, hair: of N Gaussians, see ``ColorBounds``.
    """

    field: Tensor  # [N, 3]
    around: Tensor  # [N]
    hair: Tensor  # [N]

    def __init__(self, base_color: Tensor, first: int):
        """Holds nothing yet.

        Args:
            base_color: [N, 3], the avatar's.
            first: steps after which it begins.
        """
        super().__init__()
        self._first = first
        self.register_buffer("field", torch.zeros_like(base_color))
        self.register_buffer("around", torch.full_like(base_color[:, 0], ANYWHERE))
        self.register_buffer("hair", torch.zeros_like(base_color[:, 0], dtype=torch.bool))

    def on_step(self, trainer: Trainer, terms: dict[str, float]) -> None:
        """Looks once what is seen weakly, then holds its colours after every step."""
        if trainer.iteration == self._first:
            self._look(trainer)
        representation = trainer.avatar.representation
        if trainer.iteration >= self._first and isinstance(representation, BasesRepresentation):
            bounds = ColorBounds(self.field, self.around, self.hair)
            representation.hold_colors(bounds, trainer.avatar.base_color)

    def _look(self, trainer: Trainer) -> None:
        avatar, data, count = trainer.avatar.eval(), trainer.data, trainer.settings.color_frames // EVERY
        captured, made = (spread_from_start(frames, max(1, count)) for frames in data.sources)
        evidence = evidence_of(avatar, trainer.poses, data, captured, made)
        with torch.no_grad():
            decoded = avatar.decode()
        rows = decoded.surface.pick(torch.arange(len(self.around), device=avatar.device))
        bounds = calm_colors(decoded, evidence)
        self.field[rows], self.around[rows], self.hair[rows] = bounds.field, bounds.around, bounds.hair
        avatar.train()
