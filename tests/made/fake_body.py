"""A tiny body file in the official SMPL-X layout, made of random numbers."""

from pathlib import Path

import numpy as np

VERTICES = 24
PARENTS = (
    -1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 15, 15, 15,
    20, 25, 26, 20, 28, 29, 20, 31, 32, 20, 34, 35, 20, 37, 38,
    21, 40, 41, 21, 43, 44, 21, 46, 47, 21, 49, 50, 21, 52, 53,
)  # fmt: skip


class Trap:
    """Creates a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return (Path.touch, (self.path,))


def official_arrays(columns: int = 400, seed: int = 0) -> dict[str, np.ndarray]:
    """The arrays of a SMPLX_NEUTRAL.npz, with its dtypes, over a body of 24 vertices."""
    rng = np.random.default_rng(seed)
    weights = rng.random((VERTICES, 55)) ** 8
    regressor = rng.random((55, VERTICES)) ** 4
    return {
        "v_template": rng.normal(size=(VERTICES, 3)),
        "f": rng.integers(0, VERTICES, (40, 3)).astype(np.uint32),
        "weights": weights / weights.sum(1, keepdims=True),
        "shapedirs": 0.01 * rng.normal(size=(VERTICES, 3, columns)),
        "posedirs": 0.01 * rng.normal(size=(VERTICES, 3, 486)),
        "J_regressor": regressor / regressor.sum(1, keepdims=True),
        "kintree_table": np.stack([[2**32 - 1, *PARENTS[1:]], np.arange(55)]),
        "vt": rng.random((30, 2)),
        "ft": rng.integers(0, 30, (40, 3)).astype(np.uint32),
        "hands_meanl": np.zeros(45),
    }


def write_official(
    path: Path, trap: Path | None = None, columns: int = 400, **changes: np.ndarray | None
) -> Path:
    """Write such a file; ``changes`` replace arrays, or leave out those that are None."""
    arrays = {name: a for name, a in (official_arrays(columns) | changes).items() if a is not None}
    if trap is not None:
        arrays["joint2num"] = np.array({"pelvis": Trap(trap)}, dtype=object)
        arrays["part2num"] = np.array([Trap(trap)], dtype=object)
    np.savez(path, allow_pickle=True, **arrays)
    return path
