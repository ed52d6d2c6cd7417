"""Tiny ONNX models as bytes, by the protobuf schema (onnx.proto), without the onnx package."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def varint(number: int) -> bytes:
    out = bytearray()
    while True:
        number, low = number >> 7, number & 0x7F
        out.append(low | (0x80 if number else 0))
        if not number:
            return bytes(out)


def number(field: int, value: int) -> bytes:
    return varint(field << 3) + varint(value)


def block(field: int, content: bytes | str) -> bytes:
    content = content.encode() if isinstance(content, str) else content
    return varint(field << 3 | 2) + varint(len(content)) + content


def ints(name: str, values: Sequence[int]) -> bytes:
    """An attribute of a node: name 1, ints 8, type 20 (7: ints)."""
    return block(5, block(1, name) + b"".join(number(8, value) for value in values) + number(20, 7))


def node(kind: str, inputs: Sequence[str], output: str, attributes: bytes = b"") -> bytes:
    """A node of a graph: input 1, output 2, name 3, op_type 4, attribute 5."""
    names = b"".join(block(1, name) for name in inputs)
    return block(1, names + block(2, output) + block(3, output) + block(4, kind) + attributes)


def tensor(name: str, values: np.ndarray) -> bytes:
    """An initialiser of a graph: dims 1, data_type 2 (1: float), name 8, raw_data 9."""
    dims = b"".join(number(1, side) for side in values.shape)
    return block(5, dims + number(2, 1) + block(8, name) + block(9, values.astype("<f4").tobytes()))


def value(field: int, name: str, shape: Sequence[int | str]) -> bytes:
    """An input (11) or an output (12) of a graph; a word is a free side."""
    dims = b"".join(block(1, number(1, side) if isinstance(side, int) else block(2, side)) for side in shape)
    return block(field, block(1, name) + block(2, block(1, number(1, 1) + block(2, dims))))


def pooled_model(
    weights: np.ndarray,  # [3 * 4 * 4, N]
    taken: Sequence[int | str] = (1, 3, 112, 112),
    given: Sequence[int | str] | None = None,
    side: int = 112,
    normalises: bool = False,
) -> bytes:
    """Means of 4 x 4 tiles of each channel, times ``weights``.

    Args:
        weights: the matrix; 0.5 is not added.
        taken, given: the shapes that the file states.
        side: pixels of the picture.
        normalises: whether (x - 127.5) / 127.5 stands in it, as in models of MXNet's.
    """
    tile, first = side // 4, "input"
    graph, kept = b"", tensor("weights", weights)
    if normalises:
        graph += node("Sub", ["input", "mean"], "centred") + node("Mul", ["centred", "scale"], "scaled")
        kept += tensor("mean", np.full(1, 127.5)) + tensor("scale", np.full(1, 1 / 127.5))
        first = "scaled"
    tiles = ints("kernel_shape", (tile, tile)) + ints("strides", (tile, tile))
    graph += node("AveragePool", [first], "pooled", tiles) + node("Flatten", ["pooled"], "flat")
    graph += node("Gemm", ["flat", "weights"], "output") + block(2, "graph") + kept
    graph += value(11, "input", taken) + value(12, "output", given or (1, weights.shape[1]))
    return number(1, 8) + block(8, block(1, "") + number(2, 13)) + block(7, graph)
