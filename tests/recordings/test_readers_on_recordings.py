"""Real recordings through every reader: the map is that of an NPZ file with the same numbers, to the bit."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import laspy
import numpy as np
import pytest
from cloud_writers import grid_of, las_bytes, pcd_bytes, ply_bytes, tum_line, write_kitti

from roughmap import Limits, Noise, RoughMap, Scan, Trajectory
from roughmap_service.formats.clouds import read_cloud
from roughmap_service.formats.options import ReadOptions
from roughmap_service.formats.recorded import PlacedPoints, RecordedScan

EVERY = 8
"""Of the hall's million points every eighth: the writers are plain loops."""

SIGMA = np.eye(3) * 4e-4
POSE_SIGMA = np.diag([0.05, 0.05, 0.05, 0.01, 0.01, 0.01]) ** 2

GPS_AHEAD_NS = (18 - 315_964_800 - 1_000_000_000) * 10**9
"""Adjusted standard GPS time less UTC, since 2017."""

LOCAL = (0.0, 0.0, 0.0)


def digest(parts: Iterable[object]) -> str:
    """The digest of the map of a recording."""
    rough_map = RoughMap()
    for part in parts:
        if isinstance(part, PlacedPoints):
            rough_map.add(part.points, SIGMA, part.stamp_ns)
        else:
            assert isinstance(part, RecordedScan)
            stamps = np.array([part.stamp_ns])
            trajectory = Trajectory(stamps, part.position[None], part.rotation[None], POSE_SIGMA[None])
            rough_map.add_scan(Scan(part.points, part.stamp_ns), trajectory, Noise(0.01), Limits())
    assert rough_map.tile_count
    return rough_map.digest()


@pytest.fixture(scope="module")
def hall(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> list[RecordedScan]:
    """The hall's scans, in numbers of float32, as an NPZ gives them."""
    with np.load(recordings / "hall_sequence.npz") as file:
        start, poses, stamps = file["scan_start"], file["pose"], file["stamp_s"]
        points = [(file["points"][a:b:EVERY] / 1000).astype(np.float32) for a, b in pairwise(start)]
    path = tmp_path_factory.mktemp("hall") / "hall.npz"
    starts = np.cumsum([0, *map(len, points)])
    np.savez(path, points=np.concatenate(points), scan_start=starts, pose=poses, stamp_s=stamps)
    scans = list(read_cloud(path))
    assert len(scans) == 14
    return scans  # type: ignore[return-value]


@pytest.fixture(scope="module")
def hall_digest(hall: list[RecordedScan]) -> str:
    return digest(hall)


def trajectory(file: Path, scans: list[RecordedScan]) -> Path:
    file.write_text("".join(tum_line(scan.stamp_ns, scan.position, scan.rotation) for scan in scans))
    return file


def test_a_survey_in_laz_gives_the_map_of_its_numbers(recordings: Path, tmp_path: Path) -> None:
    np.savez(tmp_path / "survey.npz", points=np.asarray(laspy.read(recordings / "lone-star.laz").xyz))
    parts = list(read_cloud(recordings / "lone-star.laz"))
    assert [len(part.points) for part in parts] == [500_000, 18_862]
    assert digest(parts) == digest(read_cloud(tmp_path / "survey.npz"))


@pytest.mark.parametrize(
    ("suffix", "content"),
    [
        ("ply", lambda points: ply_bytes(points, "binary_little_endian", "float")),
        ("ply", lambda points: ply_bytes(points, "binary_big_endian", "double")),
        ("ply", lambda points: ply_bytes(points, "ascii", "float")),
        ("pcd", lambda points: pcd_bytes(points, "ascii", 4)),
        ("pcd", lambda points: pcd_bytes(points, "binary", 4)),
        ("pcd", lambda points: pcd_bytes(points, "binary_compressed", 8)),
        ("xyz", lambda points: "".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in points.tolist()).encode()),
    ],
)
def test_the_hall_as_a_folder_of_scans(
    hall: list[RecordedScan], hall_digest: str, tmp_path: Path, suffix: str, content: Callable[[np.ndarray], bytes]
) -> None:
    for scan in hall:
        (tmp_path / f"{scan.stamp_ns}.{suffix}").write_bytes(content(scan.points))
    poses = trajectory(tmp_path / "traj.txt", hall)
    assert digest(read_cloud(tmp_path, ReadOptions(poses=poses))) == hall_digest


def test_the_hall_as_pcd_files_with_viewpoints(hall: list[RecordedScan], hall_digest: str, tmp_path: Path) -> None:
    for scan in hall:
        x, y, z, w = scan.rotation.tolist()
        viewpoint = " ".join(map(repr, (*scan.position.tolist(), w, x, y, z)))
        content = pcd_bytes(scan.points, "binary", 4, viewpoint)
        (tmp_path / f"{scan.stamp_ns // 10**9}_{scan.stamp_ns % 10**9:09d}.pcd").write_bytes(content)
    assert digest(read_cloud(tmp_path)) == hall_digest


