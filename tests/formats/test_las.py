"""LAS and LAZ: bytes by the specification, and files of laspy."""

import struct
from collections import Counter
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import laspy
import numpy as np
import pytest
from cloud_writers import las_bytes, las_record, on_grid

from roughmap_service.formats import las
from roughmap_service.formats.crs import crs_of
from roughmap_service.formats.las import read_las
from roughmap_service.formats.options import ReadOptions
from roughmap_service.formats.recorded import CloudFileFault, PlacedPoints

POINTS = np.array(
    [[515_396.25, 4_918_348.5, 2_324.0], [515_397.0, 4_918_349.0, 2_325.0], [515_398.0, 4_918_350.0, 2_326.0]]
)

STREAM = ReadOptions(scan_seconds=0.1)

WKT = 'PROJCS["WGS 84 / UTM zone 13N",GEOGCS["WGS 84"],UNIT["metre",1],AUTHORITY["EPSG","32613"]]'
DEGREES = 'COMPD_CS["WGS 84 + height",GEOGCS["WGS 84",UNIT["degree",0.017]],VERT_CS["height",UNIT["metre",1]]]'
FEET = (
    'PROJCS["NAD83 / Colorado (ftUS)",GEOGCS["NAD83",UNIT["degree",0.017]],UNIT["US survey foot",0.3048006096012192]]'
)


def write(folder: Path, content: bytes, name: str = "cloud.las") -> Path:
    (folder / name).write_bytes(content)
    return folder / name


def keys(*entries: tuple[int, int]) -> bytes:
    table = [(1, 1, 0, len(entries)), *((key, 0, 1, value) for key, value in entries)]
    return las_record(b"LASF_Projection", 34735, b"".join(struct.pack("<4H", *row) for row in table))


def together(parts: list[PlacedPoints]) -> np.ndarray:
    return np.concatenate([np.empty((0, 3)), *(part.points for part in parts)])


@pytest.mark.parametrize(("minor", "form"), [(2, 0), (2, 1), (4, 1), (4, 6)])
def test_whole_numbers_times_scale_plus_offset(tmp_path: Path, minor: int, form: int) -> None:
    (part,) = read_las(write(tmp_path, las_bytes(POINTS, minor=minor, form=form, extra=5)), ReadOptions())
    assert np.array_equal(part.points, on_grid(POINTS))
    assert part.stamp_ns == 0
    assert part.covariance is None


@pytest.mark.parametrize(("version", "form"), [("1.2", 3), ("1.3", 5), ("1.4", 7), ("1.4", 10)])
@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_files_of_laspy(tmp_path: Path, version: str, form: int, suffix: str) -> None:
    header = laspy.LasHeader(version=version, point_format=form)
    header.scales, header.offsets = np.array([0.001, 0.002, 0.01]), np.array([500_000.0, 4_900_000.0, 0.0])
    header.add_extra_dim(laspy.ExtraBytesParams("confidence", "f4"))
    cloud = laspy.LasData(header)
    cloud.xyz = POINTS
    cloud.gps_time = np.array([1.0, 2.0, 3.0])
    cloud.classification = np.array([2, 7, 5])
    cloud.withheld = np.array([0, 0, 1])
    cloud.write(tmp_path / f"cloud.{suffix}")
    left_out: Counter[str] = Counter()
    options = ReadOptions(left_out=lambda reason, count: left_out.update({reason: count}))
    (part,) = read_las(tmp_path / f"cloud.{suffix}", options)
    assert np.array_equal(part.points, np.asarray(laspy.read(tmp_path / f"cloud.{suffix}").xyz)[:1])
    assert left_out == {"noise": 1, "withheld": 1}


def test_noise_and_withheld_points_are_left_out_and_counted_once(tmp_path: Path) -> None:
    points = np.repeat(POINTS[:1], 6, axis=0) + np.arange(6)[:, None]
    file = write(
        tmp_path,
        las_bytes(
            points, minor=4, form=6, encoding=1, times=np.arange(6.0)[::-1], classes=np.array([2, 7, 18, 12, 7, 0]),
            withheld=np.array([False, False, False, False, True, False]),
        ),
    )  # fmt: skip
    for options, order in ((ReadOptions(), [0, 3, 5]), (STREAM, [5, 3, 0])):
        left_out: Counter[str] = Counter()
        options = replace(options, left_out=lambda reason, count, into=left_out: into.update({reason: count}))  # noqa: PLW2901
        assert np.array_equal(together(list(read_las(file, options))), on_grid(points[order]))
        assert left_out == {"noise": 2, "withheld": 1}


def test_class_18_was_free_before_point_format_6(tmp_path: Path) -> None:
    (part,) = read_las(write(tmp_path, las_bytes(POINTS, classes=np.array([18, 7, 2]))), ReadOptions())
    assert np.array_equal(part.points, on_grid(POINTS[[0, 2]]))


def test_adjusted_times_are_stamps_of_utc(tmp_path: Path) -> None:
    """GPS was 14 s ahead of UTC in 2008, and is 18 s ahead since 2017."""
    moments = [datetime(2008, 6, 1, tzinfo=UTC), datetime(2016, 12, 31, 23, 59, 59, tzinfo=UTC)]
    moments.append(datetime(2024, 9, 10, 12, 32, 37, tzinfo=UTC))
    leaps = [14, 17, 18]
    epoch = datetime(1980, 1, 6, tzinfo=UTC)
    times = np.array([(m - epoch).total_seconds() + s - 1e9 for m, s in zip(moments, leaps, strict=True)]) + 0.125
    parts = list(read_las(write(tmp_path, las_bytes(POINTS, encoding=1, times=times)), STREAM))
    assert [part.stamp_ns.tolist() for part in parts if not isinstance(part.stamp_ns, int)] == [
        [int(moment.timestamp()) * 10**9 + 125_000_000] for moment in moments
    ]


