"""Recorded clouds: each layout is read, each fault is one line that names the file."""

import os
from pathlib import Path

import numpy as np
import pytest

from roughmap_schemas.cloud import decode_cloud
from roughmap_schemas.odometry import decode_odometry
from roughmap_service.formats import npz, text
from roughmap_service.formats.clouds import read_cloud
from roughmap_service.formats.recorded import CloudFileFault, PlacedPoints, RecordedScan
from roughmap_service.simulation.playing import recorded_messages


def write(folder: Path, **arrays: object) -> Path:
    file = folder / "cloud.npz"
    np.savez(file, **arrays)  # type: ignore[arg-type]
    return file


def scans(folder: Path, **other: object) -> Path:
    pose = np.tile(np.eye(4), (2, 1, 1))
    pose[1, :3, 3] = 1, 2, 3
    arrays: dict[str, object] = {
        "points": np.arange(15, dtype=np.int32).reshape(5, 3) * 1000,
        "scan_start": np.array([0, 2, 5]),
        "stamp_s": np.array([1.5, 2.0]),
        "pose": pose,
    }
    return write(folder, **(arrays | other))


def scans_of(file: Path) -> list[RecordedScan]:
    found = list(read_cloud(file))
    assert all(isinstance(part, RecordedScan) for part in found)
    return found  # type: ignore[return-value]  # as asserted


def test_scans_of_whole_millimetres(tmp_path: Path) -> None:
    first, second = scans_of(scans(tmp_path))
    assert np.array_equal(first.points, [[0, 1, 2], [3, 4, 5]])
    assert (first.stamp_ns, second.stamp_ns) == (1_500_000_000, 2_000_000_000)
    assert len(second.points) == 3
    assert np.array_equal(second.position, [1, 2, 3])
    assert np.array_equal(second.rotation, [0, 0, 0, 1])


def test_scans_in_metres_without_stamps(tmp_path: Path) -> None:
    file = write(
        tmp_path, points=np.ones((4, 3), np.float32), offsets=np.array([0, 4]), poses=np.eye(4, dtype=np.float64)[None]
    )
    (scan,) = read_cloud(file)
    assert isinstance(scan, RecordedScan)
    assert scan.points.dtype == np.float64
    assert scan.stamp_ns == 0


def test_recorded_scans_become_messages_with_their_pose_first(tmp_path: Path) -> None:
    messages = list(recorded_messages(scans(tmp_path), "walker", "head"))
    assert [m.kind for m in messages] == ["odometry", "points", "odometry", "points"]
    assert {m.robot for m in messages} == {"walker"}
    pose = decode_odometry(messages[2].payload, max_message=1 << 16)
    assert np.array_equal(pose.position, [1, 2, 3])
    assert pose.covariance is None
    cloud = decode_cloud(messages[3].payload, max_message=1 << 20, max_points=100)
    assert cloud.frame_id == "head"
    assert cloud.stamp_ns == pose.stamp_ns == 2_000_000_000
    assert np.array_equal(cloud.points, np.arange(6, 15).reshape(3, 3))


def test_placed_points_come_in_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(npz, "PART_ROWS", 4)
    points = np.random.default_rng(0).normal(size=(10, 3))
    covariance = np.tile(np.eye(3), (10, 1, 1)) * np.arange(10)[:, None, None]
    parts = list(read_cloud(write(tmp_path, points=points, stamp_ns=np.arange(10), covariance=covariance)))
    assert [len(part.points) for part in parts] == [4, 4, 2]
    assert all(isinstance(part, PlacedPoints) for part in parts)
    assert np.array_equal(np.concatenate([part.points for part in parts]), points)
    last = parts[-1]
    assert isinstance(last, PlacedPoints)
    assert np.array_equal(last.stamp_ns, [8, 9])
    assert last.covariance is not None
    assert np.array_equal(last.covariance, covariance[8:])


