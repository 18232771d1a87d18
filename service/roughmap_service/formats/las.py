"""Clouds in LAS and LAZ files, versions 1.0 to 1.4: surveyed points in the map frame.

Coordinates are the stored integers times the scale plus the offset, in float64 metres. Points that the file marks as
noise (class 7, and class 18 from point format 6 on) or as withheld are left out and counted, as survey programs do;
overlap points and all other classes are kept.

A file is one cloud with stamp 0, in its own order. With `scan_seconds` it is a stream in the order of gps_time: points
with stamps of their own (`formats.gps_time`), cut at whole multiples of so many seconds. Points out of order are
sorted within bounded memory, by reading the file several times.

LAS needs no library. LAZ is unpacked by lazrs, of the extra `las`.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import numpy.typing as npt

from roughmap_service.formats.blocks import PART_BYTES
from roughmap_service.formats.gps_time import stamps_of
from roughmap_service.formats.las_header import WITH_TIME, LasHeader, read_header
from roughmap_service.formats.laz_chunks import check_chunks
from roughmap_service.formats.options import ReadOptions
from roughmap_service.formats.recorded import PART_ROWS, CloudFileFault, Floats, PlacedPoints

HELD_ROWS = 2_000_000
"""Most points out of order that are in memory at once: 64 MB, and three times that while they are sorted."""

MOST_READINGS = 100
"""Most times that a file is read to sort its points."""

MOST_SCANS = 1 << 20

LOW_NOISE, HIGH_NOISE = 7, 18

Stamps = npt.NDArray[np.int64]


class Points(NamedTuple):
    """Points (N, 3) in metres and their stamps (N,), of which there are none without `scan_seconds`."""

    xyz: Floats
    stamps: Stamps


def read_las(file: Path, options: ReadOptions) -> Iterator[PlacedPoints]:
    """Yield the points of a file in parts. Raises CloudFileFault and OSError."""
    with file.open("rb") as stream:
        header = read_header(file, stream)
        if header.not_metres:
            raise CloudFileFault(
                f"{file}: its coordinate reference system is in {header.not_metres}; the map takes metres: reproject "
                "it, for example with `pdal translate IN.las OUT.las reprojection "
                "--filters.reprojection.out_srs=EPSG:CODE`"
            )
        if options.scan_seconds is None:
            for points, _ in _kept(_records(file, stream, header, options, 0.0, 1.0), header, options):
                yield PlacedPoints(points, 0, None)
            return
        if header.point_format not in WITH_TIME:
            raise CloudFileFault(
                f"{file}: its points have no gps_time (point format {header.point_format}); leave out --scan-seconds"
            )
        scan_ns = max(1, round(options.scan_seconds * 1e9))
        yield from _Streamed(file, stream, header, options, scan_ns).parts()


def _dtype(header: LasHeader) -> "np.dtype[np.void]":
    """Return the type of a point record, with the fields that are read."""
    late = header.point_format >= 6
    fields = {"x": ("<i4", 0), "y": ("<i4", 4), "z": ("<i4", 8), "flags": ("u1", 15)}
    fields["class"] = ("u1", 16 if late else 15)
    if header.point_format in WITH_TIME:
        fields["time"] = ("<f8", 22 if late else 20)
    return np.dtype(
        {
            "names": list(fields),
            "formats": [form for form, _ in fields.values()],
            "offsets": [offset for _, offset in fields.values()],
            "itemsize": header.record_bytes,
        }
    )


def _records(
    file: Path, stream: BinaryIO, header: LasHeader, options: ReadOptions, begin: float, end: float
) -> Iterator[npt.NDArray[np.void]]:
    """Yield all point records in parts; this reading is the share from `begin` to `end` of the progress."""
    dtype = _dtype(header)
    stream.seek(header.begin)
    unpacker = _unpacker(file, stream, header) if header.compressed and header.points else None
    most = max(1, min(PART_ROWS, PART_BYTES // header.record_bytes))
    for done in range(0, header.points, most):
        rows = min(most, header.points - done)
        data = bytearray(rows * header.record_bytes)
        if unpacker is None:
            if stream.readinto(data) < len(data):  # type: ignore[attr-defined]
                raise CloudFileFault(f"{file}: became shorter while it was read")
        else:
            try:
                unpacker.decompress_many(data)
            except Exception as error:  # what lazrs and the file raise
                raise CloudFileFault(
                    f"{file}: points {done} to {done + rows - 1} of {header.points} can't be unpacked ({error}); the "
                    "file is cut off or damaged: copy it again"
                ) from error
        yield np.frombuffer(data, dtype)
        options.reached(begin + (end - begin) * (done + rows) / header.points)


def _unpacker(file: Path, stream: BinaryIO, header: LasHeader) -> Any:
    """Return the decompressor of a LAZ file."""
    try:
        lazrs = import_module("lazrs")
    except ModuleNotFoundError:
        raise CloudFileFault(f"{file}: reading LAZ files needs lazrs: pip install 'roughmap[las]'") from None
    check_chunks(file, stream, header)
    stream.seek(header.begin)
    try:
        bytes_each = lazrs.LazVlr(header.laszip).item_size()
        if bytes_each != header.record_bytes:
            raise CloudFileFault(f"{file}: expected packed points of {header.record_bytes} bytes, found {bytes_each}")
        return lazrs.LasZipDecompressor(stream, header.laszip)
    except CloudFileFault:
        raise
    except Exception as error:  # what lazrs raises
        raise CloudFileFault(f"{file}: not a readable LAZ file ({error}); copy it again") from error


def _kept(
    records: Iterator[npt.NDArray[np.void]], header: LasHeader, options: ReadOptions
) -> Iterator[tuple[Floats, npt.NDArray[np.void]]]:
    """Yield the points that are neither withheld nor noise, and their records; count the others."""
    late = header.point_format >= 6
    for part in records:
        withheld = part["flags"] & (0x04 if late else 0x80) != 0
        classes = part["class"] if late else part["class"] & 0x1F
        noise = (classes == LOW_NOISE) | (late & (classes == HIGH_NOISE))
        for reason, left_out in (("withheld", withheld), ("noise", noise & ~withheld)):
            if count := int(np.count_nonzero(left_out)):
                options.left_out(reason, count)
        good = part[~(withheld | noise)]
        points = np.empty((len(good), 3))
        for k, axis in enumerate("xyz"):
            points[:, k] = good[axis] * header.scale[k] + header.offset[k]
        yield points, good


class _Streamed:
    """The points of a file by gps_time."""

    def __init__(self, file: Path, stream: BinaryIO, header: LasHeader, options: ReadOptions, scan_ns: int) -> None:
        self._file, self._stream, self._header, self._options, self._scan_ns = file, stream, header, options, scan_ns

    def parts(self) -> Iterator[PlacedPoints]:
        """Yield the scans in order; one with many points comes in parts."""
        scans, in_order = self._survey()
        if not self._header.adjusted_time and scans:
            self._options.note(
                f"{self._file}: gps_time is the time of an unknown week; stamps count from its beginning, as of 1970"
            )
        groups = [(min(scans), max(scans))] if in_order and scans else self._groups(scans)
        if not in_order:
            self._options.note(
                f"{self._file}: points are not in the order of gps_time; reading the file {len(groups) + 1} times to "
                "sort them"
            )
        for k, group in enumerate(groups):
            shares = 0.5 + 0.5 * k / len(groups), 0.5 + 0.5 * (k + 1) / len(groups)
            held = self._read(*shares, group)
            yield from self._cut(held if in_order else iter([_sorted(list(held))]))

    def _read(self, begin: float, end: float, scans: tuple[int, int] | None = None) -> Iterator[Points]:
        """Yield the points of the scans from the first to the last of `scans`; None: all, and count those left out."""
        records = _records(self._file, self._stream, self._header, self._options, begin, end)
        options = self._options if scans is None else replace(self._options, left_out=ReadOptions().left_out)
        for xyz, kept in _kept(records, self._header, options):
            stamps = stamps_of(self._file, kept["time"], adjusted=self._header.adjusted_time)
            if scans is None:
                yield Points(xyz, stamps)
                continue
            number = stamps // self._scan_ns
            inside = (number >= scans[0]) & (number <= scans[1])
            yield Points(xyz[inside], stamps[inside])

    def _survey(self) -> tuple[Counter[int], bool]:
        """Read all times; return the number of points in each scan, and whether the file is in order."""
        scans: Counter[int] = Counter()
        first = last = np.iinfo(np.int64).min
        in_order = True
        for _, stamps in self._read(0.0, 0.5):
            if not len(stamps):
                continue
            in_order = in_order and bool(stamps[0] >= last) and bool((np.diff(stamps) >= 0).all())
            first, last = stamps[0] if not scans else first, stamps[-1]
            numbers, counts = np.unique(stamps // self._scan_ns, return_counts=True)
            scans.update(dict(zip(numbers.tolist(), counts.tolist(), strict=True)))
            if len(scans) > MOST_SCANS:
                raise CloudFileFault(
                    f"{self._file}: more than {MOST_SCANS} scans of {self._scan_ns / 1e9:g} s; give a longer "
                    "--scan-seconds"
                )
        if in_order and first == last and scans.total() > 1:
            raise CloudFileFault(f"{self._file}: all points have the same gps_time; leave out --scan-seconds")
        return scans, in_order

    def _groups(self, scans: Counter[int]) -> list[tuple[int, int]]:
        """Return groups of scans (the first and the last), each to be sorted in memory."""
        groups: list[tuple[int, int]] = []
        rows = HELD_ROWS
        for scan in sorted(scans):
            rows += scans[scan]
            if rows > HELD_ROWS:
                groups.append((scan, scan))
                rows = scans[scan]
            groups[-1] = groups[-1][0], scan
            if rows > HELD_ROWS or len(groups) > MOST_READINGS:
                raise CloudFileFault(
                    f"{self._file}: {sum(scans.values())} points are not in the order of gps_time, which is too many "
                    "to sort here; sort the file first, for example with `pdal sort IN.las OUT.las --dimensions "
                    "GpsTime`, or leave out --scan-seconds"
                )
        return groups

    def _cut(self, parts: Iterator[Points]) -> Iterator[PlacedPoints]:
        """Yield the points, which are in order, scan by scan, in parts of at most PART_ROWS."""
        held = Points(np.empty((0, 3)), np.empty(0, np.int64))
        for part in parts:
            held = _joined([held, part])
            ends = [*np.flatnonzero(np.diff(held.stamps // self._scan_ns)) + 1, len(held.stamps)]
            begin = 0
            for end in ends:
                last = end == len(held.stamps)
                while end - begin >= PART_ROWS or (begin < end and not last):
                    stop = min(begin + PART_ROWS, end)
                    yield PlacedPoints(held.xyz[begin:stop], held.stamps[begin:stop], None)
                    begin = stop
            held = Points(held.xyz[begin:], held.stamps[begin:])
        if len(held.stamps):
            yield PlacedPoints(held.xyz, held.stamps, None)


def _joined(parts: Sequence[Points]) -> Points:
    return Points(np.concatenate([part.xyz for part in parts]), np.concatenate([part.stamps for part in parts]))


def _sorted(parts: Sequence[Points]) -> Points:
    """Return points in the order of their stamps; those with the same one stay in the file's order."""
    points = _joined(parts)
    order = np.argsort(points.stamps, kind="stable")
    return Points(points.xyz[order], points.stamps[order])