def test_scans_end_at_whole_multiples(tmp_path: Path) -> None:
    times = np.array([10.0, 10.09, 10.1])
    notes: list[str] = []
    options = ReadOptions(scan_seconds=0.1, note=notes.append)
    parts = list(read_las(write(tmp_path, las_bytes(POINTS, times=times)), options))
    assert [part.points.tolist() for part in parts] == [on_grid(POINTS[:2]).tolist(), on_grid(POINTS[2:]).tolist()]
    assert len(notes) == 1
    assert "gps_time is the time of an unknown week" in notes[0]


@pytest.mark.parametrize("held", [60, 4_000_000])
def test_points_out_of_order_are_sorted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, held: int) -> None:
    monkeypatch.setattr(las, "HELD_ROWS", held)
    monkeypatch.setattr(las, "PART_ROWS", 30)
    times = np.random.default_rng(3).integers(0, 100, 500) / 100
    points = np.repeat(POINTS[:1], 500, axis=0)
    points[:, 0] += np.arange(500)
    notes: list[str] = []
    shares: list[float] = []
    options = ReadOptions(scan_seconds=0.05, note=notes.append, reached=shares.append)
    parts = list(read_las(write(tmp_path, las_bytes(points, times=times)), options))
    order = np.argsort(np.rint(times * 1e9), kind="stable")
    assert np.array_equal(together(parts), on_grid(points[order]))
    assert np.array_equal(np.concatenate([part.stamp_ns for part in parts]), np.rint(times[order] * 1e9))
    assert all(len({*(part.stamp_ns // 50_000_000).tolist()}) == 1 for part in parts)
    assert max(len(part.points) for part in parts) <= 30
    assert "not in the order of gps_time" in notes[-1]
    assert shares == sorted(shares)


def test_too_many_points_out_of_order_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(las, "HELD_ROWS", 2)
    with pytest.raises(CloudFileFault, match="sort the file first"):
        list(read_las(write(tmp_path, las_bytes(POINTS, times=np.array([0.03, 0.02, 0.01]))), STREAM))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (las_bytes(POINTS, form=0), "no gps_time"),
        (las_bytes(POINTS), "the same gps_time"),
        (las_bytes(POINTS, times=np.array([1.0, 2.0, 3e8])), "seconds of the GPS week"),
        (las_bytes(POINTS, times=np.array([1.0, 2.0, 1e300])), "found 1 .. 1e[+]300;"),
        (las_bytes(POINTS, times=np.array([1.0, np.nan, 3.0])), "seconds of the GPS week"),
        (las_bytes(POINTS, times=np.array([1.0, 2.0, 1e12]), encoding=1), "adjusted standard GPS time"),
        (las_bytes(POINTS, records=(las_record(b"LASF_Projection", 2112, FEET.encode()),), encoding=16), "in feet"),
        (las_bytes(POINTS, records=(keys((1024, 1), (3072, 2232), (3076, 9003)),)), "in feet"),
        (las_bytes(POINTS, records=(keys((1024, 2), (2048, 4326)),)), "in degrees"),
        (las_bytes(POINTS, records=(las_record(b"LASF_Projection", 2112, DEGREES.encode()),), encoding=16), "degrees"),
        (las_bytes(POINTS)[:-1], "cut off"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_by_time(tmp_path: Path, content: bytes, said: str) -> None:
    with pytest.raises(CloudFileFault, match=said):
        list(read_las(write(tmp_path, content), STREAM))


@pytest.mark.parametrize(
    ("records", "encoding", "crs"),
    [
        ((), 0, None),
        ((las_record(b"LASF_Projection", 2112, WKT.encode() + b"\0"),), 16, WKT),
        ((las_record(b"other", 1, b"x"), las_record(b"LASF_Projection", 2112, WKT.encode())), 0, WKT),
        ((keys((1024, 1), (3072, 32613)),), 0, "EPSG:32613"),
        ((keys((1024, 1), (2048, 4326), (3072, 32767)),), 0, None),
        ((keys((1024, 1), (3072, 32613)), las_record(b"LASF_Projection", 2112, WKT.encode())), 16, WKT),
    ],
)
def test_the_reference_system_is_kept(
    tmp_path: Path, records: tuple[bytes, ...], encoding: int, crs: str | None
) -> None:
    file = write(tmp_path, las_bytes(POINTS, records=records, encoding=encoding))
    assert crs_of(file) == crs
    assert np.array_equal(together(list(read_las(file, ReadOptions()))), on_grid(POINTS))


def test_a_reference_system_beside_a_file_must_be_in_metres(tmp_path: Path) -> None:
    file = write(tmp_path, b"1 2 3\n", "cloud.xyz")
    (tmp_path / "cloud.prj").write_text(FEET)
    with pytest.raises(CloudFileFault, match=r"cloud\.prj: .* in feet"):
        crs_of(file)


def test_the_reference_system_beside_a_file(tmp_path: Path) -> None:
    file = write(tmp_path, b"1 2 3\n", "cloud.xyz")
    assert crs_of(file) is None
    (tmp_path / "cloud.prj").write_text(WKT + "\n")
    assert crs_of(file) == WKT
    (tmp_path / "cloud.prj").write_bytes(b"\0" * 70_000)
    with pytest.raises(CloudFileFault, match=r"cloud\.prj"):
        crs_of(file)
