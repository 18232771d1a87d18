"""Clouds in PCD files: the fields x, y and z are metres.

The data may be ascii, binary or binary_compressed, and the fields of any number type; other fields are skipped. A
VIEWPOINT other than 0 0 0 1 0 0 0 is the pose of the sensor, and the points are in the sensor's frame; else they are
in the map frame, or in the sensor's if the file lies in a folder of scans (`formats.cloud_folder`).

The fields of compressed data lie one after another, so such a file is unpacked as a whole.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from roughmap_schemas.geometry import normalised
from roughmap_service.formats.blocks import AXES, binary_rows, columns, read_line, size_of, text_rows
from roughmap_service.formats.lzf import MOST_PER_BYTE, unpack
from roughmap_service.formats.options import ReadOptions
from roughmap_service.formats.recorded import PART_ROWS, CloudFileFault, Floats, PlacedPoints, RecordedScan

KINDS = {"F": "f", "I": "i", "U": "u"}
SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}

KEYS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")

MAX_COUNT = 1 << 16
"""Most numbers of one field: histograms of features have some hundreds."""

MAX_UNPACKED = 4 << 30
"""Most bytes of compressed data, which are in memory at once."""

HERE = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
"""The viewpoint that stands for none: x, y, z, qw, qx, qy, qz."""


class Header(NamedTuple):
    """What a header says. `fields`: name, numpy's type, and how many numbers each has."""

    fields: list[tuple[str, str, int]]
    points: int
    viewpoint: tuple[float, ...]
    data: str

    @property
    def row_size(self) -> int:
        """Bytes of a binary row."""
        return sum(int(kind[2:]) * count for _, kind, count in self.fields)


def read_pcd(file: Path, options: ReadOptions) -> Iterator[PlacedPoints | RecordedScan]:
    """Yield the points of a file in parts; with a viewpoint, all have the same pose. CloudFileFault and OSError."""
    with file.open("rb") as stream:
        header = _header(file, stream)
        pose = _pose(file, header.viewpoint)
        for points in _parts(file, stream, header, options):
            yield PlacedPoints(points, 0, None) if pose is None else RecordedScan(points, 0, *pose)


def _header(file: Path, stream: BinaryIO) -> Header:
    words: dict[str, list[str]] = {}
    size = size_of(stream)
    while "DATA" not in words:
        if stream.tell() == size:
            raise CloudFileFault(f"{file}: expected a PCD header that ends with DATA, found none; not a PCD file")
        line = read_line(file, stream).decode("ascii", "replace")
        key, *values = line.split() or ["#"]
        if key.startswith("#"):
            continue
        if key not in KEYS or key in words or not values:
            raise CloudFileFault(f"{file}: not a line of a PCD header: {line[:60]!r}")
        words[key] = values
    try:
        return _parsed(words)
    except (KeyError, ValueError) as error:
        what = f"no {error.args[0]}" if isinstance(error, KeyError) else str(error)
        raise CloudFileFault(
            f"{file}: expected a PCD header with FIELDS, SIZE, TYPE and WIDTH, found {what}"
        ) from error


def _parsed(words: dict[str, list[str]]) -> Header:
    """Return what the lines of a header say. Raises KeyError and ValueError."""
    names, sizes, kinds = words["FIELDS"], [int(word) for word in words["SIZE"]], words["TYPE"]
    counts = [int(word) for word in words.get("COUNT", ["1"] * len(names))]
    if not len(names) == len(sizes) == len(kinds) == len(counts):
        raise ValueError(f"{len(names)} fields, {len(sizes)} sizes, {len(kinds)} types, {len(counts)} counts")
    if any(names.count(axis) != 1 for axis in AXES):
        raise ValueError(f"the fields {' '.join(names)[:60]}, not x, y and z")
    for name, size, kind, count in zip(names, sizes, kinds, counts, strict=True):
        if size not in SIZES.get(kind, ()) or not 0 < count <= MAX_COUNT or (name in AXES and count != 1):
            raise ValueError(f"field {name} of type {kind}, size {size}, count {count}")
    width, height = int(words["WIDTH"][0]), int(words.get("HEIGHT", ["1"])[0])
    points = int(words.get("POINTS", [str(width * height)])[0])
    if points != width * height or not 0 <= points < 1 << 40:
        raise ValueError(f"WIDTH {width}, HEIGHT {height}, POINTS {points}")
    viewpoint = tuple(float(word) for word in words.get("VIEWPOINT", HERE))
    if len(viewpoint) != 7:
        raise ValueError(f"a VIEWPOINT of {len(viewpoint)} numbers, not 7")
    data = words["DATA"][0].lower()
    if data not in {"ascii", "binary", "binary_compressed"}:
        raise ValueError(f"DATA {data}")
    types = [f"<{KINDS[kind]}{size}" for kind, size in zip(kinds, sizes, strict=True)]
    return Header(list(zip(names, types, counts, strict=True)), points, viewpoint, data)


