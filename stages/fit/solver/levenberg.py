"""Levenberg-Marquardt steps on the registration objective, and the order in which they are taken.

The gradient is the objective's own; the second derivatives are those of ``normal``. Poses are solved for
together with what frames share, whose system is what is left when the poses follow (a Schur
complement); the face controls come after, with the poses' step given. A frame that a step makes worse
takes less of it and is damped more in the next.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from stages.fit.finite import finite_loss, require_finite_gradient
from stages.fit.objective import Objective
from stages.fit.parameters import PER_FRAME, Parameters
from stages.fit.solver.banded import factorise
from stages.fit.solver.face_step import FaceStep
from stages.fit.solver.normal import Coupling, Normal, coupling_of, groups_of, normal_equations
from stages.fit.solver.shared_priors import control_priors, shared_priors
from stages.fit.solver.slopes import Group, Layout
from stages.fit.solver.state import Step, gradient_step, moved
from stages.fit.windows import windows

_DAMPING, _LEAST, _MOST = 1e-2, 1e-5, 1e3
_BETTER, _WORSE = 0.5, 8.0  # factors on a frame's damping after a step that helped it, or did not
_ATTEMPTS, _SHARES = 4, 3  # how often damping is raised, and steps shortened, before a step is given up
_SHORTER = 0.3
_FURTHER = 1.5  # the quadratic lies above the loss, whose minimum is mostly beyond the quadratic's


@dataclasses.dataclass(frozen=True)
class Unknowns:
    """What is solved for.

    Attributes:
        joints: [K], the joints that turn.
        expression: whether expressions are.
        shared: whether betas are.
        joint_offset, face_control: whether they are.
    """

    joints: Tensor
    expression: bool
    shared: bool
    joint_offset: bool
    face_control: bool


@dataclasses.dataclass(frozen=True)
class Solved:
    """A span's normal equations, and what their bands' inverse makes of them.

    Attributes:
        normal: the equations.
        inverse: [T, n, 1 + S], of the gradient and of ``normal.mixed``.
    """

    normal: Normal
    inverse: Tensor

    def complement(self, damping: float) -> tuple[Tensor, Tensor]:
        """What is left of the shared system when the poses follow: [S, S] and [S], float64."""
        shared, mixed = self.normal.shared, self.normal.mixed.flatten(0, 1).mT
        matrix = (
            shared + torch.diag(damping * shared.diagonal()) - mixed @ self.inverse[..., 1:].flatten(0, 1)
        )
        return matrix.double(), (mixed @ self.inverse[..., 0].flatten()).double()


class Levenberg:
    """Steps on one objective.

    Attributes:
        objective: the prepared one.
        damping: lambda, [T], relative to the diagonal of the second derivatives.
        taken: how many steps were begun.
    """

    def __init__(self, objective: Objective, minibatch: int) -> None:
        """Prepare; ``minibatch`` frames are posed and coupled at a time, which bounds the memory."""
        self.objective, self._minibatch = objective, minibatch
        self._count = len(objective.times)
        self._groups: list[Group] = groups_of(objective)
        self._coupling: Coupling = coupling_of(objective.times)
        self.damping = torch.full((self._count,), _DAMPING)
        self.taken = 0

    def step(
        self, parameters: Parameters, objective: Objective, robust: bool, unknowns: Unknowns
    ) -> tuple[Parameters, float, bool]:
        """One step.

        Args:
            parameters: with orthonormal rotations.
            objective: the prepared one, or that with another unit of pixels.
            robust: as the objective's.
            unknowns: what moves.

        Returns:
            The parameters after it, the loss there, and whether any step was an improvement.

        Raises:
            NotFiniteError: the loss or its gradient is not finite to begin with.
        """
        self.taken += 1
        gradient = self._gradient(parameters, objective, robust)
        loss, of_frames = self._losses(parameters, objective, robust)
        for _ in range(_ATTEMPTS):
            step = self._solve(parameters, objective, robust, unknowns, gradient)
            if step is not None:
                share = torch.full((self._count,), _FURTHER if robust else 1.0)
                for _ in range(_SHARES):
                    after = moved(parameters, step, share).orthonormal()
                    lower, now = self._losses(after, objective, robust)
                    worse = ~(now <= 1.02 * of_frames + 0.05)
                    if lower < loss:
                        self._adapt(worse | (share < 0.99))
                        return after, lower, True
                    share = torch.where(_spread(worse), _SHORTER * share, share)
            self.damping = (self.damping * _WORSE).clamp(max=_MOST)
        return parameters, loss, False

    def _adapt(self, worse: Tensor) -> None:
        factor = torch.where(worse, _WORSE, _BETTER)
        self.damping = (self.damping * factor).clamp(_LEAST, _MOST)

    def _gradient(self, parameters: Parameters, objective: Objective, robust: bool) -> Step:
        """The gradient of the loss summed over frames."""
        total = parameters.zeros()
        for window in windows(self._count, self._minibatch):
            leaves = parameters.rows(window.low, window.high).leaves()
            finite_loss(objective, leaves, robust, window, self.taken).backward()
            for name, leaf in leaves.named().items():
                if leaf.grad is not None:
                    whole = getattr(total, name)
                    (whole[window.posed] if name in PER_FRAME else whole).add_(leaf.grad, alpha=self._count)
        require_finite_gradient(objective, total.named(), self.taken)
        return gradient_step(parameters, total)

    @torch.no_grad()
    def _losses(self, parameters: Parameters, objective: Objective, robust: bool) -> tuple[float, Tensor]:
        """The loss, and what each frame's own observations add to T times it: [T]."""
        total, parts = 0.0, []
        for window in windows(self._count, self._minibatch):
            rows = parameters.rows(window.low, window.high)
            total += float(torch.stack(list(objective(rows, robust, window).values())).sum())
            pixels = objective.predict(rows, window).pixels
            scale, seen = objective.scale[window.posed], objective.observations
            error = (pixels - seen.pixels[window.posed]) * scale
            far = (error.square().sum(-1) + 1).sqrt() - 1
            if robust:
                far = far * objective.saturation / (far + objective.saturation)
            parts.append(((far * objective.weight[window.posed]).sum(1) / 8)[window.own])
        return total, torch.cat(parts)

    @torch.no_grad()
    def _solve(
        self, parameters: Parameters, objective: Objective, robust: bool, unknowns: Unknowns, gradient: Step
    ) -> Step | None:
        """The damped Gauss-Newton step, or None if a system is singular."""
        expressions = parameters.expression.shape[1] if unknowns.expression else 0
        layout = Layout(unknowns.joints, expressions, len(parameters.betas), unknowns.joint_offset)
        right = _of_frames(gradient, layout)
        spans = [slice(window.begin, window.end) for window in windows(self._count, self._minibatch)]

        def solved(span: slice) -> Solved | None:
            rows = parameters.rows(span.start, span.stop)
            normal = normal_equations(objective, self._groups, self._coupling, rows, layout, robust, span)
            factor = factorise(normal.bands, self.damping[span])
            if factor is None:
                return None
            return Solved(normal, factor.solve(torch.cat([right[span, :, None], normal.mixed], dim=-1)))

        damping = float(self.damping.mean())
        left = shared_priors(objective, parameters, layout, self._count)
        below = torch.cat([gradient.betas, gradient.joint_offset.flatten()])[: layout.shared].double()
        kept: Solved | None = None
        for span in spans:
            kept = solved(span)
            if kept is None:
                return None
            matrix, vector = kept.complement(damping)
            left, below = left + matrix, below - vector
        shared = _solve_shared(left, below, unknowns.shared)
        if shared is None:
            return None
        face = FaceStep(objective.model.face, gradient.face_control)
        frames = torch.zeros_like(right)
        for span in spans:
            # The systems of many spans are made twice, so that only one is ever held.
            kept = kept if len(spans) == 1 else solved(span)
            if kept is None:
                return None
            frames[span] = -kept.inverse[..., 0] - kept.inverse[..., 1:] @ shared
            if unknowns.face_control and kept.normal.face is not None:
                face.add(kept.normal.face, frames[span], shared)
        priors = control_priors(objective, parameters, self._count) if unknowns.face_control else []
        control = face.solve(priors, damping)
        return None if control is None else _step_of(frames, shared, control, layout, gradient)


