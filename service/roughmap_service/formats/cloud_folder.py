"""Scans in a folder, one cloud in each file, with a trajectory beside them (`--poses`).

The clouds are PLY, PCD, NPZ or XYZ files in the sensor's frame, in the natural order of their names (2 before 10). A
stamp is found by the name if all names have one:

    1725981157.851716757.ply    seconds and a fraction
    1725981157_851716757.pcd    seconds and nanoseconds
    1725981157851716757.pcd     nanoseconds, microseconds (16 digits), milliseconds (13) or seconds (9 or 10)

with any letters before. Otherwise the first cloud has the first pose and so on. Without a trajectory, PCD files with
viewpoints have poses of their own; clouds that have none can't be placed.
"""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from roughmap_schemas.geometry import MAX_STAMP_S, SECOND_NS
from roughmap_service.formats.clouds import CLOUD_SUFFIXES, reader_of
from roughmap_service.formats.options import ReadOptions
from roughmap_service.formats.recorded import CloudFileFault, Floats, PlacedPoints, RecordedScan
from roughmap_service.formats.trajectories import StampedPose, poses_of_clouds

MAX_SCAN_POINTS = 20_000_000
"""Most points of one scan: 480 MB."""

NAME = re.compile(r"\D*(\d{1,19})(?:([._])(\d{1,9}))?", re.ASCII)

DIGITS = {9: SECOND_NS, 10: SECOND_NS, 13: 1_000_000, 16: 1_000, 18: 1, 19: 1}
"""Nanoseconds in the unit of a whole number of so many digits."""


def read_cloud_folder(folder: Path, options: ReadOptions) -> Iterator[RecordedScan]:
    """Yield the scans of a folder. Raises CloudFileFault and OSError."""
    files = clouds_in(folder, options.poses)
    stamps = stamps_by_name(files)
    poses: list[StampedPose | None] = [None] * len(files)
    if options.poses is not None:
        poses = poses_of_clouds(folder, stamps, len(files), options.poses, options.note)
    for k, (file, pose) in enumerate(zip(files, poses, strict=True)):
        points, own = _cloud(file, options)
        placed = own if options.poses is None else pose
        if options.poses is None and own is None:
            raise CloudFileFault(no_poses(folder, file))
        if placed is None:
            options.left_out("no_pose", len(points))
        elif len(points):
            stamp = pose.stamp_ns if pose is not None else k * SECOND_NS // 10 if stamps is None else stamps[k]
            yield RecordedScan(points, stamp, placed.position, placed.rotation)
        options.reached((k + 1) / len(files))


def no_poses(folder: Path, file: Path) -> str:
    """Return the line about scans without poses."""
    return (
        f"{file}: a cloud without a pose; give a trajectory with --poses, which `kiss_icp_pipeline {folder}` estimates "
        "(pip install 'kiss-icp[all]'), or give the files themselves if the clouds are in the map frame"
    )


def clouds_in(folder: Path, poses: Path | None = None) -> list[Path]:
    """Return the clouds in a folder, without the file of `poses`, in the natural order of their names."""
    return sorted(
        (
            path
            for path in folder.iterdir()
            if path.suffix.lower() in CLOUD_SUFFIXES
            and not path.name.startswith(".")
            and path.is_file()
            and not (poses is not None and poses.exists() and path.samefile(poses))
        ),
        key=_natural,
    )


def _natural(path: Path) -> tuple[list[str | int], str]:
    """Return the key of the natural order: text and numbers in turn."""
    words = re.split(r"([0-9]+)", path.name)
    return [int(word[:400]) if k % 2 else word for k, word in enumerate(words)], path.name


def stamps_by_name(files: list[Path]) -> list[int] | None:
    """Return the stamps that the names of clouds tell, in nanoseconds; None if any tells none."""
    stamps = []
    for file in files:
        found = NAME.fullmatch(file.name.removesuffix(file.suffix))
        if found is None:
            return None
        whole, mark, rest = found.groups()
        if mark == ".":
            stamp = int(whole) * SECOND_NS + int(rest.ljust(9, "0"))
        elif mark == "_" and len(whole) in {9, 10}:
            stamp = int(whole) * SECOND_NS + int(rest)
        elif mark is None and len(whole) in DIGITS:
            stamp = int(whole) * DIGITS[len(whole)]
        else:
            return None
        if stamp >= MAX_STAMP_S * SECOND_NS:
            return None
        stamps.append(stamp)
    return stamps or None


def _cloud(file: Path, options: ReadOptions) -> tuple[Floats, RecordedScan | None]:
    """Return the points of a cloud, and its first part if that has a pose of its own."""
    own: RecordedScan | None = None
    parts: list[Floats] = []
    rows = 0
    for part in reader_of(file)(file, ReadOptions(left_out=options.left_out)):
        scan = part if isinstance(part, RecordedScan) else None
        several = scan is not None and own is not None and not np.array_equal(scan.position, own.position)
        if several or not isinstance(part, RecordedScan | PlacedPoints):
            raise CloudFileFault(f"{file}: expected one cloud, found several scans; give the file itself")
        own = own or scan
        parts.append(part.points)
        rows += len(part.points)
        if rows > MAX_SCAN_POINTS:
            raise CloudFileFault(f"{file}: expected one scan of at most {MAX_SCAN_POINTS} points, found more")
    return np.concatenate([np.empty((0, 3)), *parts]), own
