"""Reading the vertices of .ply files."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from umf_ros.core.errors import SensorFileError
from umf_ros.sensors.pcd import Columns

_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
LIST = "list"


@dataclass(slots=True)
class _Element:
    """A kind of record: its name, how many there are, and the names and types of its properties."""

    name: str
    count: int
    properties: list[tuple[str, str]] = field(default_factory=list)

    def record(self, order: str) -> np.dtype[Any]:
        """One record of a binary file.

        Raises:
            SensorFileError: a property is a list, whose length varies.
        """
        if any(kind == LIST for _, kind in self.properties):
            raise SensorFileError(f"a PLY file whose element {self.name} has lists")
        return np.dtype([(name, order + kind) for name, kind in self.properties])


def parse_ply(content: bytes) -> Columns:
    """The properties of the vertices, (N,) each, by name in lower case.

    Raises:
        SensorFileError: it is no such file, or the data are not what the header says.
    """
    if not content.startswith(b"ply"):
        raise SensorFileError("no PLY file")
    end = content.find(b"end_header")
    line_end = content.find(b"\n", end)
    if end < 0 or line_end < 0:
        raise SensorFileError("a PLY header that breaks off")
    try:
        form, elements = _read_header(content[:end].decode("ascii", "replace"))
    except (ValueError, IndexError, KeyError):
        raise SensorFileError("a PLY header that cannot be read") from None
    before = [element for element in elements[: _vertices(elements)] if element.count]
    vertices, body = elements[_vertices(elements)], content[line_end + 1 :]
    if form == "ascii":
        return _parse_text(body, sum(element.count for element in before), vertices)
    order = _ORDERS[form]
    start = sum(element.count * element.record(order).itemsize for element in before)
    record = vertices.record(order)
    if len(body) < start + vertices.count * record.itemsize:
        raise SensorFileError(f"PLY data that break off before {vertices.count} vertices")
    records = np.frombuffer(body, record, vertices.count, start)
    return {name: records[name] for name in record.names or ()}


def _read_header(text: str) -> tuple[str, list[_Element]]:
    form, elements = "", []
    for line in text.splitlines()[1:]:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format":
            form = words[1]
        elif words[0] == "element":
            elements.append(_Element(words[1], int(words[2])))
        elif words[0] == "property":
            kind = LIST if words[1] == LIST else _TYPES[words[1]]
            elements[-1].properties.append((words[-1].lower(), kind))
    if form not in _ORDERS:
        raise SensorFileError(f"PLY data of format {form!r}")
    return form, elements


def _vertices(elements: list[_Element]) -> int:
    for index, element in enumerate(elements):
        if element.name == "vertex":
            return index
    raise SensorFileError("a PLY file without vertices")


def _parse_text(body: bytes, skipped: int, vertices: _Element) -> Columns:
    lines = [line for line in body.splitlines() if line.strip()][skipped : skipped + vertices.count]
    if len(lines) < vertices.count:
        raise SensorFileError(f"PLY data that break off before {vertices.count} vertices")
    names = [name for name, _ in vertices.properties]
    try:
        rows = np.array(b" ".join(lines).split(), dtype=np.float64).reshape(-1, len(names))
    except ValueError:
        raise SensorFileError("PLY data that are not numbers") from None
    return {name: rows[:, column] for column, name in enumerate(names)}
