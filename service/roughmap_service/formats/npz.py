"""Recorded clouds in NPZ files (numpy archives).

`points` (N, 3) are millimetres if integer, else metres. They are scans in the sensor's frame if the file has

    scan_start or offsets (K + 1)   scan k is points[scan_start[k] : scan_start[k + 1]]
    pose or poses (K, 4, 4)         the sensor in the map at each scan: rigid transforms (`formats.poses`)
    stamp_s (K,) or stamp_ns (K,)   seconds or nanoseconds since the epoch; if absent, scan k is at k tenths of a second

and otherwise points in the map frame, with the optional `stamp_ns` (1 or N) and `covariance` ((3, 3) or (N, 3, 3)).
"""

import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from roughmap_schemas.geometry import quaternion_of
from roughmap_service.formats.options import ReadOptions
from roughmap_service.formats.poses import check_poses
from roughmap_service.formats.recorded import PART_ROWS, CloudFileFault, Floats, PlacedPoints, RecordedScan
from roughmap_service.formats.stamps import outside, stamps_fault

Arrays = dict[str, npt.NDArray[np.generic]]

NANOSECONDS = 1_000_000_000

MAX_UNPACKED = 16 << 30
"""Most bytes of an archive's arrays: half a billion points with covariances. All of them are in memory at once."""


def read_npz(file: Path, options: ReadOptions) -> Iterator[RecordedScan | PlacedPoints]:
    """Return the scans of a file, or its points in parts. Raises CloudFileFault and OSError."""
    arrays = _load(file)
    parts = _scans(file, arrays) if _is_scans(arrays) else _placed(file, arrays)
    return _telling(parts, len(arrays["points"]), options)


def _telling(
    parts: Iterator[RecordedScan] | Iterator[PlacedPoints], count: int, options: ReadOptions
) -> Iterator[RecordedScan | PlacedPoints]:
    """Return the parts, and tell how many of the `count` points have been read."""
    done = 0
    for part in parts:
        yield part
        done += len(part.points)
        options.reached(done / max(count, 1))


def _check_size(file: Path, archive: zipfile.ZipFile) -> None:
    """Check the unpacked size before unpacking: zeros pack to a thousandth of their size."""
    size = sum(entry.file_size for entry in archive.infolist())
    if size > MAX_UNPACKED:
        raise CloudFileFault(f"{file}: expected at most {MAX_UNPACKED} bytes of arrays, found {size}; split it")


def _load(file: Path) -> Arrays:
    try:
        # Opened here, because np.load leaves the file open if the archive is damaged.
        with file.open("rb") as stream:
            archive = np.load(stream, allow_pickle=False)
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise CloudFileFault(f"{file}: expected an NPZ archive, found a single array")
            assert archive.zip is not None  # noqa: S101 - it is open
            _check_size(file, archive.zip)
            # Entries that are not arrays come as bytes and are skipped.
            arrays: Arrays = {name: array for name in archive.files if isinstance(array := archive[name], np.ndarray)}
    except (CloudFileFault, OSError):
        raise
    except Exception as error:  # zipfile and numpy raise almost anything for bytes that are not an archive
        what = (str(error) or type(error).__name__)[:100]
        raise CloudFileFault(f"{file}: not a readable NPZ file ({what!r})") from error
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
    """Return float64 metres; integers are millimetres."""
    with np.errstate(invalid="ignore"):  # a signalling NaN is a NaN
        metres = points.astype(np.float64)
    return metres / 1000.0 if points.dtype.kind in "iu" else metres


def _scans(file: Path, arrays: Arrays) -> Iterator[RecordedScan]:
    points, start, pose = arrays["points"], _first(arrays, "scan_start", "offsets"), _first(arrays, "pose", "poses")
    assert start is not None  # noqa: S101  # _is_scans
    assert pose is not None  # noqa: S101  # _is_scans
    count = len(start) - 1
    fits = start.ndim == 1 and start.dtype.kind in "iu" and count >= 0
    if not fits or pose.shape != (count, 4, 4) or pose.dtype.kind not in "iuf":
        raise CloudFileFault(
            f"{file}: expected K + 1 integer scan starts and K poses (K, 4, 4), found {start.shape} and {pose.shape}"
        )
    starts = start.astype(np.int64)
    if count and (starts[0] < 0 or np.any(np.diff(starts) < 0) or starts[-1] > len(points)):
        raise CloudFileFault(
            f"{file}: expected scan starts that rise from 0 to at most {len(points)}, the number of points"
        )
    poses = pose.astype(np.float64)
    check_poses(file, poses)
    stamps = _scan_stamps(file, arrays, count)
    return (
        RecordedScan(
            _metres(points[starts[k] : starts[k + 1]]),
            int(stamps[k]),
            poses[k, :3, 3],
            np.array(quaternion_of(poses[k, :3, :3].tolist())),
        )
        for k in range(count)
    )


def _scan_stamps(file: Path, arrays: Arrays, count: int) -> npt.NDArray[np.int64]:
    name = next((name for name in ("stamp_ns", "stamp_s") if name in arrays), None)
    if name is None:
        return np.arange(count, dtype=np.int64) * (NANOSECONDS // 10)
    given = arrays[name]
    if given.shape != (count,) or given.dtype.kind not in "iuf" or not np.isfinite(given.astype(np.float64)).all():
        raise CloudFileFault(f"{file}: expected {count} finite stamps in {name}, found {given.dtype} {given.shape}")
    fault = stamps_fault(name, given)
    if fault is not None:
        raise CloudFileFault(f"{file}: {fault}")
    if name == "stamp_ns":
        return given.astype(np.int64)
    return np.rint(given.astype(np.float64) * NANOSECONDS).astype(np.int64)


def _placed(file: Path, arrays: Arrays) -> Iterator[PlacedPoints]:
    points = arrays["points"]
    count = len(points)
    stamps = np.atleast_1d(arrays.get("stamp_ns", np.zeros(1, np.int64)))
    if stamps.dtype.kind not in "iu" or stamps.shape not in {(1,), (count,)}:
        raise CloudFileFault(f"{file}: expected stamp_ns as one or {count} integers, found {stamps.shape}")
    if (fault := outside("stamp_ns", stamps)) is not None:
        raise CloudFileFault(f"{file}: {fault}")
    stamp_ns = stamps.astype(np.int64)
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
