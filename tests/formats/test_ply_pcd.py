"""PLY and PCD: bytes by the specifications, and files of trimesh and pypcd4."""

import struct
from pathlib import Path

import lzf as other_lzf
import numpy as np
import pypcd4
import pytest
import trimesh
from cloud_writers import pcd_bytes, pcd_head, ply_bytes
from hypothesis import given
from hypothesis import strategies as st

from roughmap_service.formats.lzf import unpack
from roughmap_service.formats.options import ReadOptions
from roughmap_service.formats.pcd import read_pcd
from roughmap_service.formats.ply import read_ply
from roughmap_service.formats.recorded import CloudFileFault, PlacedPoints, RecordedScan

POINTS = np.array([[0.5, -1.25, 2.0], [1e6, 2e6, np.nan], [7.0, 8.0, 9.0]])


def write(folder: Path, content: bytes, name: str) -> Path:
    (folder / name).write_bytes(content)
    return folder / name


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
@pytest.mark.parametrize("mesh", [False, True])
def test_files_of_trimesh(tmp_path: Path, encoding: str, mesh: bool) -> None:
    points = np.random.default_rng(1).normal(size=(50, 3)).astype(np.float32)
    what = trimesh.Trimesh(points, [[0, 1, 2], [3, 4, 5]], process=False) if mesh else trimesh.PointCloud(points)
    file = write(tmp_path, trimesh.exchange.ply.export_ply(what, encoding=encoding), "cloud.ply")
    (part,) = read_ply(file, ReadOptions())
    assert np.allclose(part.points, points, rtol=0, atol=1e-7 if encoding == "ascii" else 0)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("kind", ["float", "double"])
def test_faces_colours_and_cameras_of_a_ply_are_skipped(tmp_path: Path, form: str, kind: str) -> None:
    (part,) = read_ply(write(tmp_path, ply_bytes(POINTS, form, kind), "cloud.ply"), ReadOptions())
    assert np.array_equal(part.points, POINTS, equal_nan=True)
    assert (part.stamp_ns, part.covariance) == (0, None)


def test_whole_numbers_in_a_ply(tmp_path: Path) -> None:
    lines = (
        "ply",
        "format binary_big_endian 1.0",
        "element vertex 1",
        "property int16 y",
        "property uint8 x",
        "property uint z",
    )
    head = "".join(f"{line}\r\n" for line in lines).encode()
    file = write(tmp_path, head + b"end_header\r\n" + struct.pack(">hBI", -300, 200, 70_000), "cloud.ply")
    (part,) = read_ply(file, ReadOptions())
    assert part.points.tolist() == [[200, -300, 70_000]]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (b"ply\n", b"plY\n", "not a PLY file"),
        (b"format ascii 1.0", b"format ascii 2.0", "line 2: not a line of a PLY header: 'format ascii 2.0'"),
        (b"element vertex 3", b"element vertices 3", "element vertex, found face, vertices, camera"),
        (b"property double z", b"property double h", "found red, x, y, h"),
        (b"property uchar red", b"property list uchar int red", "found a list"),
        (b"element vertex 3", b"element vertex 9", "expected 4 numbers as the header says, found 1|expected 9 points"),
        (b"element vertex 3", b"element vertex -3", "line 6"),
        (b"200 0.5", b"200 0,5", "expected numbers"),
        (b"end_header", b"end_heade", "line 13"),
    ],
)
def test_a_ply_that_is_none(tmp_path: Path, old: bytes, new: bytes, said: str) -> None:
    content = ply_bytes(POINTS, "ascii")
    assert old in content
    with pytest.raises(CloudFileFault, match=said):
        list(read_ply(write(tmp_path, content.replace(old, new, 1), "cloud.ply"), ReadOptions()))


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
@pytest.mark.parametrize("size", [4, 8])
def test_other_fields_of_a_pcd_are_skipped(tmp_path: Path, data: str, size: int) -> None:
    (part,) = read_pcd(write(tmp_path, pcd_bytes(POINTS, data, size), "cloud.pcd"), ReadOptions())
    assert isinstance(part, PlacedPoints)
    assert np.array_equal(part.points, POINTS, equal_nan=True)


