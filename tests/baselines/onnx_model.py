"""ONNX files written by hand: a graph with LaMa's inputs and output in a few hundred bytes."""

from __future__ import annotations

import struct

_VARINT, _BYTES = 0, 2
_FLOAT = 1


def _number(n: int) -> bytes:
    out = bytearray()
    while n > 0x7F:
        out.append(n & 0x7F | 0x80)
        n >>= 7
    return bytes(out) + bytes([n])


def _int(field: int, value: int) -> bytes:
    return _number(field << 3 | _VARINT) + _number(value)


def _part(field: int, data: bytes | str) -> bytes:
    data = data.encode() if isinstance(data, str) else data
    return _number(field << 3 | _BYTES) + _number(len(data)) + data


def _tensor(name: str, values: list[float]) -> bytes:
    """TensorProto: dims, data_type, name, raw_data."""
    raw = struct.pack(f"<{len(values)}f", *values)
    return _int(1, len(values)) + _int(2, _FLOAT) + _part(8, name) + _part(9, raw)


def _value(name: str, shape: tuple[int, ...]) -> bytes:
    """ValueInfoProto of a float tensor."""
    dims = b"".join(_part(1, _int(1, n)) for n in shape)
    return _part(1, name) + _part(2, _part(1, _int(1, _FLOAT) + _part(2, dims)))


def _node(kind: str, inputs: tuple[str, ...], output: str) -> bytes:
    return b"".join(_part(1, i) for i in inputs) + _part(2, output) + _part(3, output) + _part(4, kind)


def lama_like(inputs: tuple[str, str] = ("image", "mask"), side: int = 512, flat: bool = False) -> bytes:
    """255 (image + mask (1 - 2 image)): the negative where the mask is 1, the picture elsewhere.

    ``flat``: answered in one row.
    """
    image, mask = inputs
    nodes = [
        _node("Mul", (image, "two"), "doubled"),
        _node("Sub", ("one", "doubled"), "turned"),
        _node("Mul", ("turned", mask), "held"),
        _node("Add", (image, "held"), "sum"),
        _node("Mul", ("sum", "white"), "bright" if flat else "output"),
    ]
    if flat:
        nodes.append(_node("Flatten", ("bright",), "output"))
    graph = b"".join(_part(1, n) for n in nodes) + _part(2, "tiny")
    for name, value in (("one", 1.0), ("two", 2.0), ("white", 255.0)):
        graph += _part(5, _tensor(name, [value]))
    graph += _part(11, _value(image, (1, 3, side, side))) + _part(11, _value(mask, (1, 1, side, side)))
    graph += _part(12, _value("output", (1, 3 * side * side) if flat else (1, 3, side, side)))
    return _int(1, 8) + _part(7, graph) + _part(8, _part(1, "") + _int(2, 13))
