"""What every reader of recordings must do: one `Sample` for each form of a format, and the checks in test_reader_kit.

A sample's file must come from another program than the reader's library, or from bytes written here by the format's
specification.
"""

import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import laspy
import numpy as np
import pypcd4
import pytest
from bag_writers import T0 as FIRST_STAMP
from bag_writers import Said, drive, write_foxglove, write_mcap_folder, write_mcap_ros2, write_ros1, write_sqlite
from cloud_writers import OFFSET, SCALE, las_bytes, on_grid, pcd_bytes, ply_bytes, write_kitti, write_tum

from roughmap_schemas.cloud import decode_cloud
from roughmap_schemas.kinds import RobotMessage
from roughmap_service.formats.clouds import reader_of
from roughmap_service.formats.options import ReadOptions
from roughmap_service.formats.recorded import CloudFileFault, PlacedPoints, RecordedScan

PARTS = 100
"""Rows of a part in these tests; text comes in as many lines of at least six characters."""

FIRST_NS = 1_725_981_157_000_000_000


def itself(points: np.ndarray) -> np.ndarray:
    return points


def in_ten_decimals(points: np.ndarray) -> np.ndarray:
    return np.array([[float(f"{value:.10f}") for value in row] for row in points]).reshape(-1, 3)


def in_float32(points: np.ndarray) -> np.ndarray:
    return points.astype(np.float32).astype(np.float64)


class Sample(NamedTuple):
    """A form of a format. `write` makes a file or folder with the points in `folder`; `held` are the points that it can
    hold. `options` are those to read it with. `damaged`: the files to damage, if `write` makes a folder. `extra`: the
    module that it needs, and the extra that has it."""

    name: str
    reader: str
    write: Callable[[Path, np.ndarray], Path]
    held: Callable[[np.ndarray], np.ndarray] = itself
    options: Callable[[Path], ReadOptions] = lambda _: ReadOptions()
    damaged: Callable[[Path], list[Path]] = lambda path: [path]
    extra: tuple[str, str] | None = None


def in_file(name: str, content: Callable[[np.ndarray], bytes]) -> Callable[[Path, np.ndarray], Path]:
    def write(folder: Path, points: np.ndarray) -> Path:
        (folder / name).write_bytes(content(points))
        return folder / name

    return write


def npz(folder: Path, points: np.ndarray) -> Path:
    np.savez(folder / "cloud.npz", points=points)
    return folder / "cloud.npz"


def xyz(points: np.ndarray) -> bytes:
    return "".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in points.tolist()).encode()


def laz(folder: Path, points: np.ndarray) -> Path:
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, SCALE), np.array(OFFSET)
    las = laspy.LasData(header)
    las.xyz = points
    las.write(folder / "cloud.laz")
    return folder / "cloud.laz"


def pypcd(encoding: str) -> Callable[[Path, np.ndarray], Path]:
    def write(folder: Path, points: np.ndarray) -> Path:
        cloud = pypcd4.PointCloud.from_points(points, ("x", "y", "z"), (np.float64,) * 3)
        cloud.save(folder / "cloud.pcd", pypcd4.Encoding(encoding))
        return folder / "cloud.pcd"

    return write