@pytest.mark.parametrize("encoding", list(pypcd4.Encoding)[:3])
def test_files_of_pypcd4(tmp_path: Path, encoding: pypcd4.Encoding) -> None:
    """Long enough and so regular that the compressed one has copies."""
    points = np.round(np.random.default_rng(1).normal(size=(5000, 3)) * 4).astype(np.float32)
    values = np.column_stack([points, np.zeros(len(points), np.float32)])
    pypcd4.PointCloud.from_xyzi_points(values).save(tmp_path / "cloud.pcd", encoding)
    (part,) = read_pcd(tmp_path / "cloud.pcd", ReadOptions())
    assert np.array_equal(part.points, points)


def test_a_viewpoint_is_the_pose_of_the_scan(tmp_path: Path) -> None:
    half = repr(0.5**0.5)
    file = write(tmp_path, pcd_bytes(POINTS, "binary", viewpoint=f"10 20 30 {half} 0 0 {half}"), "cloud.pcd")
    (scan,) = read_pcd(file, ReadOptions())
    assert isinstance(scan, RecordedScan)
    assert np.array_equal(scan.points, POINTS, equal_nan=True)
    assert scan.position.tolist() == [10, 20, 30]
    assert scan.rotation.tolist() == pytest.approx([0, 0, 0.5**0.5, 0.5**0.5])


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (b"FIELDS intensity _ x y z", b"FIELDS intensity _ x y h", "the fields intensity _ x y h"),
        (b"TYPE F U F F F", b"TYPE F U F F", "4 types"),
        (b"SIZE 4 1 8", b"SIZE 4 1 3", "field x of type F, size 3"),
        (b"COUNT 1 3 1", b"COUNT 1 3 2", "field x of type F, size 8, count 2"),
        (b"POINTS 3", b"POINTS 4", "WIDTH 3, HEIGHT 1, POINTS 4"),
        (b"VIEWPOINT 0 0 0 1", b"VIEWPOINT 0 0 0 0", "unit quaternion"),
        (b"DATA binary_compressed", b"DATA zipped", "DATA zipped"),
        (b"VERSION 0.7", b"VERZION 0.7", "not a line of a PCD header"),
    ],
)
def test_a_pcd_that_is_none(tmp_path: Path, old: bytes, new: bytes, said: str) -> None:
    content = pcd_bytes(POINTS, "binary_compressed")
    assert old in content
    with pytest.raises(CloudFileFault, match=said):
        list(read_pcd(write(tmp_path, content.replace(old, new, 1), "cloud.pcd"), ReadOptions()))


def test_sizes_of_compressed_data_are_checked_before_memory_is_taken(tmp_path: Path) -> None:
    """Three billion points of 31 bytes, in ten bytes."""
    head = (
        pcd_head(POINTS, "binary_compressed")
        .replace(b"WIDTH 3", b"WIDTH 130000000")
        .replace(b"POINTS 3", b"POINTS 130000000")
    )
    file = write(tmp_path, head + struct.pack("<II", 10, 130_000_000 * 31) + bytes(10), "cloud.pcd")
    with pytest.raises(CloudFileFault, match="in 10 of compressed data"):
        list(read_pcd(file, ReadOptions()))


def test_lzf_by_hand() -> None:
    """Two bytes, a copy of 3 from distance 2 that overlaps itself, a long copy (9 + 4) from distance 1."""
    packed = bytes([1, 65, 66, (3 - 2) << 5, 1, 7 << 5, 13 - 9, 0])
    assert unpack(packed, 18).tobytes() == b"ABABA" + b"A" * 13
    for damaged, size in ((packed, 17), (packed, 19), (packed[:-1], 18), (b"\x05ab", 6), (b"\x20\x05", 3), (b"", 1)):
        assert unpack(damaged, size) is None


@given(st.lists(st.sampled_from([b"abc", b"\0" * 300, b"xyzw" * 9, b"q"]), min_size=1, max_size=40).map(b"".join))
def test_lzf_of_another_program(data: bytes) -> None:
    packed = other_lzf.compress(data)
    if packed is not None:
        assert unpack(packed, len(data)).tobytes() == data