def test_the_hall_as_a_kitti_sequence(recordings: Path, hall: list[RecordedScan], tmp_path: Path) -> None:
    """Stamps count from the beginning there."""
    with np.load(recordings / "hall_sequence.npz") as file:
        poses = file["pose"]
    times = [round((scan.stamp_ns - hall[0].stamp_ns) / 1e9, 6) for scan in hall]
    folder = write_kitti(tmp_path / "00", [scan.points for scan in hall], poses, np.eye(4), times)
    (folder / "times.txt").write_text("".join(f"{second!r}\n" for second in times))
    expected = [scan._replace(stamp_ns=round(second * 1e9)) for scan, second in zip(hall, times, strict=True)]
    assert digest(read_cloud(folder)) == digest(expected)


@pytest.fixture(scope="module")
def placed(hall: list[RecordedScan]) -> list[tuple[np.ndarray, int]]:
    """The hall's scans in the map, on the grid of a LAS file, and their stamps in whole microseconds."""
    from scipy.spatial.transform import Rotation

    scans = []
    for scan in hall:
        points = Rotation.from_quat(scan.rotation).apply(scan.points) + scan.position
        scans.append((grid_of(points, 0.001, LOCAL) * 0.001 + 0.0, scan.stamp_ns // 1000 * 1000))
    return scans


def test_the_hall_as_a_survey_by_gps_time(placed: list[tuple[np.ndarray, int]], tmp_path: Path) -> None:
    """In the order of time, and shuffled."""
    points = np.concatenate([scan for scan, _ in placed])
    stamps = np.repeat([stamp for _, stamp in placed], [len(scan) for scan, _ in placed])
    times = (stamps + GPS_AHEAD_NS) / 1e9
    read_ns = np.rint(times * 1e9).astype(np.int64) - GPS_AHEAD_NS
    assert np.abs(read_ns - stamps).max() < 100, "a float64 of such seconds has steps of 30 ns"
    order = np.random.default_rng(5).permutation(len(points))
    file = tmp_path / "hall.las"
    options = ReadOptions(scan_seconds=0.2)

    def content(rows: np.ndarray) -> bytes:
        return las_bytes(points[rows], form=6, minor=4, encoding=1, times=times[rows], scale=0.001, offset=LOCAL)

    file.write_bytes(content(np.arange(len(points))))
    parts = list(read_cloud(file, options))
    assert [len(part.points) for part in parts] == [len(scan) for scan, _ in placed]
    for part, (scan, stamp) in zip(parts, placed, strict=True):
        assert isinstance(part, PlacedPoints)
        assert np.array_equal(part.points, scan)
        assert np.abs(part.stamp_ns - stamp).max() < 100
    file.write_bytes(content(order))
    notes: list[str] = []
    shuffled = list(read_cloud(file, replace(options, note=notes.append)))
    assert "not in the order of gps_time" in notes[0]
    for part, other in zip(shuffled, parts, strict=True):
        assert np.array_equal(np.sort(part.points, axis=0), np.sort(other.points, axis=0))
    np.savez(tmp_path / "hall.npz", points=points)
    file.write_bytes(content(np.arange(len(points))))
    assert digest(read_cloud(file)) == digest(read_cloud(tmp_path / "hall.npz"))


@pytest.mark.parametrize("suffix", ["las", "laz", "ply", "pcd"])
def test_the_off_road_sweep_as_one_cloud(recordings: Path, tmp_path: Path, suffix: str) -> None:
    """With the 36,392 slots that had no return, which are not a number (in LAS: not there)."""
    with np.load(recordings / "offroad_tradr" / "clouds" / "1725981157_851716757.npz") as file:
        cloud = file["cloud"]
    points = np.stack([cloud["x"], cloud["y"], cloud["z"]], axis=1).astype(np.float64)
    path = tmp_path / f"sweep.{suffix}"
    if suffix in {"las", "laz"}:
        points = points[np.isfinite(points).all(axis=1)]
        points = grid_of(points, 0.001, LOCAL) * 0.001 + 0.0
        path.write_bytes(las_bytes(points, scale=0.001, offset=LOCAL))
        if suffix == "laz":
            laspy.read(path).write(path)
    else:
        path.write_bytes(ply_bytes(points, kind="float") if suffix == "ply" else pcd_bytes(points, "binary", 4))
    np.savez(tmp_path / "sweep.npz", points=points)
    assert digest(read_cloud(path)) == digest(read_cloud(tmp_path / "sweep.npz"))
