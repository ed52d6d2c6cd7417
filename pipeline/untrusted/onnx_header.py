"""What an ONNX file says of itself, without running it: its inputs, its outputs and its first operations.

An ONNX file is a protobuf message. Of the schema (onnx.proto, github.com/onnx/onnx) these fields are read:
ModelProto.graph 7; GraphProto.node 1, initializer 5, input 11, output 12; NodeProto.op_type 4;
TensorProto.name 8; ValueInfoProto.name 1, type 2; TypeProto.tensor_type 1; Tensor.shape 2;
TensorShapeProto.dim 1; Dimension.dim_value 1. All others are stepped over.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

_MOST_DIMENSIONS = 16
_BYTES, _VARINT = 2, 0
_FIXED = {1: 8, 5: 4}  # wire type -> bytes


@dataclasses.dataclass(frozen=True)
class OnnxHeader:
    """The shapes and the operations of a model.

    Attributes:
        inputs, outputs: name -> its shape, 0 where a side is free; initialisers are no inputs.
        operations: the types of the nodes, in the file's order.
    """

    inputs: dict[str, tuple[int, ...]]
    outputs: dict[str, tuple[int, ...]]
    operations: tuple[str, ...]


def parse_onnx_header(content: bytes) -> OnnxHeader:
    """The header of an ONNX file.

    Raises:
        ValueError: it is no protobuf message, or one without a graph.
    """
    graphs = [part for field, part in _fields(memoryview(content)) if field == 7]
    if len(graphs) != 1 or not isinstance(graphs[0], memoryview):
        raise ValueError("it has no graph")
    inputs: dict[str, tuple[int, ...]] = {}
    outputs: dict[str, tuple[int, ...]] = {}
    operations, kept = [], set()
    for field, part in _fields(graphs[0]):
        if not isinstance(part, memoryview):
            continue
        if field == 1:
            operations.append(_text(part, 4))
        elif field == 5:
            kept.add(_text(part, 8))
        elif field in (11, 12):
            (inputs if field == 11 else outputs)[_text(part, 1)] = _shape(part)
    given = {name: shape for name, shape in inputs.items() if name not in kept}
    return OnnxHeader(given, outputs, tuple(operations))


def _fields(message: memoryview) -> Iterator[tuple[int, memoryview | int]]:
    """The fields of a message in order: number, and bytes or a number."""
    place = 0
    while place < len(message):
        tag, place = _varint(message, place)
        kind = tag & 7
        value: memoryview | int
        if kind == _VARINT:
            value, place = _varint(message, place)
        elif kind == _BYTES or kind in _FIXED:
            length, place = _varint(message, place) if kind == _BYTES else (_FIXED[kind], place)
            value, place = message[place : place + length], place + length
        else:
            raise ValueError("it is no protobuf message")
        if place > len(message):
            raise ValueError("it is cut off")
        yield tag >> 3, value


def _varint(message: memoryview, place: int) -> tuple[int, int]:
    """A number of at most 64 bits, and where it ends."""
    value = 0
    for shift in range(0, 70, 7):
        if place >= len(message):
            raise ValueError("it is cut off")
        byte = message[place]
        place += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, place
    raise ValueError("it is no protobuf message")


def _inner(message: memoryview, field: int) -> memoryview:
    """The first message of a field; empty without one."""
    found = (part for number, part in _fields(message) if number == field)
    return next((part for part in found if isinstance(part, memoryview)), memoryview(b""))


def _text(message: memoryview, field: int) -> str:
    return bytes(_inner(message, field)).decode("utf-8", "replace")


def _shape(value: memoryview) -> tuple[int, ...]:
    """The sides of a ValueInfoProto's tensor; 0 where one is free."""
    shape = _inner(_inner(_inner(value, 2), 1), 2)
    sides: list[int] = []
    for field, dimension in _fields(shape):
        if field == 1 and isinstance(dimension, memoryview) and len(sides) < _MOST_DIMENSIONS:
            numbers = [side for number, side in _fields(dimension) if number == 1 and isinstance(side, int)]
            sides.append(numbers[0] if numbers and numbers[0] < 2**31 else 0)
    return tuple(sides)
