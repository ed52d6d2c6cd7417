"""The step of the face controls: all frames see them, and there are too many for the frames' system."""

from __future__ import annotations

import torch
from torch import Tensor

from stages.fit.solver.normal import FaceRows


class FaceStep:
    """Collects the face's rows span by span, then solves for the controls with the poses' step given."""

    def __init__(self, spread: Tensor, gradient: Tensor) -> None:
        """Begin with how far controls move landmarks, [N, C], and the gradient of the summed loss, [C, 3]."""
        self._spread = spread
        self._gradient = gradient.clone()
        self._blocks = gradient.new_zeros(0)
        self._rows = torch.zeros(0, dtype=torch.long)

    def add(self, face: FaceRows, frame: Tensor, shared: Tensor) -> None:
        """Add a span's rows.

        Args:
            face: the rows.
            frame: [T, n], the span's step.
            shared: [S], the step of what frames share.
        """
        both = torch.cat([frame[:, face.frame], shared[face.shared].expand(len(frame), -1)], dim=1)
        change = (face.slopes @ both[..., None]).view(face.rest.shape[:3])
        spread = self._spread[face.rows]
        self._gradient += spread.mT @ (face.rest * change[..., None]).sum((0, 2))
        blocks = torch.einsum("tnra,tnrb->nab", face.rest, face.rest)
        self._blocks = blocks if len(self._rows) == 0 else self._blocks + blocks
        self._rows = face.rows

    def solve(self, priors: list[Tensor], damping: float) -> Tensor | None:
        """The step, [C, 3]; None if the system is singular; zeros if no rows came.

        Args:
            priors: second derivatives of the priors along each axis, [C, C] three times.
            damping: relative to the diagonal.
        """
        if len(self._rows) == 0:
            return torch.zeros_like(self._gradient)
        spread = self._spread[self._rows]
        count = spread.shape[1]
        system = spread.new_empty(count, 3, count, 3)
        for row in range(3):
            for column in range(3):
                system[:, row, :, column] = spread.mT @ (self._blocks[:, row, column, None] * spread)
        for axis, prior in enumerate(priors):
            system[:, axis, :, axis] += prior
        flat = system.view(3 * count, 3 * count)
        flat.diagonal().mul_(1 + damping).add_(1e-3)
        lower, failed = torch.linalg.cholesky_ex(flat)
        if int(failed):
            return None
        return -torch.cholesky_solve(self._gradient.view(-1, 1), lower).view(-1, 3)
