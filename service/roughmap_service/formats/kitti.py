"""Sequences of KITTI's odometry benchmark: a folder with scans in `velodyne/000000.bin` and so on.

A .bin file has x, y, z and the intensity of each point, float32, in the scanner's frame. Beside `velodyne`:

    poses.txt    poses of camera 0, twelve numbers in each line (3x4, row by row); or in ../../poses/NN.txt for
                 sequences/NN, as the benchmark has it
    calib.txt    its line `Tr:` (3x4) takes points of the scanner to camera 0
    times.txt    seconds from the beginning, one in each line; without it, ten scans a second

The map frame is the first scanner's, x forward and z up: a pose is Tr^-1 P Tr. With a trajectory (`--poses`, as
`formats.trajectories` has it), that gives the scanner's poses, and neither poses.txt nor calib.txt is read.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from roughmap_schemas.geometry import MAX_STAMP_S, SECOND_NS, quaternion_of
from roughmap_service.formats.blocks import size_of
from roughmap_service.formats.options import ReadOptions
from roughmap_service.formats.poses import BOTTOM, check_poses
from roughmap_service.formats.recorded import CloudFileFault, Floats, RecordedScan
from roughmap_service.formats.trajectories import StampedPose, poses_of_clouds

POINT_BYTES = 16

MAX_SCAN_BYTES = 20_000_000 * POINT_BYTES

MAX_TEXT_BYTES = 1 << 30


def read_kitti(folder: Path, options: ReadOptions) -> Iterator[RecordedScan]:
    """Yield the scans of a sequence. Raises CloudFileFault and OSError."""
    files = sorted((folder / "velodyne").glob("*.bin"))
    if not files:
        raise CloudFileFault(f"{folder / 'velodyne'}: expected scans 000000.bin and so on, found none")
    numbers = _numbers(files)
    poses = _poses(folder, numbers, options)
    for k, (file, pose) in enumerate(zip(files, poses, strict=True), 1):
        points = _scan(file)
        if pose is None:
            options.left_out("no_pose", len(points))
        elif len(points):
            yield RecordedScan(points, *pose)
        options.reached(k / len(files))


def _numbers(files: list[Path]) -> list[int]:
    for file in files:
        if not (file.stem.isascii() and file.stem.isdigit() and len(file.stem) <= 9):
            raise CloudFileFault(f"{file}: expected the scan's number as its name, such as 000000.bin")
    return [int(file.stem) for file in files]


def _scan(file: Path) -> Floats:
    with file.open("rb") as stream:
        size = size_of(stream)
        if size % POINT_BYTES or size > MAX_SCAN_BYTES:
            raise CloudFileFault(
                f"{file}: expected points of {POINT_BYTES} bytes (x, y, z, intensity), at most {MAX_SCAN_BYTES} bytes, "
                f"found {size} bytes; the file is cut off, or of another format"
            )
        data = stream.read(size)
    values = np.frombuffer(data[: len(data) // POINT_BYTES * POINT_BYTES], "<f4").reshape(-1, 4)
    with np.errstate(invalid="ignore"):  # a signalling NaN is a NaN
        return values[:, :3].astype(np.float64)


def _poses(folder: Path, numbers: list[int], options: ReadOptions) -> list[StampedPose | None]:
    """Return the pose of the scanner in the map at each scan."""
    times = folder / "times.txt"
    stamps = _stamps(times, numbers) if times.is_file() else None
    if options.poses is not None:
        return poses_of_clouds(folder, stamps, len(numbers), options.poses, options.note)
    file = next(
        (
            path
            for path in (folder / "poses.txt", folder.parent.parent / "poses" / f"{folder.name}.txt")
            if path.is_file()
        ),
        None,
    )
    calib = folder / "calib.txt"
    if file is None or not calib.is_file():
        missing = "poses" if file is None else "calib.txt, which takes the camera's poses to the scanner's,"
        raise CloudFileFault(
            f"{folder}: no {missing} beside velodyne; add it, or give a trajectory of the scanner with --poses, which "
            f"`kiss_icp_pipeline {folder / 'velodyne'}` estimates (pip install kiss-icp)"
        )
    cameras = _rows(file, _text(file), 12).reshape(-1, 3, 4)
    if max(numbers) >= len(cameras):
        raise CloudFileFault(f"{file}: expected a pose for scan {max(numbers)}, found {len(cameras)} poses")
    poses = _scanner_poses(file, cameras, calib)
    own = [number * SECOND_NS // 10 for number in numbers] if stamps is None else stamps
    return [
        StampedPose(stamp, poses[k, :, 3].copy(), np.array(quaternion_of(poses[k, :, :3].tolist())))
        for k, stamp in zip(numbers, own, strict=True)
    ]


def _scanner_poses(file: Path, cameras: Floats, calib: Path) -> Floats:
    """Return Tr^-1 P Tr, (K, 3, 4), of the cameras' poses P."""
    lines = [line for line in _text(calib) if line.startswith(("Tr:", "Tr_velo_to_cam:"))]
    tr = _rows(calib, [lines[0].partition(":")[2]] if lines else [], 12).reshape(-1, 3, 4)
    if not len(tr):
        raise CloudFileFault(f"{calib}: expected a line 'Tr:' with 12 numbers, found none")
    for where, poses in ((file, cameras), (calib, tr)):
        check_poses(where, np.concatenate([poses, np.broadcast_to(BOTTOM, (len(poses), 1, 4))], axis=1))
    turn, shift = tr[0, :, :3], tr[0, :, 3]
    back = np.concatenate([turn.T, -_product(turn.T, shift[:, None])], axis=1)
    return _chained(back, _chained(cameras, tr[0]))


