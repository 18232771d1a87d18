"""KITTI sequences, TUM trajectories and folders of clouds: each scan has the pose of its moment."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from cloud_writers import pcd_bytes, ply_bytes, write_kitti, write_tum
from scipy.spatial.transform import Rotation, Slerp

from roughmap_service.formats.cloud_folder import stamps_by_name
from roughmap_service.formats.clouds import read_cloud
from roughmap_service.formats.options import ReadOptions
from roughmap_service.formats.recorded import CloudFileFault, RecordedScan
from roughmap_service.formats.trajectories import read_trajectory

SECOND = 10**9
START = 1_725_981_157 * SECOND


def poses(count: int) -> np.ndarray:
    """Poses on a curve, the first one at the origin."""
    out = np.tile(np.eye(4), (count, 1, 1))
    turns = Rotation.from_rotvec(np.arange(count)[:, None] * [0.02, -0.03, 0.4])
    out[:, :3, :3] = turns.as_matrix()
    out[:, :3, 3] = np.arange(count)[:, None] * [1.0, 0.5, -0.25]
    return out


def scans_of(path: Path, options: ReadOptions | None = None) -> list[RecordedScan]:
    scans = list(read_cloud(path, options))
    assert all(isinstance(scan, RecordedScan) for scan in scans)
    return scans  # type: ignore[return-value]


def matrices(scans: list[RecordedScan]) -> np.ndarray:
    out = np.tile(np.eye(4), (len(scans), 1, 1))
    out[:, :3, :3] = Rotation.from_quat([scan.rotation for scan in scans]).as_matrix()
    out[:, :3, 3] = [scan.position for scan in scans]
    return out


def clouds(folder: Path, names: list[str]) -> Path:
    """A folder of clouds; the k-th has k + 1 points, whose x is k."""
    folder.mkdir()
    for k, name in enumerate(names):
        points = np.zeros((k + 1, 3))
        points[:, 0] = k
        content = pcd_bytes(points, "binary") if name.endswith("pcd") else ply_bytes(points)
        (folder / name).write_bytes(content)
    return folder


@pytest.mark.parametrize("layout", ["poses.txt", "benchmark"])
def test_kitti_poses_are_those_of_the_scanner(tmp_path: Path, layout: str) -> None:
    """The camera looks along the scanner's x, with z ahead and y down."""
    tr = np.array([[0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3], [0, 0, 0, 1.0]])
    points = [np.random.default_rng(k).normal(size=(5, 3)) for k in range(4)]
    folder = write_kitti(tmp_path / "sequences" / "04", points, poses(4), tr, [0.0, 0.1, 0.25, 0.3])
    if layout == "benchmark":
        (tmp_path / "poses").mkdir()
        (folder / "poses.txt").rename(tmp_path / "poses" / "04.txt")
    scans = scans_of(folder)
    assert np.allclose(matrices(scans), poses(4), rtol=0, atol=1e-12)
    assert [scan.stamp_ns for scan in scans] == [0, 100_000_000, 250_000_000, 300_000_000]
    assert all(np.array_equal(s.points, p.astype(np.float32)) for s, p in zip(scans, points, strict=True))


def test_kitti_without_times_has_ten_scans_a_second(tmp_path: Path) -> None:
    folder = write_kitti(tmp_path / "00", [np.ones((1, 3))] * 3, poses(3), np.eye(4), [0.0])
    (folder / "times.txt").unlink()
    (folder / "velodyne" / "000001.bin").unlink()
    scans = scans_of(folder)
    assert [scan.stamp_ns for scan in scans] == [0, 200_000_000]
    assert np.allclose(matrices(scans), poses(3)[[0, 2]])


def test_kitti_with_a_trajectory(tmp_path: Path) -> None:
    folder = write_kitti(tmp_path / "00", [np.ones((1, 3))] * 3, poses(3), np.eye(4), [0.0, 0.1, 0.2])
    (folder / "poses.txt").unlink()
    with pytest.raises(CloudFileFault, match="kiss_icp_pipeline"):
        scans_of(folder)
    trajectory = write_tum(tmp_path / "traj.txt", [0, SECOND // 10, SECOND // 5], poses(3))
    assert np.allclose(matrices(scans_of(folder, ReadOptions(poses=trajectory))), poses(3))


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("poses.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n", "a pose for scan 2, found 1"),
        ("poses.txt", "1 0 0 0 0 1 0 0 0 0 1\n", "line 1: expected 12 finite numbers"),
        ("poses.txt", "2 0 0 0 0 2 0 0 0 0 2 0\n" * 3, "its rotation is scaled by 2"),
        ("times.txt", "0.0\n-1\n2\n", "expected seconds from 0"),
        ("times.txt", "0.0\nx\n2\n", "times.txt, line 2"),
        ("calib.txt", "P0: 1\n", "a line 'Tr:'"),
        ("velodyne/000001.bin", "12345", "points of 16 bytes"),
        ("velodyne/one.bin", "", "the scan's number"),
    ],
)
def test_a_damaged_sequence(tmp_path: Path, name: str, content: str, said: str) -> None:
    folder = write_kitti(tmp_path / "00", [np.ones((1, 3))] * 3, poses(3), np.eye(4), [0.0, 0.1, 0.2])
    (folder / name).write_text(content)
    with pytest.raises(CloudFileFault, match=said) as fault:
        scans_of(folder)
    assert str(folder / name) in str(fault.value)


