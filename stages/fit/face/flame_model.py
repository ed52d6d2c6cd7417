"""The FLAME head of the user's own, as far as the face-first step needs it.

FLAME (Li et al. 2017) is licensed to its users one by one and not shipped here. Its head lies in the
axes of the body (Y up, +Z front, the subject's left is +X), in metres.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pipeline.errors import UserError
from pipeline.untrusted import GIGABYTE, bounded_bytes, parse_pickled_arrays

SHAPES = 300
"""Columns of ``shapedirs`` that are shape; the rest are expressions."""

_NAMES = ("v_template", "f", "shapedirs", "J_regressor")
JOINTS = ("root", "neck", "jaw", "left_eye", "right_eye")


@dataclasses.dataclass(frozen=True)
class FlameModel:
    """A FLAME head.

    Attributes:
        v_template: [V, 3], metres.
        faces: [F, 3] int64.
        shape_directions: [V, 3, 300]; expression_directions: [V, 3, E], 100 in the official files.
        joints: [5, 3], metres, of the mean head, in the order of ``JOINTS``.
    """

    v_template: Tensor
    faces: Tensor
    shape_directions: Tensor
    expression_directions: Tensor
    joints: Tensor

    def shaped(self, shape: Tensor) -> Tensor:
        """The head of an identity at rest, without expression: [S <= 300] -> [V, 3]."""
        return self.v_template + self.shape_directions[..., : len(shape)] @ shape


def load_flame(path: Path) -> FlameModel:
    """Read FLAME from the official pickle (``generic_model.pkl``) or an npz with the same names.

    Read are ``v_template``, ``f``, ``shapedirs`` and ``J_regressor``. Nothing in either kind of file is
    executed; a pickle that names anything but arrays is refused.

    Raises:
        UserError: the file is missing, no FLAME model, or its arrays disagree.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"{path} does not exist: fit.flame_model must be a FLAME model file (npz or pkl)")
    arrays = _npz(path) if path.suffix.lower() == ".npz" else _pickle(path)
    for name in _NAMES:
        if name not in arrays:
            raise UserError(f"{path} has no array {name!r}, so it is no FLAME model: give generic_model.pkl")
    template, faces = arrays["v_template"], arrays["f"].astype(np.int64)
    directions, regressor = arrays["shapedirs"], arrays["J_regressor"]
    count = len(template)
    agree = (
        template.shape == (count, 3)
        and faces.ndim == 2
        and faces.shape[1] == 3
        and directions.ndim == 3
        and directions.shape[:2] == (count, 3)
        and directions.shape[2] > SHAPES
        and regressor.shape == (len(JOINTS), count)
    )
    if not agree or faces.min() < 0 or faces.max() >= count:
        shapes = {name: arrays[name].shape for name in _NAMES}
        raise UserError(f"{path} is no FLAME model, whose arrays have other shapes than {shapes}")
    if not all(np.isfinite(a).all() for a in (template, directions, regressor)):
        raise UserError(f"{path} holds numbers that are not finite: get the FLAME model again")
    return FlameModel(
        v_template=torch.from_numpy(template).float(),
        faces=torch.from_numpy(faces),
        shape_directions=torch.from_numpy(directions[..., :SHAPES]).float(),
        expression_directions=torch.from_numpy(directions[..., SHAPES:]).float(),
        joints=torch.from_numpy(regressor @ template).float(),
    )


def _npz(path: Path) -> dict[str, np.ndarray]:
    """The numeric arrays of an npz."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            wanted = [
                name for name in ("v_template", "f", "shapedirs", "J_regressor") if name in archive.files
            ]
            return {name: archive[name] for name in wanted}
    except Exception as error:  # a damaged archive raises nearly anything
        raise UserError(f"{path} cannot be read as npz ({error}): give a FLAME model file") from error


def _pickle(path: Path) -> dict[str, np.ndarray]:
    """The arrays of FLAME's pickle: of Python 2, with scipy's and chumpy's objects in it; 53 MB."""
    remedy = "give generic_model.pkl, or an npz of it"
    content = bounded_bytes(path, GIGABYTE, remedy)
    try:
        return parse_pickled_arrays(content)
    except Exception as error:  # a damaged pickle raises nearly anything
        raise UserError(f"{path} cannot be read as a FLAME model ({error}): {remedy}") from error
