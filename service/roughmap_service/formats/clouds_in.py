"""Recorded clouds from files: NPZ and text. A reader hands out parts of bounded size, never a whole text file.

NPZ holds `points` (N, 3), integers being millimetres and floats metres, and either scans in the sensor's frame:

    scan_start or offsets (K + 1)   scan k is points[scan_start[k] : scan_start[k + 1]]
    pose or poses (K, 4, 4)         the sensor in the map at each scan
    stamp_s (K,) or stamp_ns (K,)   seconds or nanoseconds since the epoch; absent: scan k at k tenths of a second

or points already in the map frame, with, if known, `stamp_ns` (one or N) and `covariance` ((3, 3) or (N, 3, 3)).

Text (.xyz, .csv, .txt, .asc) holds points of the map frame, one a line, separated by blanks, commas, semicolons or
tabs: the columns named x, y, z if the first line has such names, else the first three. Lines after # or // are skipped.
"""

import itertools
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roughmap_schemas.faults import ReportedError

Floats = npt.NDArray[np.float64]
Arrays = dict[str, npt.NDArray[np.generic]]

NPZ_SUFFIXES = frozenset({".npz"})
TEXT_SUFFIXES = frozenset({".xyz", ".csv", ".txt", ".asc"})

PART_ROWS = 500_000
"""Rows of text or placed points handed out at once: 12 MB of coordinates."""

NANOSECONDS = 1_000_000_000
LAST_STAMP_NS = 2**32 * NANOSECONDS


MAX_UNPACKED = 16 << 30
"""Bytes of an archive's arrays: half a billion points with their covariances; they are in memory all at once."""


class CloudFileFault(ReportedError):
    """A file does not hold a cloud that can be read; one line that names file, what was expected and what was found."""

    exit_code = 2


class RecordedScan(NamedTuple):
    """One scan: `points` (N, 3) metres in the sensor's frame, `pose` (4, 4) of the sensor in the map."""

    points: Floats
    stamp_ns: int
    pose: Floats


class PlacedPoints(NamedTuple):
    """`points` (N, 3) metres in the map frame; `stamp_ns` one or (N,); `covariance` (3, 3), (N, 3, 3) or None."""

    points: Floats
    stamp_ns: int | npt.NDArray[np.int64]
    covariance: Floats | None


def read_cloud(file: Path) -> Iterator[RecordedScan | PlacedPoints]:
    """All parts of one file, in its order. Raises CloudFileFault, or OSError where it can't be read."""
    suffix = file.suffix.lower()
    if suffix in NPZ_SUFFIXES:
        arrays = _load(file)
        return _scans(file, arrays) if _is_scans(arrays) else _placed(file, arrays)
    if suffix in TEXT_SUFFIXES:
        return _text(file)
    known = ", ".join(sorted(NPZ_SUFFIXES | TEXT_SUFFIXES))
    raise CloudFileFault(f"{file}: unknown kind of file {suffix or '(no suffix)'!r} (allowed: {known})")


def read_scans(file: Path) -> Iterator[RecordedScan]:
    """The scans of an NPZ file that holds scans with poses; CloudFileFault for any other."""
    if file.suffix.lower() not in NPZ_SUFFIXES:
        raise CloudFileFault(f"{file}: expected an .npz of scans with poses, found {file.suffix or 'no suffix'!r}")
    arrays = _load(file)
    if not _is_scans(arrays):
        raise CloudFileFault(f"{file}: expected arrays scan_start and pose beside points, found {_names(arrays)}")
    return _scans(file, arrays)


def _check_size(file: Path, archive: zipfile.ZipFile) -> None:
    """Zeros pack to a thousandth: what an archive says that it unpacks to is looked at before it is."""
    size = sum(entry.file_size for entry in archive.infolist())
    if size > MAX_UNPACKED:
        raise CloudFileFault(f"{file}: expected at most {MAX_UNPACKED} bytes of arrays, found {size}; split it")


def _load(file: Path) -> Arrays:
    try:
        # Opened here: np.load leaves the file open where it finds the archive torn.
        with file.open("rb") as stream:
            archive = np.load(stream, allow_pickle=False)
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise CloudFileFault(f"{file}: expected an NPZ archive, found a single array")
            assert archive.zip is not None  # noqa: S101 - it is open
            _check_size(file, archive.zip)
            # What in an archive is no array comes as bytes, and is passed over.
            arrays: Arrays = {name: array for name in archive.files if isinstance(array := archive[name], np.ndarray)}
    except (CloudFileFault, OSError):
        raise
    except Exception as error:  # zipfile and numpy raise nearly any kind over bytes that are no archive
        raise CloudFileFault(f"{file}: not a readable NPZ file ({str(error) or type(error).__name__})") from error
    points = arrays.get("points")
    if points is None or points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "iuf":
        found = "none" if points is None else f"{points.dtype} {points.shape}"
        raise CloudFileFault(f"{file}: expected numeric points (N, 3), found {found} (arrays: {_names(arrays)})")
    return arrays


def _names(arrays: Arrays) -> str:
    return ", ".join(sorted(arrays)) or "no arrays"


def _first(arrays: Arrays, *names: str) -> npt.NDArray[np.generic] | None:
    return next((arrays[name] for name in names if name in arrays), None)


def _is_scans(arrays: Arrays) -> bool:
    return _first(arrays, "scan_start", "offsets") is not None and _first(arrays, "pose", "poses") is not None