def _spread(worse: Tensor) -> Tensor:
    """The frames that were worse and their neighbours; all if none was: [T] bool."""
    if not worse.any():
        return torch.ones_like(worse)
    return torch.nn.functional.max_pool1d(worse.float()[None, None], 3, stride=1, padding=1)[0, 0] > 0


def _solve_shared(left: Tensor, right: Tensor, free: bool) -> Tensor | None:
    """The step of what frames share, float32: zeros if it is held, None if the system is singular.

    In float64: the complement is a small difference of large matrices where shape and distance explain
    nearly the same.
    """
    if not free:
        return torch.zeros(len(right))
    lower, failed = torch.linalg.cholesky_ex((left + left.mT) / 2)
    return None if int(failed) else -torch.cholesky_solve(right[:, None], lower)[:, 0].float()


def _of_frames(gradient: Step, layout: Layout) -> Tensor:
    """The part of a gradient that belongs to the frames' unknowns: [T, n]."""
    turns = gradient.rotation[:, layout.joints].flatten(1)
    return torch.cat([turns, gradient.expression[:, : layout.expressions], gradient.transl], dim=1)


def _step_of(frames: Tensor, shared: Tensor, control: Tensor, layout: Layout, like: Step) -> Step:
    """Unknowns as a step; what is not solved for stays."""
    rotation, expression = torch.zeros_like(like.rotation), torch.zeros_like(like.expression)
    rotation[:, layout.joints] = frames[:, : layout.turns].unflatten(1, (-1, 3))
    expression[:, : layout.expressions] = frames[:, layout.turns : -3]
    offset = shared[layout.betas :].view(-1, 3) if layout.offsets else torch.zeros_like(like.joint_offset)
    return Step(rotation, expression, frames[:, -3:], shared[: layout.betas], offset, control)
