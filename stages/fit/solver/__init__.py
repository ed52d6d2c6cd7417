"""Second-order minimisation of the objective: batched Levenberg-Marquardt, coarse to fine.

Coarse in time: the way is found on every fourth frame, then the frames between are filled in. Coarse in
the loss: a wide unit of error first, see ``coarse.softened``. Shape is held until the pose is about right,
since a wrong pose would bend it far; the offsets come last.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable

import torch
from torch import Tensor

from pipeline.numba_kernels import threads
from stages.fit.objective import Objective
from stages.fit.optimise import Watch, ignore
from stages.fit.parameters import PER_FRAME, Parameters
from stages.fit.solver.coarse import softened, thinned
from stages.fit.solver.levenberg import Levenberg, Unknowns
from stages.fit.solver.state import between

_STRIDE, _FEW = 4, 16  # every fourth frame, of clips of at least 16


@dataclasses.dataclass(frozen=True)
class Stage:
    """Steps of one kind.

    Attributes:
        steps: how many at most.
        unit: pixels that are the unit of error.
        robust: let errors saturate.
        turns: whether joints turn and expressions change; else the body only moves.
        shared, offsets: whether shape, and joint offsets and face controls, are fitted.
    """

    steps: int
    unit: float
    robust: bool = True
    turns: bool = True
    shared: bool = True
    offsets: bool = False


COARSE = (Stage(1, 10.0, robust=False, turns=False, shared=False), Stage(8, 10.0, robust=False, shared=False),
          Stage(4, 4.0))  # fmt: skip
FINE = (Stage(2, 4.0), Stage(3, 2.0, offsets=True), Stage(2, 1.0, offsets=True))
STEPS = sum(stage.steps for stage in (*COARSE, *FINE))
"""How many steps a fit takes at most."""

_ENOUGH = 1e-4  # relative improvement below which a stage ends


def solve(
    objective: Objective,
    initial: Parameters,
    frozen: frozenset[str] = frozenset(),
    minibatch: int = 256,
    watch: Watch = ignore,
) -> Parameters:
    """Fit a clip, as ``optimise.optimise`` does by Adam.

    Args:
        objective: its loss.
        initial: where to start.
        frozen: which of expression, joint_offset and face_control stay as they are.
        minibatch: frames that are posed and coupled at a time, which bounds the memory. Couplings between
            the last of one and the first of the next are left to the gradient.
        watch: called after each step, with parameters of all frames.

    Raises:
        NotFiniteError: the loss or its gradient is not finite.
    """
    taken = 0
    with threads(1):
        every = torch.arange(len(objective.times))
        rows = every[::_STRIDE] if len(every) >= _FEW else every
        rows = torch.unique(torch.cat([rows, every[-1:]]))
        few = {name: getattr(initial, name)[rows] for name in PER_FRAME}
        parameters = dataclasses.replace(initial, **few).detached().orthonormal()

        def whole(found: Parameters) -> Parameters:
            return _filled(objective, initial, found, rows)

        run = Levenberg(thinned(objective, rows), minibatch)
        for stage in COARSE:
            parameters, taken = _take(run, stage, parameters, frozen, taken, watch, whole)
        parameters = whole(parameters)
        run = Levenberg(objective, minibatch)
        for stage in FINE:
            parameters, taken = _take(run, stage, parameters, frozen, taken, watch, lambda found: found)
    return parameters


def _take(
    run: Levenberg,
    stage: Stage,
    parameters: Parameters,
    frozen: frozenset[str],
    taken: int,
    watch: Watch,
    whole: Callable[[Parameters], Parameters],
) -> tuple[Parameters, int]:
    """A stage's steps; ``whole`` makes all frames' parameters of the run's. Returns steps taken so far."""
    objective = softened(run.objective, stage.unit)
    movable = torch.nonzero(run.objective.movable.flatten())[:, 0]
    unknowns = Unknowns(
        joints=movable if stage.turns else movable[:0],
        expression=stage.turns and "expression" not in frozen,
        shared=stage.shared,
        joint_offset=stage.offsets and "joint_offset" not in frozen,
        face_control=stage.offsets and "face_control" not in frozen,
    )
    before = math.inf
    for _ in range(stage.steps):
        parameters, loss, better = run.step(parameters, objective, stage.robust, unknowns)
        taken += 1
        watch(taken, loss, functools.partial(whole, parameters))
        if not better or before - loss < _ENOUGH * loss:
            break
        before = loss
    return parameters, taken


def _filled(objective: Objective, initial: Parameters, found: Parameters, rows: Tensor) -> Parameters:
    """Parameters of all frames from those of some; joints that nothing was seen of stay where they began."""
    parameters = between(found, rows, objective.times)
    matrices = torch.where(objective.movable, parameters.matrices, initial.matrices)
    return parameters.with_matrices(matrices)