def _metres(points: npt.NDArray[np.generic]) -> Floats:
    """Float64 metres; whole numbers are millimetres."""
    metres = points.astype(np.float64)
    return metres / 1000.0 if points.dtype.kind in "iu" else metres


def _scans(file: Path, arrays: Arrays) -> Iterator[RecordedScan]:
    points, start, pose = arrays["points"], _first(arrays, "scan_start", "offsets"), _first(arrays, "pose", "poses")
    assert start is not None  # noqa: S101  # _is_scans
    assert pose is not None  # noqa: S101  # _is_scans
    count = len(start) - 1
    if start.ndim != 1 or start.dtype.kind not in "iu" or count < 0 or pose.shape != (count, 4, 4):
        raise CloudFileFault(
            f"{file}: expected K + 1 whole scan starts and K poses (K, 4, 4), found {start.shape} and {pose.shape}"
        )
    starts = start.astype(np.int64)
    if count and (starts[0] < 0 or np.any(np.diff(starts) < 0) or starts[-1] > len(points)):
        raise CloudFileFault(f"{file}: scan starts must rise from 0 to at most {len(points)} (the number of points)")
    poses = pose.astype(np.float64)
    if not np.isfinite(poses).all():
        raise CloudFileFault(f"{file}: the poses hold numbers that are not finite")
    stamps = _scan_stamps(file, arrays, count)
    return (RecordedScan(_metres(points[starts[k] : starts[k + 1]]), int(stamps[k]), poses[k]) for k in range(count))


def _scan_stamps(file: Path, arrays: Arrays, count: int) -> npt.NDArray[np.int64]:
    given = _first(arrays, "stamp_ns", "stamp_s")
    if given is None:
        return np.arange(count, dtype=np.int64) * (NANOSECONDS // 10)
    if given.shape != (count,) or given.dtype.kind not in "iuf" or not np.isfinite(given.astype(np.float64)).all():
        raise CloudFileFault(f"{file}: expected {count} finite stamps, found {given.dtype} {given.shape}")
    if "stamp_ns" in arrays:
        stamps = given.astype(np.int64)
    else:
        stamps = np.rint(given.astype(np.float64) * NANOSECONDS).astype(np.int64)
    _check_stamps(file, stamps)
    return stamps


def _check_stamps(file: Path, stamps: npt.NDArray[np.int64]) -> None:
    if stamps.size and (stamps.min() < 0 or stamps.max() >= LAST_STAMP_NS):
        raise CloudFileFault(f"{file}: stamps must lie in 0 .. 2^32 s, found {stamps.min()} .. {stamps.max()} ns")


def _placed(file: Path, arrays: Arrays) -> Iterator[PlacedPoints]:
    points = arrays["points"]
    count = len(points)
    stamps = np.atleast_1d(arrays.get("stamp_ns", np.zeros(1, np.int64)))
    if stamps.dtype.kind not in "iu" or stamps.shape not in {(1,), (count,)}:
        raise CloudFileFault(f"{file}: expected stamp_ns as one or {count} whole numbers, found {stamps.shape}")
    stamp_ns = stamps.astype(np.int64)
    _check_stamps(file, stamp_ns)
    covariance = arrays.get("covariance")
    if covariance is not None and (covariance.dtype.kind != "f" or covariance.shape not in {(3, 3), (count, 3, 3)}):
        raise CloudFileFault(
            f"{file}: expected covariance (3, 3) or ({count}, 3, 3), found {covariance.dtype} {covariance.shape}"
        )

    def part(begin: int) -> PlacedPoints:
        end = begin + PART_ROWS
        own = None if covariance is None else covariance.astype(np.float64, copy=False)
        return PlacedPoints(
            _metres(points[begin:end]),
            int(stamp_ns[0]) if len(stamp_ns) == 1 else stamp_ns[begin:end],
            own[begin:end] if own is not None and own.ndim == 3 else own,
        )

    return (part(begin) for begin in range(0, count, PART_ROWS))


def _text(file: Path) -> Iterator[PlacedPoints]:
    with file.open(encoding="utf-8", errors="replace") as lines:
        columns: tuple[int, int, int] | None = None
        number = 0
        while chunk := list(itertools.islice(lines, PART_ROWS)):
            rows: list[tuple[str, str, str]] = []
            for line in chunk:
                number += 1
                words = _words(line)
                if not words:
                    continue
                if columns is None:
                    columns, is_header = _columns(words)
                    if is_header:
                        continue
                if len(words) <= max(columns):
                    raise CloudFileFault(
                        f"{file}:{number}: expected at least {max(columns) + 1} columns: {line.strip()[:60]!r}"
                    )
                rows.append((words[columns[0]], words[columns[1]], words[columns[2]]))
            if rows:
                yield PlacedPoints(_numbers(file, rows, number - len(chunk) + 1), 0, None)


def _words(line: str) -> list[str]:
    text = line.split("#", 1)[0].split("//", 1)[0]
    return text.replace(",", " ").replace(";", " ").split()


def _columns(words: list[str]) -> tuple[tuple[int, int, int], bool]:
    """Where x, y and z stand, by the names in the first line if it has such."""
    names = [word.strip("\"'").lower() for word in words]
    if {"x", "y", "z"} <= set(names):
        return (names.index("x"), names.index("y"), names.index("z")), True
    return (0, 1, 2), False


def _numbers(file: Path, rows: list[tuple[str, str, str]], first_line: int) -> Floats:
    try:
        return np.array(rows, dtype=np.float64)
    except ValueError as error:
        raise CloudFileFault(f"{file}: near line {first_line}: expected three numbers a line ({error})") from error
