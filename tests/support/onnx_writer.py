"""ONNX files of a few nodes, written byte by byte (protobuf wire format), so that tests need no package for them."""

import struct
from collections.abc import Sequence

FLOAT, INT, INTS = 1, 2, 7  # TensorProto.DataType of a float, AttributeProto types


def distance_network(inputs: Sequence[str] = ("in0", "in1"), offset: float = 0.0, pixels: str | int = "size") -> bytes:
    """Return a model of the mean squared difference of two [1, 3, h, w] images, plus `offset`."""
    nodes = [
        _node("Sub", inputs, "difference"),
        _node("Mul", ("difference", "difference"), "square"),
        _node("ReduceMean", ("square",), "by_channel", _axes(2, 3)),
        _node("ReduceMean", ("by_channel",), "mean", _axes(1)),
        _node("Add", ("mean", "offset"), "distance"),
    ]
    graph = b"".join(_field(1, node) for node in nodes) + _field(2, "graph")
    graph += _field(5, _scalar("offset", offset))
    graph += b"".join(_field(11, _value(name, (1, 3, pixels, pixels))) for name in inputs)
    graph += _field(12, _value("distance", (1, 1, 1, 1)))
    return _field(1, 8) + _field(7, graph) + _field(8, _field(1, "") + _field(2, 13))


def _node(kind: str, inputs: Sequence[str], output: str, attributes: bytes = b"") -> bytes:
    names = b"".join(_field(1, name) for name in inputs) + _field(2, output)
    return names + _field(3, f"make_{output}") + _field(4, kind) + attributes


def _axes(*axes: int) -> bytes:
    listed = _field(1, "axes") + b"".join(_field(8, axis) for axis in axes) + _field(20, INTS)
    return _field(5, listed) + _field(5, _field(1, "keepdims") + _field(3, 1) + _field(20, INT))


def _scalar(name: str, value: float) -> bytes:
    return _field(1, 1) + _field(2, FLOAT) + _field(8, name) + _field(9, struct.pack("<f", value))


def _value(name: str, dimensions: Sequence[str | int]) -> bytes:
    shape = b"".join(_field(1, _field(1 if isinstance(d, int) else 2, d)) for d in dimensions)
    return _field(1, name) + _field(2, _field(1, _field(1, FLOAT) + _field(2, shape)))


def _field(number: int, value: int | str | bytes) -> bytes:
    if isinstance(value, int):
        return _varint(number << 3) + _varint(value)
    data = value.encode() if isinstance(value, str) else value
    return _varint(number << 3 | 2) + _varint(len(data)) + data


def _varint(value: int) -> bytes:
    low, rest = value & 127, value >> 7
    return bytes([low | 128]) + _varint(rest) if rest else bytes([low])