def halves(points: np.ndarray) -> list[np.ndarray]:
    return [points[: len(points) // 2], points[len(points) // 2 :]]


def kitti(folder: Path, points: np.ndarray) -> Path:
    return write_kitti(folder / "00", halves(points), np.tile(np.eye(4), (2, 1, 1)), np.eye(4), [0.0, 0.1])


def clouds(folder: Path, points: np.ndarray) -> Path:
    (folder / "scans").mkdir()
    for k, part in enumerate(halves(points)):
        (folder / "scans" / f"{FIRST_NS + k * 10**8}.ply").write_bytes(ply_bytes(part))
    write_tum(folder / "traj.txt", [FIRST_NS, FIRST_NS + 10**8], np.tile(np.eye(4), (2, 1, 1)))
    return folder / "scans"


def bag(write: Callable[[Path, Sequence[Said]], Path]) -> Callable[[Path, np.ndarray], Path]:
    """Write the points as two clouds of a robot, with its poses and its sensor's place on it."""

    def written(folder: Path, points: np.ndarray) -> Path:
        said = [one for one in drive(0.2) if one.kind != "cloud"]
        for k, part in enumerate(halves(points)):
            rows = np.column_stack((part, np.zeros(len(part)))).astype("<f4")
            content = {"stamp_ns": FIRST_STAMP + k, "frame": "velodyne", "rows": rows}
            said.append(Said("/velodyne_points", "cloud", said[-1].log_ns + 1, content))
        return write(folder / "bag", said)

    return written


SAMPLES = [
    Sample("npz", "npz.read_npz", npz),
    Sample("text", "text.read_text", in_file("cloud.xyz", xyz)),
    Sample("las 1.2", "las.read_las", in_file("cloud.las", las_bytes), on_grid),
    Sample("las 1.4", "las.read_las", in_file("cloud.las", lambda p: las_bytes(p, minor=4, form=6)), on_grid),
    Sample("laz", "las.read_las", laz, on_grid, extra=("lazrs", "las")),
    Sample(
        "las by time",
        "las.read_las",
        in_file("cloud.las", lambda p: las_bytes(p, times=np.arange(len(p)) / 1000)),
        on_grid,
        lambda _: ReadOptions(scan_seconds=0.5),
    ),
    *(
        Sample(f"ply {form}", "ply.read_ply", in_file("cloud.ply", lambda p, form=form: ply_bytes(p, form)))
        for form in ("ascii", "binary_little_endian", "binary_big_endian")
    ),
    *(
        Sample(f"pcd {data}", "pcd.read_pcd", in_file("cloud.pcd", lambda p, data=data: pcd_bytes(p, data)))
        for data in ("ascii", "binary", "binary_compressed")
    ),
    Sample("pypcd4 ascii", "pcd.read_pcd", pypcd("ascii"), in_ten_decimals),
    *(Sample(f"pypcd4 {data}", "pcd.read_pcd", pypcd(data)) for data in ("binary", "binary_compressed")),
    *(
        Sample(name, reader, bag(write), in_float32, damaged=damaged)
        for name, reader, write, damaged in (
            ("rosbag2 sqlite3", "bags.read_bag", write_sqlite, lambda p: [p / "drive_0.db3", p / "metadata.yaml"]),
            ("rosbag2 mcap", "bags.read_bag", write_mcap_folder, lambda p: [p / "drive_0.mcap", p / "metadata.yaml"]),
            ("ros 1 bag", "bags.read_bag", lambda p, said: write_ros1(p.with_suffix(".bag"), said), lambda p: [p]),
            ("mcap ros 2", "mcaps.read_mcap", lambda p, s: write_mcap_ros2(p.with_suffix(".mcap"), s), lambda p: [p]),
            ("mcap foxglove", "mcaps.read_mcap", lambda p, s: write_foxglove(p.with_suffix(".mcap"), s), lambda p: [p]),
        )
    ),
    Sample(
        "kitti",
        "kitti.read_kitti",
        kitti,
        in_float32,
        damaged=lambda path: [path / name for name in ("velodyne/000001.bin", "poses.txt", "calib.txt", "times.txt")],
    ),
    Sample(
        "folder of clouds",
        "cloud_folder.read_cloud_folder",
        clouds,
        options=lambda path: ReadOptions(poses=path.parent / "traj.txt"),
        damaged=lambda path: [path / f"{FIRST_NS + 10**8}.ply", path.parent / "traj.txt"],
    ),
]  # fmt: skip


def points_of(parts: Iterator[object]) -> tuple[np.ndarray, list[int]]:
    """The points of all parts, and how many each part of placed points has."""
    points, rows = [np.empty((0, 3))], []
    for part in parts:
        if isinstance(part, PlacedPoints | RecordedScan):
            assert part.points.dtype == np.float64
            assert part.points.ndim == 2
            assert part.points.shape[1] == 3
            points.append(part.points)
            if isinstance(part, PlacedPoints):
                rows.append(len(part.points))
        elif isinstance(part, RobotMessage) and part.kind == "points":
            found = decode_cloud(part.payload, max_message=1 << 30, max_points=1 << 24).points
            with np.errstate(invalid="ignore"):  # a signalling NaN is a NaN
                points.append(found.astype(np.float64))
    return np.concatenate(points), rows


def read(sample: Sample, path: Path) -> np.ndarray:
    """The points of a recording, by the reader that is chosen for it."""
    return points_of(reader_of(path)(path, sample.options(path)))[0]


def read_or_fault(sample: Sample, path: Path, damaged: Path) -> np.ndarray | None:
    """The points, or None if the reader says in one line what is wrong and names the file."""
    try:
        return read(sample, path)
    except CloudFileFault as fault:
        text = str(fault)
        assert str(damaged) in text or str(path) in text, text
        assert "\n" not in text
        assert len(text) < 600
        return None


def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let all readers give parts of `PARTS` rows."""
    for name, module in list(sys.modules.items()):
        if name.startswith("roughmap_service.formats."):
            for constant, value in (("PART_ROWS", PARTS), ("BLOCK", 6 * PARTS)):
                if hasattr(module, constant):
                    monkeypatch.setattr(module, constant, value)
