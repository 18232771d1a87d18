"""Clouds in PLY files: the element `vertex`, whose properties x, y and z are metres.

The file may be ascii, binary_little_endian or binary_big_endian, and the properties of any number type. Other
properties of a vertex are skipped, and so are other elements, before and after; a vertex with a list is refused.
Points are in the map frame, or in the sensor's if the file lies in a folder of scans (`formats.cloud_folder`).
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np

from roughmap_service.formats.blocks import AXES, binary_rows, read_line, size_of, text_rows
from roughmap_service.formats.options import ReadOptions
from roughmap_service.formats.recorded import CloudFileFault, PlacedPoints

TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
"""numpy's names of PLY's types, without the byte order."""

LENGTHS = frozenset(name for name, kind in TYPES.items() if kind[0] in "iu")
"""Types that a list's length may have."""

ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}

MAX_HEADER_LINES = 1000


@dataclass
class Element:
    """One element of the header: `properties` are a name and a type, or the types of a list's length and items."""

    name: str
    count: int
    properties: list[tuple[str, str, str | None]] = field(default_factory=list)

    @property
    def has_lists(self) -> bool:
        """Whether its rows have different lengths."""
        return any(items is not None for _, _, items in self.properties)

    def dtype(self, order: str) -> "np.dtype[np.void]":
        """Return the type of a binary row without lists."""
        return np.dtype(
            {
                "names": [name for name, _, _ in self.properties],
                "formats": [order + kind for _, kind, _ in self.properties],
            }
        )


def read_ply(file: Path, options: ReadOptions) -> Iterator[PlacedPoints]:
    """Yield the points of a file in parts. Raises CloudFileFault and OSError."""
    with file.open("rb") as stream:
        form, elements = _header(file, stream)
        vertex = next((element for element in elements if element.name == "vertex"), None)
        if vertex is None:
            raise CloudFileFault(f"{file}: expected an element vertex, found {_names(elements)}")
        _check(file, vertex)
        for element in elements[: elements.index(vertex)]:
            _skip(file, stream, element, form)
        if form == "ascii":
            names = [name for name, _, _ in vertex.properties]
            x, y, z = map(names.index, AXES)
            parts = text_rows(file, stream, (x, y, z), len(names), vertex.count, options)
        else:
            parts = binary_rows(file, stream, vertex.dtype(ORDERS[form]), vertex.count, options)
        for points in parts:
            yield PlacedPoints(points, 0, None)


def _header(file: Path, stream: BinaryIO) -> tuple[str, list[Element]]:
    """Read the header; return the format and the elements."""
    if read_line(file, stream).strip() != b"ply":
        raise CloudFileFault(f"{file}: expected 'ply' in the first line; not a PLY file")
    form = None
    elements: list[Element] = []
    for number in range(2, MAX_HEADER_LINES):
        text = read_line(file, stream).decode("ascii", "replace")
        words = text.split()
        match words:
            case ["format", str(name), "1.0"] if name in ORDERS:
                form = name
            case ["element", name, count] if count.isascii() and count.isdigit() and len(count) <= 12:
                elements.append(Element(name, int(count)))
            case ["property", "list", length, items, name] if elements and length in LENGTHS and items in TYPES:
                elements[-1].properties.append((name, TYPES[length], TYPES[items]))
            case ["property", kind, name] if elements and kind in TYPES:
                elements[-1].properties.append((name, TYPES[kind], None))
            case ["comment" | "obj_info", *_] | []:
                if not words and stream.tell() == size_of(stream):
                    break
            case ["end_header"] if form is not None:
                return form, elements
            case _:
                raise CloudFileFault(f"{file}, line {number}: not a line of a PLY header: {text[:60]!r}")
    raise CloudFileFault(f"{file}: expected end_header within {MAX_HEADER_LINES} lines, found none; it is cut off")


def _names(elements: list[Element]) -> str:
    return ", ".join(element.name for element in elements) or "no element"


def _check(file: Path, vertex: Element) -> None:
    names = [name for name, _, _ in vertex.properties]
    if any(names.count(axis) != 1 for axis in AXES) or len(set(names)) != len(names):
        raise CloudFileFault(
            f"{file}: expected the properties x, y and z of a vertex, found {', '.join(names) or 'none'}"
        )
    if vertex.has_lists:
        raise CloudFileFault(f"{file}: expected numbers as properties of a vertex, found a list; save it without")


def _skip(file: Path, stream: BinaryIO, element: Element, form: str) -> None:
    """Skip an element that comes before the vertices."""
    size = size_of(stream)
    cut_off = CloudFileFault(f"{file}: the file ends within its element {element.name}; copy it again")
    if form == "ascii":
        for _ in range(element.count):
            if stream.tell() == size:
                raise cut_off
            read_line(file, stream)
        return
    order = ORDERS[form]
    if not element.has_lists:
        stream.seek(sum(int(kind[1]) for _, kind, _ in element.properties) * element.count, 1)
    else:
        for _ in range(element.count):
            for _, kind, items in element.properties:
                length = 1
                if items is not None:
                    read = stream.read(int(kind[1]))
                    if len(read) < int(kind[1]):
                        raise cut_off
                    length = int(np.frombuffer(read, order + kind)[0])
                stream.seek(max(length, 0) * int((items or kind)[1]), 1)
    if stream.tell() > size:
        raise cut_off
