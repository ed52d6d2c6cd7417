"""A ``.glb`` as arrays, read by pygltflib and numpy; splats in it as Gaussians."""

import numpy as np
import pygltflib
import torch

from pipeline.splat import Gaussians

_KINDS = {5121: np.uint8, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
_SIZES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_SH_0 = 0.28209479177387814


class Glb:
    """A file; ``asset`` is pygltflib's."""

    def __init__(self, path):
        self.asset = pygltflib.GLTF2().load(str(path))
        self.blob = self.asset.binary_blob() or b""

    def _view(self, number, kind, count):
        start = self.asset.bufferViews[number].byteOffset
        return np.frombuffer(self.blob, np.dtype(kind).newbyteorder("<"), count, start)

    def array(self, number):
        """An accessor's values, [N, C]."""
        accessor = self.asset.accessors[number]
        size, kind = _SIZES[accessor.type], _KINDS[accessor.componentType]
        values = np.zeros((accessor.count, size), kind)
        if accessor.bufferView is not None:
            values = self._view(accessor.bufferView, kind, accessor.count * size).reshape(-1, size)
        if accessor.sparse is not None:
            some = accessor.sparse
            rows = self._view(some.indices.bufferView, _KINDS[some.indices.componentType], some.count)
            values[rows] = self._view(some.values.bufferView, kind, some.count * size).reshape(-1, size)
        return values

    def attribute(self, name):
        """An attribute of the first mesh's only primitive."""
        return self.array(getattr(self.asset.meshes[0].primitives[0].attributes, name))

    def morphs(self):
        """Name -> [N, 3] displacements."""
        mesh = self.asset.meshes[0]
        targets = mesh.primitives[0].targets
        names = mesh.extras["targetNames"]
        return {name: self.array(one["POSITION"]) for name, one in zip(names, targets, strict=True)}

    def posed(self, turns, weights):
        """The skinned mesh as the format defines it: [N, 3] float64.

        Args:
            turns: joint name -> 3 x 3 rotation relative to its parent.
            weights: morph target -> weight.
        """
        nodes, skin = self.asset.nodes, self.asset.skins[0]
        world = {}

        def walk(number, above):
            node, local = nodes[number], np.eye(4)
            local[:3, :3] = turns.get(node.name, np.eye(3))
            local[:3, 3] = node.translation or (0, 0, 0)
            world[number] = above @ local
            for child in node.children or []:
                walk(child, world[number])

        for root in self.asset.scenes[0].nodes:
            walk(root, np.eye(4))
        inverse = self.array(skin.inverseBindMatrices).reshape(-1, 4, 4).swapaxes(1, 2).astype(np.float64)
        carried = np.stack([world[joint] @ inverse[place] for place, joint in enumerate(skin.joints)])
        points = self.attribute("POSITION").astype(np.float64)
        points = points + sum(weight * self.morphs()[name] for name, weight in weights.items())
        attributes, blended = self.asset.meshes[0].primitives[0].attributes, 0
        for number in range(2):
            if hasattr(attributes, f"JOINTS_{number}"):
                joints, shares = self.attribute(f"JOINTS_{number}"), self.attribute(f"WEIGHTS_{number}")
                blended = blended + np.einsum("nk,nkab->nab", shares.astype(np.float64), carried[joints])
        return (blended[:, :3, :3] @ points[..., None])[..., 0] + blended[:, :3, 3]


def read_splat_glb(path):
    """Gaussians in float32."""
    glb = Glb(path)

    def values(name):
        return torch.from_numpy(glb.attribute(f"KHR_gaussian_splatting:{name}").copy())

    return Gaussians(
        means=torch.from_numpy(glb.attribute("POSITION").copy()),
        quaternions=values("ROTATION").roll(1, 1),
        scales=values("SCALE"),
        colors=0.5 + _SH_0 * values("SH_DEGREE_0_COEF_0"),
        opacities=values("OPACITY")[:, 0],
    )
