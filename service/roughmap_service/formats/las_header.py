"""The header of LAS and LAZ files, versions 1.0 to 1.4, and the records that tell the coordinate reference system.

All that a damaged header could ask for is checked against the size of the file before anything is read.
"""

import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from roughmap_service.formats.blocks import size_of
from roughmap_service.formats.recorded import CloudFileFault

RECORD_BYTES = {0: 20, 1: 28, 2: 26, 3: 34, 4: 57, 5: 63, 6: 30, 7: 36, 8: 38, 9: 59, 10: 67}
"""Least bytes of a point in each point format."""

WITH_TIME = frozenset((1, 3, 4, 5, 6, 7, 8, 9, 10))

ADJUSTED_TIME, WKT = 1, 16
"""Bits of the global encoding: gps_time is adjusted standard GPS time, not time of the week; the CRS is WKT."""

PROJECTION, LASZIP = b"LASF_Projection", b"laszip encoded"

MAX_RECORDS = 10_000
MAX_CRS_BYTES = 1 << 16

FEET = re.compile(r'UNIT\s*\[\s*"[^"]*(?:\bfoot|\bfeet|\bft|_foot|_feet)\b', re.IGNORECASE)
DEGREES = re.compile(
    r'\s*(?:COMPD_?CS|COMPOUNDCRS)?(?:\s*\[\s*"[^"]*"\s*,)?\s*(?:GEOGCS|GEOGCRS|GEODCRS)\b', re.IGNORECASE
)
GEOGRAPHIC = 2
"""GTModelTypeGeoKey of longitude and latitude."""

FEET_KEYS = frozenset(range(9002, 9007)) | {9041}


class LasHeader(NamedTuple):
    """What a header says; `crs` is WKT, or EPSG:n, or None; `not_metres` is feet or degrees if it has those."""

    point_format: int
    compressed: bool
    record_bytes: int
    points: int
    begin: int
    scale: tuple[float, float, float]
    offset: tuple[float, float, float]
    adjusted_time: bool
    laszip: bytes
    crs: str | None
    not_metres: str | None


def read_header(file: Path, stream: BinaryIO) -> LasHeader:
    """Return the header of a LAS or LAZ file. Raises CloudFileFault and OSError."""
    size = size_of(stream)
    head = stream.read(375)
    if head[:4] != b"LASF" or len(head) < 227:
        raise CloudFileFault(f"{file}: expected a LAS header of at least 227 bytes, found {size} bytes {head[:4]!r}")
    encoding, major, minor = struct.unpack_from("<6xH16xBB", head)
    header_bytes, begin, records, form, record_bytes, points = struct.unpack_from("<HIIBHI", head, 94)
    least = 375 if minor >= 4 else 227
    if major != 1 or minor > 4 or header_bytes < least or len(head) < least or not header_bytes <= begin <= size:
        raise CloudFileFault(
            f"{file}: expected LAS 1.0 to 1.4 with a header of {least} bytes or more and points after it, found "
            f"version {major}.{minor}, {header_bytes} bytes, points at {begin} of {size} bytes"
        )
    extended = extended_begin = 0
    if minor >= 4:
        extended_begin, extended, points = struct.unpack_from("<QIQ", head, 235)
    compressed, form = bool(form & 0x80), form & 0x3F
    if form not in RECORD_BYTES or record_bytes < RECORD_BYTES[form]:
        raise CloudFileFault(
            f"{file}: expected a point format from 0 to 10 with points of {RECORD_BYTES.get(form, 20)} bytes or more, "
            f"found format {form} with {record_bytes}"
        )
    if not compressed and points * record_bytes > size - begin:
        raise CloudFileFault(
            f"{file}: expected {points} points of {record_bytes} bytes from byte {begin}, found {size - begin} bytes; "
            "the file is cut off: copy it again"
        )
    place = struct.unpack_from("<6d", head, 131)
    if not all(0 < abs(value) < 1e6 for value in place[:3]) or not all(abs(value) < 1e15 for value in place[3:]):
        raise CloudFileFault(f"{file}: expected finite scales and offsets, found {place[:3]} and {place[3:]}")
    kept = {
        (user, record): data
        for user, record, data in (
            *_records(stream, header_bytes, records, begin, "<2x16sHH32x"),
            *_records(stream, extended_begin, extended, size, "<2x16sHQ32x"),
        )
        if len(data) <= MAX_CRS_BYTES
    }
    crs, not_metres = _crs(kept, wkt=bool(encoding & WKT))
    return LasHeader(
        form, compressed, record_bytes, points, begin, place[:3], place[3:], bool(encoding & ADJUSTED_TIME),
        kept.get((LASZIP, 22204), b""), crs, not_metres,
    )  # fmt: skip


def _records(stream: BinaryIO, begin: int, count: int, end: int, form: str) -> Iterator[tuple[bytes, int, bytes]]:
    """Yield user, number and data of the variable length records; those behind a damaged one are not looked for."""
    for _ in range(min(count, MAX_RECORDS)):
        if begin + struct.calcsize(form) > end:
            return
        stream.seek(begin)
        user, record, length = struct.unpack(form, stream.read(struct.calcsize(form)))
        begin += struct.calcsize(form)
        if begin + length > end:
            return
        yield user.split(b"\0")[0], record, stream.read(min(length, MAX_CRS_BYTES + 1))
        begin += length


def _crs(records: dict[tuple[bytes, int], bytes], *, wkt: bool) -> tuple[str | None, str | None]:
    """Return the coordinate reference system, and its unit if that is not the metre."""
    text = records.get((PROJECTION, 2112), b"").split(b"\0")[0].decode("utf-8", "replace").strip()
    keys = records.get((PROJECTION, 34735), b"")
    if text and (wkt or not keys):
        return text, unit_of(text)
    table = list(struct.iter_unpack("<4H", keys[: len(keys) // 8 * 8]))[1:]
    values = {key: value for key, location, _, value in table if location == 0}
    code = values.get(3072) or (values.get(2048) if values.get(1024) == 2 else None)
    known = code is not None and 1024 <= code < 32767
    unit = "feet" if {values.get(3076), values.get(4099)} & FEET_KEYS else None
    return f"EPSG:{code}" if known else None, "degrees" if values.get(1024) == GEOGRAPHIC and known else unit


def unit_of(wkt: str) -> str | None:
    """Return feet or degrees if a coordinate reference system has x and y, or any length, in those."""
    if FEET.search(wkt) is not None:
        return "feet"
    return "degrees" if DEGREES.match(wkt) else None
