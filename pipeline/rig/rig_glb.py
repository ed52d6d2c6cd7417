"""A rigged mesh as a ``.glb`` file: skeleton, skin, colours, expressions as morph targets.

The material is unlit (KHR_materials_unlit), for the clip's light is in its colours already; programs that do
not know the extension light it as a matt surface.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pygltflib as gltf

from pipeline.files.gltf_file import GltfBuilder
from pipeline.rig.rigged_mesh import SET, RiggedMesh
from pipeline.rig.surface_colors import SurfaceColors, bake_texture

TEXTURE = 1024  # pixels
_QUALITY = 95  # of JPEG
_UNLIT = "KHR_materials_unlit"


def write_rig_glb(
    path: Path, mesh: RiggedMesh, colors: SurfaceColors, name: str = "avatar", texture: int = TEXTURE
) -> None:
    """Writes the mesh; equal input gives equal bytes.

    Args:
        path: the file.
        mesh: in its rest pose; of one without triangles only the skeleton is written.
        colors: of its surface: a texture where the mesh has coordinates for one, else a colour a vertex.
        name: of the skeleton's root, any text.
        texture: its side, pixels.
    """
    builder = GltfBuilder()
    joints = _add_skeleton(builder, mesh, name)
    if len(mesh.faces):
        _add_mesh(builder, mesh, colors, texture)
        node = gltf.Node(name="body", mesh=0, skin=_add_skin(builder, mesh, joints))
        builder.add_node(node, root=True)
    builder.write(path)


def _add_skeleton(builder: GltfBuilder, mesh: RiggedMesh, name: str) -> list[int]:
    """The joints as nodes under one of the avatar's name; returns their numbers."""
    root = builder.add_node(gltf.Node(name=name), root=True)
    places = []
    for joint, parent in enumerate(mesh.parents):
        origin = mesh.joints[parent] if parent >= 0 else np.zeros(3)
        node = gltf.Node(name=mesh.joint_names[joint], translation=(mesh.joints[joint] - origin).tolist())
        places.append(builder.add_node(node))
        above = builder.asset.nodes[places[parent] if parent >= 0 else root]
        above.children = [*(above.children or []), places[-1]]
    return places


def _add_skin(builder: GltfBuilder, mesh: RiggedMesh, joints: list[int]) -> int:
    inverse = np.tile(np.eye(4, dtype=np.float32), (len(mesh.joints), 1, 1))
    inverse[:, 3, :3] = -mesh.joints  # columns come first in glTF
    matrices = builder.accessor(inverse.reshape(-1, 16), target=None)
    builder.asset.skins.append(gltf.Skin(joints=joints, skeleton=joints[0], inverseBindMatrices=matrices))
    return len(builder.asset.skins) - 1


def _add_mesh(builder: GltfBuilder, mesh: RiggedMesh, colors: SurfaceColors, texture: int) -> None:
    attributes = {
        "POSITION": builder.accessor(mesh.vertices, bounds=True),
        "NORMAL": builder.accessor(mesh.normals),
    }
    for number, start in enumerate(range(0, mesh.weights.shape[1], SET)):
        some = slice(start, start + SET)
        attributes[f"JOINTS_{number}"] = builder.accessor(mesh.joint_ids[:, some].astype(np.uint8))
        attributes[f"WEIGHTS_{number}"] = builder.accessor(mesh.weights[:, some])
    material = gltf.Material(
        name="skin",
        pbrMetallicRoughness=gltf.PbrMetallicRoughness(metallicFactor=0.0, roughnessFactor=1.0),
        extensions={_UNLIT: {}},
        alphaCutoff=None,
    )
    builder.asset.extensionsUsed = [_UNLIT]
    if mesh.uv.shape[1]:
        attributes["TEXCOORD_0"] = builder.accessor(mesh.uv)
        _add_texture(builder, bake_texture(mesh, colors, texture))
        material.pbrMetallicRoughness.baseColorTexture = gltf.TextureInfo(index=0)
    else:
        rgb = _linear(colors.at(mesh.vertices, mesh.normals))
        rgba = np.column_stack([rgb, np.ones(len(mesh))]).astype(np.float32)
        attributes["COLOR_0"] = builder.accessor(rgba)
    builder.asset.materials.append(material)
    kind = np.uint16 if len(mesh) < 1 << 16 else np.uint32
    primitive = gltf.Primitive(
        attributes=gltf.Attributes(**attributes),
        indices=builder.accessor(mesh.faces.reshape(-1).astype(kind), target=gltf.ELEMENT_ARRAY_BUFFER),
        material=0,
        targets=[_add_morph(builder, mesh, place) for place in range(len(mesh.morphs))] or None,
    )
    named = {"targetNames": [morph.name for morph in mesh.morphs]}
    builder.asset.meshes.append(
        gltf.Mesh(
            name="body",
            primitives=[primitive],
            weights=[0.0] * len(mesh.morphs) or None,
            extras=named if mesh.morphs else {},
        )
    )


def _add_morph(builder: GltfBuilder, mesh: RiggedMesh, place: int) -> gltf.Attributes:
    morph = mesh.morphs[place]
    return gltf.Attributes(POSITION=builder.sparse_accessor(morph.rows, morph.offsets, len(mesh)))


def _add_texture(builder: GltfBuilder, picture: np.ndarray) -> None:
    quality = [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
    whole, coded = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), quality)
    assert whole
    view = builder.view(coded.tobytes())
    builder.asset.images.append(gltf.Image(bufferView=view, mimeType="image/jpeg", name="colours"))
    builder.asset.samplers.append(gltf.Sampler(magFilter=gltf.LINEAR, minFilter=gltf.LINEAR_MIPMAP_LINEAR))
    builder.asset.textures.append(gltf.Texture(source=0, sampler=0))


def _linear(srgb: np.ndarray) -> np.ndarray:
    """Colours in [0, 1] as sRGB encodes them, in linear light, which vertex colours are in."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