def test_a_pose_between_two_is_interpolated(tmp_path: Path) -> None:
    stamps = [START, START + SECOND // 2, START + SECOND]
    trajectory = read_trajectory(write_tum(tmp_path / "traj.txt", stamps, poses(3)))
    slerp = Slerp([0, 0.5, 1.0], Rotation.from_matrix(poses(3)[:, :3, :3]))
    for part in (0.0, 0.1, 0.5, 0.7, 1.0):
        pose = trajectory.at(START + round(part * SECOND))
        assert pose is not None
        assert pose.position.tolist() == pytest.approx([2 * part, part, -0.5 * part], abs=1e-12)
        assert (Rotation.from_quat(pose.rotation).inv() * slerp(part)).magnitude() < 1e-9


def test_outside_and_in_a_gap_there_is_no_pose(tmp_path: Path) -> None:
    """But for a millisecond, since programs round stamps."""
    stamps = [START, START + SECOND, START + SECOND + SECOND // 2]
    trajectory = read_trajectory(write_tum(tmp_path / "traj.txt", stamps, poses(3)))
    for stamp in (START - 1_000_001, START + 1_000_001, START + SECOND // 2, stamps[2] + 1_000_001):
        assert trajectory.at(stamp) is None
    for stamp, k in ((START - 1_000_000, 0), (START + 1_000_000, 0), (START + SECOND - 100, 1), (stamps[2] + 100, 2)):
        pose = trajectory.at(stamp)
        assert pose is not None
        assert (pose.stamp_ns, pose.position.tolist()) == (stamp, poses(3)[k, :3, 3].tolist())


def test_stamps_of_a_trajectory_are_exact_to_the_nanosecond(tmp_path: Path) -> None:
    file = tmp_path / "traj.txt"
    file.write_text("# remark\n\n1725981157.851716757 1 2 3 0 0 0 1\n1.725981158e9 1 2 3 0.5000 0.5 -0.5 0.5001\n")
    assert read_trajectory(file).stamps.tolist() == [1725981157851716757, 1725981158000000000]
    assert np.linalg.norm(read_trajectory(file).rotations[1]) == pytest.approx(1, abs=1e-15)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("", "found no pose"),
        ("1 2 3\n", "line 1: expected 8 numbers"),
        ("# t\n1 0 0 0 0 0 0 one\n", "line 2: expected 8 numbers"),
        ("1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "line 2: stamp 1 is not after"),
        ("1 0 0 0 0 0 0 2\n", "norm 2"),
        ("1 nan 0 0 0 0 0 1\n", "finite"),
        ("-1 0 0 0 0 0 0 1\n", "0 to 2"),
        ("nan 0 0 0 0 0 0 1\n", "0 to 2"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 0 0 1\n", "line 2: expected as many numbers"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n2 0 0 0 0 2 0 0 0 0 2 0\n", "pose 1 .*scaled by 2"),
    ],
)
def test_a_trajectory_that_is_none(tmp_path: Path, content: str, said: str) -> None:
    (tmp_path / "traj.txt").write_text(content)
    with pytest.raises(CloudFileFault, match=said):
        read_trajectory(tmp_path / "traj.txt")


@pytest.mark.parametrize(
    ("name", "stamp"),
    [
        ("1725981157.851716757.ply", 1725981157851716757),
        ("1725981157.85.ply", 1725981157850000000),
        ("scan_1725981157_51716757.pcd", 1725981157051716757),
        ("1725981157851716757.ply", 1725981157851716757),
        ("1725981157851716.ply", 1725981157851716000),
        ("1725981157851.ply", 1725981157851000000),
        ("1725981157.ply", 1725981157000000000),
        ("12.5.ply", 12500000000),
        ("000012.ply", None),
        ("cloud.ply", None),
        ("12_5.ply", None),
        ("1725981157851716757_left.ply", None),
        ("9999999999.ply", None),
    ],
)
def test_stamps_in_names(name: str, stamp: int | None) -> None:
    assert stamps_by_name([Path(name)]) == (None if stamp is None else [stamp])


def test_clouds_have_the_pose_of_their_stamp(tmp_path: Path) -> None:
    names = ["1725981157.05.ply", "1725981157.15.pcd", "1725981157.5.ply"]
    trajectory = write_tum(tmp_path / "traj.txt", [START + k * SECOND // 10 for k in range(3)], poses(3))
    left_out: Counter[str] = Counter()
    options = ReadOptions(poses=trajectory, left_out=lambda why, count: left_out.update({why: count}))
    scans = scans_of(clouds(tmp_path / "scans", names), options)
    assert [scan.stamp_ns for scan in scans] == [START + 50_000_000, START + 150_000_000]
    assert [scan.position[0] for scan in scans] == pytest.approx([0.5, 1.5])
    assert [len(scan.points) for scan in scans] == [1, 2]
    assert left_out == {"no_pose": 3}, "the last cloud is 0.3 s after the last pose"


def test_numbered_clouds_have_the_poses_in_turn(tmp_path: Path) -> None:
    folder = clouds(tmp_path / "scans", ["2.ply", "10.ply", "11.pcd"])
    trajectory = write_tum(folder / "traj.txt", [SECOND, 2 * SECOND, 3 * SECOND], poses(3))
    notes: list[str] = []
    scans = scans_of(folder, ReadOptions(poses=trajectory, note=notes.append))
    assert [scan.points[0, 0] for scan in scans] == [0, 1, 2]
    assert [scan.stamp_ns for scan in scans] == [SECOND, 2 * SECOND, 3 * SECOND]
    assert np.allclose(matrices(scans), poses(3))
    assert "no stamps in their names" in notes[0]


def test_poses_of_another_clock_are_taken_in_turn(tmp_path: Path) -> None:
    """Odometry programs that don't know the stamps number their poses."""
    folder = clouds(tmp_path / "scans", ["1725981157.05.ply", "1725981157.15.pcd"])
    trajectory = write_tum(tmp_path / "traj.txt", [0, SECOND], poses(2))
    notes: list[str] = []
    scans = scans_of(folder, ReadOptions(poses=trajectory, note=notes.append))
    assert [scan.stamp_ns for scan in scans] == [START + 50_000_000, START + 150_000_000]
    assert np.allclose(matrices(scans), poses(2))
    assert "no stamps of these clouds" in notes[0]


def test_numbered_poses_beside_stamps_near_zero(tmp_path: Path) -> None:
    """0, 1, 2 are no seconds then: they would fit one scan only."""
    folder = write_kitti(tmp_path / "00", [np.ones((1, 3))] * 3, poses(3), np.eye(4), [0.0, 0.1, 0.2])
    trajectory = write_tum(tmp_path / "traj.txt", [0, SECOND, 2 * SECOND], poses(3))
    scans = scans_of(folder, ReadOptions(poses=trajectory))
    assert [scan.stamp_ns for scan in scans] == [0, 100_000_000, 200_000_000]
    assert np.allclose(matrices(scans), poses(3))


def test_poses_in_the_form_of_kitti(tmp_path: Path) -> None:
    folder = clouds(tmp_path / "scans", ["1725981157.05.ply", "1725981157.15.pcd"])
    rows = [" ".join(map(repr, pose[:3].ravel().tolist())) for pose in poses(2)]
    (tmp_path / "poses.txt").write_text("\n".join(rows))
    scans = scans_of(folder, ReadOptions(poses=tmp_path / "poses.txt"))
    assert [scan.stamp_ns for scan in scans] == [START + 50_000_000, START + 150_000_000]
    assert np.allclose(matrices(scans), poses(2), rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("names", "count", "said"),
    [
        (["1.ply", "2.ply"], 3, "2 clouds without stamps in their names, but 3 poses"),
        (["1725981257.5.ply"], 3, "of the time of a cloud"),
        (["1.ply"], 0, "kiss_icp_pipeline"),
    ],
)
def test_clouds_that_have_no_pose(tmp_path: Path, names: list[str], count: int, said: str) -> None:
    folder = clouds(tmp_path / "scans", names)
    trajectory = write_tum(tmp_path / "traj.txt", [START + k for k in range(count)], poses(count)) if count else None
    with pytest.raises(CloudFileFault, match=said) as fault:
        scans_of(folder, ReadOptions(poses=trajectory))
    assert str(folder) in str(fault.value)


def test_viewpoints_are_poses_of_a_folder(tmp_path: Path) -> None:
    for k in range(2):
        (tmp_path / f"{k}.pcd").write_bytes(pcd_bytes(np.ones((2, 3)), "ascii", viewpoint=f"{k + 1} 0 0 1 0 0 0"))
    scans = scans_of(tmp_path)
    assert [scan.position[0] for scan in scans] == [1, 2]
    assert [scan.stamp_ns for scan in scans] == [0, 100_000_000]


def test_recordings_of_scans_are_no_single_clouds(tmp_path: Path) -> None:
    np.savez(tmp_path / "1.npz", points=np.ones((2, 3)), scan_start=[0, 1, 2], pose=poses(2))
    with pytest.raises(CloudFileFault, match="found several scans"):
        scans_of(tmp_path)


def test_a_folder_of_something_else(tmp_path: Path) -> None:
    (tmp_path / "readme.md").write_text("hello")
    with pytest.raises(CloudFileFault, match="not a recording"):
        scans_of(tmp_path)
