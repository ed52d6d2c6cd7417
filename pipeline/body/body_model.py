"""A parametric body of the SMPL-X schema, and reading one from a file.

The schema and not the number of vertices is what the project relies on, so that the open body
(``data/body/open_body.npz``) and the official ``SMPLX_NEUTRAL.npz`` are the same to every stage.

Frame of reference: metres, Y up, +Z is where the body faces, the subject's left is +X.
"""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pipeline.body.joints import JOINT_NAMES
from pipeline.errors import UserError, first_line

# shapedirs' last axis -> (shape columns, expression columns): releases since 2020, and before.
_LAYOUTS = {400: (slice(0, 300), slice(300, 400)), 20: (slice(0, 10), slice(10, 20))}


@dataclasses.dataclass(frozen=True)
class BodyModel:
    """A body: a template mesh, how it changes with shape, expression and pose, and its skeleton.

    Attributes:
        v_template: [V, 3] float32, the mean body in T pose, metres.
        faces: [F, 3] int64, triangles, counter-clockwise seen from outside.
        skinning_weights: [V, 55] float32, rows sum to 1.
        shape_directions: [V, 3, S] float32, metres a unit of beta. Trailing columns that are all
            zero in the file are dropped, so S is the number of betas that mean something.
        expression_directions: [V, 3, E] float32, metres a unit of expression, trimmed likewise.
        pose_directions: [V, 3, 486] float32, pose correctives, or None where the file has only zeros.
        joint_regressor: [55, V] float32, rows sum to 1.
        parents: the kinematic tree, -1 for the root; a parent always precedes its children.
        joint_names: 55 names.
        uv: [T, 2] float32, texture coordinates, origin at the bottom left; T = 0 if the file has none.
        uv_faces: [F, 3] int64, indices into ``uv``; [0, 3] if the file has none.
        digest: hexadecimal sha256 of all the arrays above, whatever the file's packing.
    """

    v_template: Tensor  # [V, 3]
    faces: Tensor  # [F, 3]
    skinning_weights: Tensor  # [V, 55]
    shape_directions: Tensor  # [V, 3, S]
    expression_directions: Tensor  # [V, 3, E]
    pose_directions: Tensor | None  # [V, 3, 486]
    joint_regressor: Tensor  # [55, V]
    parents: tuple[int, ...]
    joint_names: tuple[str, ...]
    uv: Tensor  # [T, 2]
    uv_faces: Tensor  # [F, 3]
    digest: str

    @property
    def topology(self) -> str:
        """Hexadecimal sha256 of vertex count and triangles: bodies that agree share landmarks."""
        digest = hashlib.sha256(str(len(self.v_template)).encode())
        digest.update(_canonical_bytes(self.faces.cpu().numpy()))
        return digest.hexdigest()

    def to(self, *args, **kwargs) -> BodyModel:
        """The same body with its tensors moved or, where they are floating point, cast."""

        def convert(value):
            if not isinstance(value, Tensor):
                return value
            if value.is_floating_point():
                return value.to(*args, **kwargs)
            device = torch.empty(0).to(*args, **kwargs).device
            return value.to(device)

        fields = dataclasses.fields(self)
        return dataclasses.replace(self, **{f.name: convert(getattr(self, f.name)) for f in fields})


def load_body(path: Path) -> BodyModel:
    """Read a body of the SMPL-X schema.

    Nothing is ever unpickled: entries that hold Python objects, as the official file has, are left
    alone, and one that is needed but holds objects is refused.

    Args:
        path: ``open_body.npz``, or an official ``SMPLX_*.npz`` (either release: 300 + 100 or
            10 + 10 blendshapes).

    Raises:
        UserError: the file is missing, is no npz, lacks an array, or an array has an impossible
            shape or value.

    >>> body = load_body(Path("data/body/open_body.npz"))
    >>> body.v_template.shape, body.skinning_weights.shape
    (torch.Size([13524, 3]), torch.Size([13524, 55]))
    """
    path = Path(path)
    try:
        archive = np.load(path, allow_pickle=False)
        if not isinstance(archive, np.lib.npyio.NpzFile):
            raise _refuse(path, "is a single array, not an npz archive")
        with archive:
            return _assemble(path, _Reader(path, archive))
    except FileNotFoundError:
        raise _refuse(path, "does not exist") from None
    except UserError:
        raise
    except Exception as error:  # a damaged archive raises nearly anything
        raise _refuse(path, f"cannot be read as npz ({first_line(error)})") from error


