"""Rows of points in binary files and in text, in bounded parts, for the readers of PLY and PCD."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from roughmap_service.formats.options import ReadOptions
from roughmap_service.formats.recorded import PART_ROWS, CloudFileFault, Floats

PART_BYTES = 64 << 20
"""Most bytes of rows that are in memory at once."""

BLOCK = 6 * PART_ROWS
"""Bytes of text that are read at once. A line of three numbers has at least six."""

MAX_LINE = 1 << 16
"""Most bytes of a line, of a header too."""

AXES = ("x", "y", "z")


def size_of(stream: BinaryIO) -> int:
    """Return the size of a file; its place is kept."""
    here = stream.tell()
    size = stream.seek(0, 2)
    stream.seek(here)
    return size


def read_line(file: Path, stream: BinaryIO) -> bytes:
    """Return the next line, without its end; empty at the file's end. CloudFileFault if it is longer than a line."""
    line = stream.readline(MAX_LINE)
    if len(line) == MAX_LINE:
        raise CloudFileFault(f"{file}: expected lines of at most {MAX_LINE} bytes, found a longer one; not such a file")
    return line.rstrip(b"\r\n")


def columns(planes: Sequence[npt.NDArray[Any]]) -> Floats:
    """Return x, y and z, each (N,) of any number type, as (N, 3)."""
    points = np.empty((len(planes[0]), 3))
    with np.errstate(invalid="ignore"):  # a signalling NaN is a NaN
        for k, plane in enumerate(planes):
            points[:, k] = plane
    return points


def binary_rows(
    file: Path, stream: BinaryIO, dtype: np.dtype[np.void], count: int, options: ReadOptions
) -> Iterator[Floats]:
    """Yield the points of `count` rows of `dtype` that begin here. CloudFileFault if the file is too short for them."""
    begin, size = stream.tell(), size_of(stream)
    if count * dtype.itemsize > size - begin:
        raise CloudFileFault(
            f"{file}: expected {count} points of {dtype.itemsize} bytes from byte {begin}, found {size - begin} bytes; "
            "the file is cut off: copy it again"
        )
    most = max(1, min(PART_ROWS, PART_BYTES // dtype.itemsize))
    for done in range(0, count, most):
        rows = min(most, count - done)
        data = stream.read(rows * dtype.itemsize)
        if len(data) < rows * dtype.itemsize:
            raise CloudFileFault(f"{file}: became shorter while it was read")
        read = np.frombuffer(data, dtype)
        yield columns([read[axis] for axis in AXES])
        options.reached((done + rows) / count)


def text_rows(
    file: Path, stream: BinaryIO, wanted: tuple[int, int, int], width: int, count: int, options: ReadOptions
) -> Iterator[Floats]:
    """Yield the points of `count` lines of `width` numbers that begin here; `wanted` are the columns of x, y and z."""
    done = 0
    for block in _line_blocks(file, stream) if count else ():
        lines = list(filter(bytes.strip, block))[: count - done]
        if lines:
            yield _numbers(file, lines, wanted, width, done)
            done += len(lines)
            options.reached(done / count)
        if done == count:
            return
    if done < count:
        raise CloudFileFault(
            f"{file}: expected {count} points, found {done}; the file is cut off: copy it again, or correct the count "
            "in its header"
        )


def _line_blocks(file: Path, stream: BinaryIO) -> Iterator[list[bytes]]:
    rest = b""
    while block := stream.read(BLOCK):
        *lines, rest = (rest + block).split(b"\n")
        if len(rest) > MAX_LINE:
            raise CloudFileFault(
                f"{file}: expected lines of at most {MAX_LINE} bytes, found a longer one; it is damaged"
            )
        yield lines
    yield [rest]


def _numbers(file: Path, lines: list[bytes], wanted: tuple[int, int, int], width: int, done: int) -> Floats:
    for k, found in enumerate(map(len, map(bytes.split, lines)), done):
        if found != width:
            raise CloudFileFault(
                f"{file}: point {k}, counted from 0: expected {width} numbers as the header says, found {found}"
            )
    try:
        return np.loadtxt(lines, usecols=wanted, comments=None, ndmin=2, encoding="latin-1")
    except ValueError as error:
        raise CloudFileFault(f"{file}: points {done} to {done + len(lines) - 1}: {error}; expected numbers") from error
