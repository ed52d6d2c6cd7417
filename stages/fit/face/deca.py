"""DECA's parameters of every frame, in the layout of ExAvatar's and FlexiAvatar's ``flame_init/``."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pipeline.clip.frame_files import ClipFrames, frame_files
from pipeline.errors import UserError
from pipeline.files.text_encoding import decode_text

_REMEDY = "give the folder that holds flame_params/ and shape_param.json as fit.face_init"


@dataclasses.dataclass(frozen=True)
class FlameParameters:
    """FLAME's parameters over T frames.

    Attributes:
        shape: [S], of the person.
        expression: [T, K], 0 where not valid.
        jaw: [T, 3], rotation vectors, 0 where not valid.
        valid: [T] bool.
    """

    shape: Tensor
    expression: Tensor
    jaw: Tensor
    valid: Tensor


def read_flame_parameters(
    folder: Path,
    frames: np.ndarray,
    source: ClipFrames | None = None,
    counted_from: int | None = None,
    log: Callable[[str], None] = lambda line: None,
) -> FlameParameters:
    """Read ``flame_params/``, a JSON file a frame, of some frames, and ``shape_param.json``.

    A frame without a file, or whose ``is_valid`` is false or whose values are null, is not valid. Root,
    neck and eyes are not read: where the head is follows from the registration.

    Args:
        folder: the ``flame_init`` folder.
        frames: [T], frame numbers of the clip.
        source: all frames of the footage, which the names mean; None: their numbers are frame numbers.
        counted_from: the first frame's number where the user says so.
        log: told in one line how files were matched.

    Raises:
        UserError: the folder or the shape is missing, a file is damaged, or no frame has a file.
    """
    shape = _numbers(folder / "shape_param.json", _json(folder / "shape_param.json"))
    files = frame_files(folder / "flame_params", (".json",), source, counted_from, log)
    found = [_frame(files.get(frame)) for frame in frames.tolist()]
    if all(entry is None for entry in found):
        raise UserError(f"{folder}/flame_params has no file for any frame of the clip: {_REMEDY}")
    known = [entry for entry in found if entry]
    size = len(known[0][0]) if known else 0
    if any(len(expression) != size for expression, _ in known):
        raise UserError(f"{folder}/flame_params holds expressions of several lengths: run DECA again")
    expression, jaw = np.zeros((len(frames), size), np.float32), np.zeros((len(frames), 3), np.float32)
    valid = np.zeros(len(frames), bool)
    for row, entry in enumerate(found):
        if entry:
            expression[row], jaw[row], valid[row] = entry[0], entry[1], True
    return FlameParameters(*(torch.from_numpy(a) for a in (shape, expression, jaw, valid)))


def _frame(path: Path | None) -> tuple[np.ndarray, np.ndarray] | tuple[()] | None:
    """Expression and jaw; empty where the face was not found, None where there is no file."""
    if path is None:
        return None
    content = _json(path)
    if not isinstance(content, dict) or "expr" not in content or "jaw_pose" not in content:
        raise UserError(f"{path} has no expr and jaw_pose: {_REMEDY}")
    if not content.get("is_valid", True) or content["expr"] is None or content["jaw_pose"] is None:
        return ()
    expression, jaw = (_numbers(path, content[name]) for name in ("expr", "jaw_pose"))
    if len(jaw) != 3:
        raise UserError(f"{path} has a jaw_pose of {len(jaw)} numbers, not 3: {_REMEDY}")
    return expression, jaw


def _json(path: Path) -> object:
    try:
        return json.loads(decode_text(path.read_bytes()))
    except FileNotFoundError:
        raise UserError(f"{path} is missing: {_REMEDY}") from None
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(f"{path} cannot be read as JSON ({error}): {_REMEDY}") from error


def _numbers(path: Path, values: object) -> np.ndarray:
    """A list of finite numbers, [K] float32; nested lists are flattened."""
    try:
        array = np.asarray(values, np.float32).reshape(-1)
    except (TypeError, ValueError, OverflowError) as error:
        raise UserError(f"{path} holds something else than numbers: {_REMEDY}") from error
    if array.size == 0 or not np.isfinite(array).all():
        raise UserError(f"{path} holds numbers that are not finite, or none: {_REMEDY}")
    return array
