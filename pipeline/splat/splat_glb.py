"""Gaussians as a ``.glb`` file with KHR_gaussian_splatting, the extension that Khronos ratified.

A mesh of points with the attributes ROTATION (x, y, z, w), SCALE (metres), OPACITY (in [0, 1]) and the
constant term of spherical harmonics; ``COLOR_0`` shows the points in programs that do not know the extension.
The axes are glTF's, which are ours: Y up, the person faces +Z.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pygltflib as gltf

from pipeline.files.gltf_file import GltfBuilder
from pipeline.splat.gaussians import Gaussians
from pipeline.splat.stored_splats import StoredSplats, stored_splats

EXTENSION = "KHR_gaussian_splatting"
_DECODE = 2.2  # COLOR_0 is linear; near enough for points that stand in for splats


def write_splat_glb(path: Path, gaussians: Gaussians, name: str = "avatar") -> None:
    """Write Gaussians; those with a number that is not finite are left out.

    Args:
        path: the file.
        gaussians: in a world whose Y axis points up. Where none is left the scene has a node without a mesh.
        name: of the node, any text.
    """
    splats, builder = stored_splats(gaussians), GltfBuilder()
    node = gltf.Node(name=name)
    if len(splats):
        builder.asset.extensionsUsed = [EXTENSION]
        builder.asset.meshes.append(gltf.Mesh(name=name, primitives=[_primitive(builder, splats)]))
        node.mesh = 0
    builder.add_node(node, root=True)
    builder.write(path)


def _primitive(builder: GltfBuilder, splats: StoredSplats) -> gltf.Primitive:
    rotation = np.roll(splats.quaternions, -1, axis=1)
    rgba = np.concatenate([np.clip(splats.colors, 0, 1) ** _DECODE, splats.opacities[:, None]], 1)
    columns = {"ROTATION": rotation, "SCALE": splats.scales, "OPACITY": splats.opacities,
               "SH_DEGREE_0_COEF_0": splats.harmonics}  # fmt: skip
    position = builder.accessor(splats.means.astype(np.float32), bounds=True)
    attributes = {
        f"{EXTENSION}:{name}": builder.accessor(values.astype(np.float32)) for name, values in columns.items()
    }
    color = builder.accessor(np.rint(255 * rgba).astype(np.uint8), normalized=True)
    return gltf.Primitive(
        attributes=gltf.Attributes(POSITION=position, COLOR_0=color, **attributes),
        mode=gltf.POINTS,
        extensions={EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display",
                                "projection": "perspective", "sortingMethod": "cameraDistance"}},
    )  # fmt: skip