def _chained(a: Floats, b: Floats) -> Floats:
    """Return the transforms a b, (..., 3, 4)."""
    out = _product(a[..., :3], b)
    out[..., 3] += a[..., 3]
    return out


def _product(a: Floats, b: Floats) -> Floats:
    """Return the products of matrices (..., 3, 3) and (..., 3, N), summed in a fixed order."""
    terms = [a[..., :, k, None] * b[..., None, k, :] for k in range(3)]
    return np.asarray(terms[0] + terms[1] + terms[2])


def _stamps(file: Path, numbers: list[int]) -> list[int]:
    seconds = _rows(file, _text(file), 1)[:, 0]
    if max(numbers) >= len(seconds):
        raise CloudFileFault(f"{file}: expected a time for scan {max(numbers)}, found {len(seconds)} times")
    if not ((seconds >= 0) & (seconds < MAX_STAMP_S)).all():
        raise CloudFileFault(f"{file}: expected seconds from 0 to 2^32, found {seconds.min()} .. {seconds.max()}")
    stamps: npt.NDArray[np.int64] = np.rint(seconds * SECOND_NS).astype(np.int64)
    return [int(stamps[k]) for k in numbers]


def _text(file: Path) -> list[str]:
    with file.open("rb") as stream:
        if size_of(stream) > MAX_TEXT_BYTES:
            raise CloudFileFault(f"{file}: expected at most {MAX_TEXT_BYTES} bytes of text")
        return stream.read().decode("utf-8", "replace").splitlines()


def _rows(file: Path, lines: list[str], width: int) -> Floats:
    """Return the numbers of lines, `width` in each; empty lines are skipped."""
    rows = []
    for number, line in enumerate(lines, 1):
        words = line.split()
        if not words:
            continue
        try:
            row = [float(word) for word in words]
        except ValueError:
            row = []
        if len(row) != width or not np.isfinite(row).all():
            raise CloudFileFault(f"{file}, line {number}: expected {width} finite numbers, found {line[:60]!r}")
        rows.append(row)
    return np.array(rows, dtype=np.float64).reshape(-1, width)