class _Reader:
    """Takes named arrays out of an npz and checks dtype, shape and finiteness."""

    def __init__(self, path: Path, archive: np.lib.npyio.NpzFile) -> None:
        self.path = path
        self._archive = archive

    def __contains__(self, name: str) -> bool:
        return name in self._archive.files

    def real(self, name: str, *shape: int | None) -> np.ndarray:
        """An array of finite real numbers as float32; None in ``shape`` is any length."""
        array = self._array(name, "fiu", shape)
        if not np.isfinite(array).all():
            raise _refuse(self.path, f"{name} holds numbers that are not finite")
        return array.astype(np.float32)

    def index(self, name: str, below: int, *shape: int | None) -> np.ndarray:
        """An array of whole numbers in [0, below) as int64."""
        array = self._array(name, "iuf", shape)
        with np.errstate(invalid="ignore"):
            whole = array.astype(np.int64)
        if (whole != array).any() or (whole < 0).any() or (whole >= below).any():
            raise _refuse(self.path, f"{name} holds indices outside 0..{below - 1}")
        return whole

    def tree(self) -> tuple[int, ...]:
        """The parents of the joints; the root's may be stored as -1 or as 2^32 - 1."""
        parents = self._array("kintree_table", "iu", (2, len(JOINT_NAMES)))[0].astype(np.int64)
        joints = np.arange(len(parents))
        if ((parents < 0) | (parents >= joints))[1:].any():
            raise _refuse(self.path, "kintree_table is no tree with parents before children")
        return (-1, *parents[1:].tolist())

    def _array(self, name: str, kinds: str, shape: tuple[int | None, ...]) -> np.ndarray:
        if name not in self:
            raise _refuse(self.path, f"has no array {name!r}")
        try:
            array = self._archive[name]
        except ValueError as error:  # what numpy raises rather than unpickle
            raise _refuse(self.path, f"{name} cannot be read without unpickling ({error})") from error
        if array.dtype.kind not in kinds:
            raise _refuse(self.path, f"{name} has dtype {array.dtype}")
        fits = array.ndim == len(shape) and all(
            want is None or want == got for want, got in zip(shape, array.shape, strict=True)
        )
        if not fits:
            wanted = " x ".join("any" if n is None else str(n) for n in shape)
            raise _refuse(self.path, f"{name} has shape {array.shape}, not {wanted}")
        return array


def _assemble(path: Path, read: _Reader) -> BodyModel:
    joints = len(JOINT_NAMES)
    template = read.real("v_template", None, 3)
    count = len(template)
    faces = read.index("f", count, None, 3)
    directions = read.real("shapedirs", count, 3, None)
    if directions.shape[2] not in _LAYOUTS:
        raise _refuse(path, f"shapedirs has {directions.shape[2]} columns, not 300 + 100 or 10 + 10")
    shape, expression = (_trimmed(directions[:, :, columns]) for columns in _LAYOUTS[directions.shape[2]])
    weights = _rows_sum_to_one(path, "weights", read.real("weights", count, joints))
    regressor = _rows_sum_to_one(path, "J_regressor", read.real("J_regressor", joints, count))
    pose = np.zeros(0, np.float32)
    if "posedirs" in read:
        pose = read.real("posedirs", count, 3, 9 * (joints - 1))
    uv = read.real("vt", None, 2) if "vt" in read else np.zeros((0, 2), np.float32)
    uv_faces = read.index("ft", len(uv), len(faces), 3) if "ft" in read else np.zeros((0, 3), np.int64)
    arrays: dict[str, np.ndarray | None] = dict(
        v_template=template, faces=faces, skinning_weights=weights, shape_directions=shape,
        expression_directions=expression, pose_directions=pose if pose.any() else None,
        joint_regressor=regressor, uv=uv, uv_faces=uv_faces,
    )  # fmt: skip
    parents = read.tree()
    tensors = {name: None if a is None else torch.from_numpy(a) for name, a in arrays.items()}
    return BodyModel(parents=parents, joint_names=JOINT_NAMES, digest=_digest(arrays, parents), **tensors)  # type: ignore[arg-type]


def _trimmed(directions: np.ndarray) -> np.ndarray:
    """Without the all-zero columns at the end; at least one column stays."""
    used = np.flatnonzero(directions.any(axis=(0, 1)))
    return np.ascontiguousarray(directions[:, :, : used[-1] + 1 if len(used) else 1])


def _rows_sum_to_one(path: Path, name: str, array: np.ndarray) -> np.ndarray:
    sums = array.sum(axis=1, dtype=np.float64)
    if np.abs(sums - 1).max() > 1e-2:
        raise _refuse(path, f"{name} has rows that do not sum to 1")
    return (array / sums[:, None]).astype(np.float32)


def _digest(arrays: dict[str, np.ndarray | None], parents: tuple[int, ...]) -> str:
    digest = hashlib.sha256(repr(parents).encode())
    for name in sorted(arrays):
        array = arrays[name]
        if array is not None:
            digest.update(f"{name} {array.shape} ".encode())
            digest.update(_canonical_bytes(array))
    return digest.hexdigest()


def _canonical_bytes(array: np.ndarray) -> bytes:
    return np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<"), copy=False).tobytes()


def _refuse(path: Path, what: str) -> UserError:
    return UserError(
        f"{path} {what}: use data/body/open_body.npz, or a SMPL-X model file (SMPLX_NEUTRAL.npz) "
        "from smpl-x.is.tue.mpg.de"
    )
