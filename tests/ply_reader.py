"""A ``.ply`` file of splats as Gaussians, read by trimesh and not by the library that wrote it."""

import numpy as np
import torch
import trimesh

from pipeline.splat import Gaussians
from pipeline.splat.stored_splats import SH_0


def read_ply(path):
    """Gaussians in float32."""
    rows = trimesh.load(path).metadata["_ply_raw"]["vertex"]["data"]

    def columns(names):
        return torch.from_numpy(np.stack([rows[name] for name in names.split()], -1).astype(np.float32))

    return Gaussians(
        means=columns("x y z"),
        quaternions=columns("rot_0 rot_1 rot_2 rot_3"),
        scales=columns("scale_0 scale_1 scale_2").exp(),
        colors=0.5 + SH_0 * columns("f_dc_0 f_dc_1 f_dc_2"),
        opacities=torch.sigmoid(columns("opacity"))[:, 0],
    )