def _pose(file: Path, viewpoint: tuple[float, ...]) -> tuple[Floats, Floats] | None:
    """Return position and rotation of the sensor, None if the viewpoint stands for none."""
    if viewpoint == HERE:
        return None
    x, y, z, qw, qx, qy, qz = viewpoint
    unit = normalised((qx, qy, qz, qw))
    if unit is None or not np.isfinite(viewpoint).all():
        raise CloudFileFault(
            f"{file}: expected a VIEWPOINT x y z qw qx qy qz with a unit quaternion, found "
            f"{' '.join(f'{value:g}' for value in viewpoint)}; write 0 0 0 1 0 0 0 for points in the map frame"
        )
    return np.array([x, y, z]), np.array(unit)


def _parts(file: Path, stream: BinaryIO, header: Header, options: ReadOptions) -> Iterator[Floats]:
    if header.data == "ascii":
        starts = np.cumsum([0, *(count for _, _, count in header.fields)]).tolist()
        x, y, z = (starts[k] for k in _places(header))
        return text_rows(file, stream, (x, y, z), starts[-1], header.points, options)
    if header.data == "binary":
        starts = np.cumsum([0, *(int(kind[2:]) * count for _, kind, count in header.fields)]).tolist()
        dtype = np.dtype(
            {
                "names": list(AXES),
                "formats": [header.fields[k][1] for k in _places(header)],
                "offsets": [starts[k] for k in _places(header)],
                "itemsize": header.row_size,
            }
        )
        return binary_rows(file, stream, dtype, header.points, options)
    return _unpacked(file, stream, header, options)


def _places(header: Header) -> list[int]:
    names = [name for name, _, _ in header.fields]
    return [names.index(axis) for axis in AXES]


def _unpacked(file: Path, stream: BinaryIO, header: Header, options: ReadOptions) -> Iterator[Floats]:
    """Yield the points of compressed data: two sizes, then all of x, all of y, ..., packed together."""
    if not header.points:
        return
    begin = stream.tell()
    sizes = np.frombuffer(stream.read(8).ljust(8, b"\0"), "<u4").tolist()
    packed_size, size = sizes
    if packed_size > size_of(stream) - begin - 8 or not packed_size:
        raise CloudFileFault(
            f"{file}: expected {packed_size} bytes of compressed data from byte {begin}, found "
            f"{max(size_of(stream) - begin - 8, 0)}; the file is cut off: copy it again"
        )
    expected = header.points * header.row_size
    if size != expected or size > min(MAX_UNPACKED, MOST_PER_BYTE * packed_size):
        raise CloudFileFault(
            f"{file}: expected {header.points} points of {header.row_size} bytes, found {size} bytes in {packed_size} "
            "of compressed data; the file is damaged"
        )
    data = unpack(stream.read(packed_size), size)
    if data is None:
        raise CloudFileFault(f"{file}: the compressed data from byte {begin + 8} are damaged; copy the file again")
    starts = np.cumsum([0, *(int(kind[2:]) * count * header.points for _, kind, count in header.fields)]).tolist()
    planes = [
        data[starts[k] : starts[k] + header.points * int(header.fields[k][1][2:])].view(header.fields[k][1])
        for k in _places(header)
    ]
    for row in range(0, header.points, PART_ROWS):
        yield columns([plane[row : row + PART_ROWS] for plane in planes])
        options.reached(min(row + PART_ROWS, header.points) / header.points)