@pytest.mark.parametrize(
    "content",
    [
        "1 2 3\n4.5 -5 6e-1\n",
        "1,2,3\n4.5,-5,6e-1",
        "# written by hand\n\n1;2;3;99\n// more\n4.5;-5;0.6;98\n",
        "1\t2\t3 # a remark\n4.5\t-5\t0.6\n",
        'intensity,"Y",z,X\n7,2,3,1\n8,-5,0.6,4.5\n',
    ],
)
def test_text_in_its_many_forms(tmp_path: Path, content: str) -> None:
    file = tmp_path / "points.csv"
    file.write_text(content)
    (part,) = read_cloud(file)
    assert np.array_equal(part.points, [[1, 2, 3], [4.5, -5, 0.6]])


def test_text_in_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(text, "BLOCK", 16)
    file = tmp_path / "points.xyz"
    file.write_text("x y z\n" + "".join(f"{k} {k} {k}\n" for k in range(7)))
    assert np.concatenate([part.points for part in read_cloud(file)])[:, 0].tolist() == list(range(7))


def test_an_empty_text_file_has_no_points(tmp_path: Path) -> None:
    file = tmp_path / "points.txt"
    file.write_text("")
    assert list(read_cloud(file)) == []


@pytest.mark.parametrize(
    ("other", "said"),
    [
        ({"points": np.zeros((5, 2))}, "numeric points"),
        ({"points": np.array([["a", "b", "c"]])}, "numeric points"),
        ({"scan_start": np.array([0, 9, 5])}, "scan starts that rise"),
        ({"scan_start": np.array([0, 2, 6])}, "at most 5"),
        ({"scan_start": np.array([0.0, 2.0, 5.0])}, "integer scan starts"),
        ({"pose": np.zeros((2, 3, 4))}, "poses"),
        ({"pose": np.full((2, 4, 4), np.nan)}, "pose 0: nan in row 0"),
        ({"pose": np.full((2, 4, 4), "a")}, "poses"),
        ({"stamp_s": np.array([1.0])}, "2 finite stamps"),
        ({"stamp_s": np.array([1.0, -3.0])}, "expected seconds since the epoch"),
        ({"stamp_s": np.array([1.0, np.nan])}, "finite stamps"),
    ],
)
def test_scans_that_are_none(tmp_path: Path, other: dict[str, object], said: str) -> None:
    file = scans(tmp_path, **other)
    with pytest.raises(CloudFileFault, match=said) as caught:
        scans_of(file)
    assert str(file) in str(caught.value)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("cloud.npz", b"not an archive", "not a readable NPZ"),
        ("cloud.npz", b"", "not a readable NPZ"),
        ("cloud.npz", b"PK\x03\x04 torn", "not a readable NPZ"),
        ("cloud.csv", b"1 2\n", "line 1: expected three numbers"),
        ("cloud.csv", b"1 2 three\n", "line 1: 'three' is not a number"),
        ("cloud.bin", b"", "unknown file format"),
        ("cloud", b"", "no suffix"),
    ],
)
def test_files_that_are_no_clouds(tmp_path: Path, name: str, content: bytes, said: str) -> None:
    file = tmp_path / name
    file.write_bytes(content)
    with pytest.raises(CloudFileFault, match=said):
        list(read_cloud(file))


def test_placed_points_are_played_as_clouds_in_the_map_frame(tmp_path: Path) -> None:
    stamps = np.array([5, 7], np.int64)
    (message,) = recorded_messages(write(tmp_path, points=np.array([[1, 2, 3.5], [4, 5, 6]]), stamp_ns=stamps))
    cloud = decode_cloud(message.payload, max_message=1 << 16, max_points=9)
    assert (cloud.frame_id, cloud.stamp_ns, cloud.points.tolist()) == ("map", 5, [[1, 2, 3.5], [4, 5, 6]])


def test_a_single_array_is_no_archive(tmp_path: Path) -> None:
    file = tmp_path / "points.npz"
    with file.open("wb") as out:
        np.save(out, np.zeros((3, 3)))
    with pytest.raises(CloudFileFault, match="single array"):
        list(read_cloud(file))


@pytest.mark.parametrize("suffix", [".ply", ".xyz", ".las", ".bag", ".mcap"])
def test_a_pipe_is_no_recording_and_is_not_waited_for(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    os.mkfifo(path)
    with pytest.raises(CloudFileFault, match="found a pipe"):
        list(read_cloud(path))
