"""Expressions by name: what each does to the body's coefficients.

The open body's file names its face units as ARKit does, but for one thing: a unit that ARKit has for the left
and the right side is stored as both together and as left without right, ``mouthSmile`` and
``mouthSmileLeftMinusRight``. Here they are ``mouthSmileLeft`` and ``mouthSmileRight`` again. What ARKit has
and no coefficient does is the skeleton's: ``jawOpen`` and its like turn the joint jaw, ``eyeLookInLeft`` and
its like the joints left_eye and right_eye; ``mouthClose`` and ``tongueOut`` do not exist.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import torch
from torch import Tensor

from pipeline.errors import UserError

_UNITS = "expression_units"  # the array of the names
_FULL = 3.0  # the coefficient that is a named unit's full range (data/body/PROVENANCE.md)
_APART = "LeftMinusRight"


@dataclasses.dataclass(frozen=True)
class Expressions:
    """A body's expressions by name.

    Attributes:
        names: the M names.
        coefficients: [M, E], psi of each expression at weight 1, its full range.
        named: False where the body's file has no names, and these are numbers.

    >>> pair = Expressions(("smile", "frown"), torch.tensor([[3.0, 0.0], [0.0, 3.0]]))
    >>> pair.psi({"frown": 0.5})
    tensor([0.0000, 1.5000])
    """

    names: tuple[str, ...]
    coefficients: Tensor  # [M, E]
    named: bool = True

    def psi(self, weights: Mapping[str, float]) -> Tensor:
        """The coefficients of some expressions together: name -> weight, 1 for its full range; [E].

        Raises:
            UserError: there is no expression of that name; shows the near ones.
        """
        psi = self.coefficients.new_zeros(self.coefficients.shape[1])
        for name, weight in weights.items():
            if name not in self.names:
                raise UserError(f"there is no expression {name!r}; there are {', '.join(self.names)}")
            psi += weight * self.coefficients[self.names.index(name)]
        return psi


def read_expressions(body_file: Path, count: int) -> Expressions:
    """The expressions of a body's file.

    Args:
        body_file: ``open_body.npz``, or an official file; what names no units has ``expression_00`` and so
            on, of which weight 1 is one coefficient of 1.
        count: of the body's coefficients, E.

    Raises:
        UserError: the file cannot be read.
    """
    try:
        with np.load(body_file, allow_pickle=False) as archive:
            names = archive[_UNITS].tolist() if _UNITS in archive.files else []
    except (OSError, EOFError, ValueError, TypeError, AttributeError, BadZipFile) as error:
        raise UserError(
            f"{body_file}: the names of its expressions cannot be read ({error}): get it again"
        ) from None
    usable = isinstance(names, list) and len(names) == count == len(set(map(str, names)))
    if not usable or not all(isinstance(name, str) for name in names):
        numbered = tuple(f"expression_{place:02d}" for place in range(count))
        return Expressions(numbered, torch.eye(count), named=False)
    return _with_sides(names)


def _with_sides(names: list[str]) -> Expressions:
    """Units that are stored as both sides and left minus right, as a left and a right one."""
    found: dict[str, Tensor] = {}
    unit = _FULL * torch.eye(len(names))
    for place, name in enumerate(names):
        stem = name.removesuffix(_APART)
        if name != stem and stem in names:
            continue  # with its stem
        if f"{name}{_APART}" in names:
            apart = unit[names.index(f"{name}{_APART}")]
            found[f"{name}Left"], found[f"{name}Right"] = (unit[place] + apart) / 2, (unit[place] - apart) / 2
        else:
            found[name] = unit[place]
    return Expressions(tuple(found), torch.stack(list(found.values())))
