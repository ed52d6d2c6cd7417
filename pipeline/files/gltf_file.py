"""Building a binary glTF 2.0 file (``.glb``): arrays to accessors, one buffer; the rest is pygltflib's."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pygltflib as gltf

_COMPONENTS = {
    np.dtype(np.uint8): gltf.UNSIGNED_BYTE,
    np.dtype(np.uint16): gltf.UNSIGNED_SHORT,
    np.dtype(np.uint32): gltf.UNSIGNED_INT,
    np.dtype(np.float32): gltf.FLOAT,
}
_TYPES = {1: gltf.SCALAR, 2: gltf.VEC2, 3: gltf.VEC3, 4: gltf.VEC4, 16: gltf.MAT4}


class GltfBuilder:
    """A glTF asset in the making, with one scene and one buffer.

    Attributes:
        asset: pygltflib's, to which nodes, meshes and materials are appended.
    """

    def __init__(self) -> None:
        self.asset = gltf.GLTF2(
            asset=gltf.Asset(version="2.0", generator="flexiavatar"), scene=0, scenes=[gltf.Scene(nodes=[])]
        )
        self._blob = bytearray()

    def add_node(self, node: gltf.Node, root: bool = False) -> int:
        """Appends a node, to the scene's own where it is a root; returns its number."""
        self.asset.nodes.append(node)
        place = len(self.asset.nodes) - 1
        if root:
            self.asset.scenes[0].nodes.append(place)
        return place

    def view(self, content: bytes, target: int | None = None) -> int:
        """A piece of the buffer, aligned to four bytes; returns its number."""
        self._blob += bytes(-len(self._blob) % 4)
        self.asset.bufferViews.append(
            gltf.BufferView(buffer=0, byteOffset=len(self._blob), byteLength=len(content), target=target)
        )
        self._blob += content
        return len(self.asset.bufferViews) - 1

    def accessor(
        self,
        values: np.ndarray,  # [N] or [N, C], of at least one row
        target: int | None = gltf.ARRAY_BUFFER,
        normalized: bool = False,
        bounds: bool = False,
    ) -> int:
        """An array as an accessor; returns its number.

        Args:
            values: uint8, uint16, uint32 or float32.
            target: what it is for; None for what is neither vertices nor triangles.
            normalized: integers stand for [0, 1].
            bounds: with its least and greatest values, as positions must have them.
        """
        values = np.ascontiguousarray(values)
        rows = values.reshape(len(values), -1)
        padding = -rows.dtype.itemsize * rows.shape[1] % 4
        if target == gltf.ARRAY_BUFFER and padding:  # a vertex attribute's rows begin at multiples of four
            raise ValueError(f"rows of {rows.shape[1]} {rows.dtype} are not a multiple of four bytes")
        self.asset.accessors.append(
            gltf.Accessor(
                bufferView=self.view(rows.astype(rows.dtype.newbyteorder("<")).tobytes(), target),
                componentType=_COMPONENTS[rows.dtype],
                count=len(rows),
                type=_TYPES[rows.shape[1]],
                normalized=normalized or None,
                **(_bounds(rows) if bounds else {}),
            )
        )
        return len(self.asset.accessors) - 1

    def sparse_accessor(self, rows: np.ndarray, values: np.ndarray, count: int) -> int:
        """An accessor of float32 that is zero but in some rows; returns its number.

        Args:
            rows: [M] increasing, at least one.
            values: [M, C] float32.
            count: of all rows.
        """
        kind = np.uint16 if count <= 1 << 16 else np.uint32
        dense = np.vstack([values, np.zeros((1, values.shape[1]))]) if len(rows) < count else values
        self.asset.accessors.append(
            gltf.Accessor(
                byteOffset=None,  # of no view
                componentType=gltf.FLOAT,
                count=count,
                type=_TYPES[values.shape[1]],
                **_bounds(dense.astype(np.float32)),
                sparse=gltf.Sparse(
                    count=len(rows),
                    indices=gltf.AccessorSparseIndices(
                        bufferView=self.view(rows.astype(np.dtype(kind).newbyteorder("<")).tobytes()),
                        componentType=_COMPONENTS[np.dtype(kind)],
                    ),
                    values=gltf.AccessorSparseValues(bufferView=self.view(values.astype("<f4").tobytes())),
                ),
            )
        )
        return len(self.asset.accessors) - 1

    def write(self, path: Path) -> None:
        """Writes the ``.glb``; equal content gives equal bytes."""
        if self._blob:
            self.asset.buffers = [gltf.Buffer(byteLength=len(self._blob))]
        # pygltflib's own writer adds a buffer of no bytes where there is none, which the format forbids.
        chunks = _chunk(b"JSON", self.asset.to_json(separators=(",", ":")).encode(), b" ")
        chunks += _chunk(b"BIN\0", bytes(self._blob), b"\0") if self._blob else b""
        Path(path).write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def _chunk(kind: bytes, content: bytes, padding: bytes) -> bytes:
    content += padding * (-len(content) % 4)
    return struct.pack("<I4s", len(content), kind) + content


def _bounds(rows: np.ndarray) -> dict[str, list[float]]:
    return {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
