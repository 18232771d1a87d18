"""Cells as points, read back by other libraries, or by hand."""

import struct

import numpy as np
import pytest
import trimesh
from exported_map import SIDE, Stored
from pypcd4 import PointCloud

OTHERS = ("interval_95", "confidence", "slope", "traversability")


def expected(stored: Stored) -> tuple[np.ndarray, np.ndarray]:
    """Places (N, 3) and values (N, 4) of the known cells, sorted by place."""
    heights = stored.layers["mean_height"]
    j, i = np.nonzero(np.isfinite(heights))
    places = np.column_stack([stored.low[0] + (i + 0.5) * SIDE, stored.low[1] + (j + 0.5) * SIDE, heights[j, i]])
    return in_order(places, np.column_stack([stored.layers[name][j, i] for name in OTHERS]))


def in_order(places: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    order = np.lexsort((places[:, 0].round(3), places[:, 1].round(3)))
    return places[order], values[order]


def test_a_ply_keeps_survey_coordinates_exactly(stored: Stored, export) -> None:
    with export("cells.ply").open("rb") as opened:
        read = trimesh.load(opened, file_type="ply")
    data = read.metadata["_ply_raw"]["vertex"]["data"]
    places, values = in_order(np.asarray(read.vertices), np.column_stack([data[name] for name in OTHERS]))
    wanted, layers = expected(stored)
    assert np.array_equal(places, wanted)
    assert np.array_equal(values, layers, equal_nan=True)


def test_a_pcd_has_its_origin_in_the_header(stored: Stored, export) -> None:
    file = export("cells.pcd")
    read = PointCloud.from_path(file)
    x, y, z, *_ = (float(number) for number in read.metadata.viewpoint)
    assert (x, y, z) == (412_400.0, 5_654_300.0, 0.0)
    assert all(type_ == "F" and size == 4 for type_, size in zip(read.metadata.type, read.metadata.size, strict=True))
    points = read.numpy(("x", "y", "z")).astype(np.float64) + np.array([x, y, z])
    places, values = in_order(points, read.numpy(OTHERS))
    wanted, layers = expected(stored)
    # Within 100 m of the origin a float32 is off by at most 4 um.
    assert places == pytest.approx(wanted, abs=4e-6, rel=0)
    assert np.array_equal(values, layers, equal_nan=True)


def test_a_las_has_layers_and_crs_beside_the_points(stored: Stored, export) -> None:
    wkt = 'PROJCS["WGS 84 / UTM zone 33N"]'
    raw = export("cells.las", "--crs", wkt).read_bytes()
    # The public header block of LAS 1.4, read by its offsets in the specification.
    assert raw[:4] == b"LASF"
    assert raw[24:26] == bytes([1, 4])
    assert struct.unpack_from("<H", raw, 6)[0] & 16, "the WKT bit"
    begin, vlrs, form, length = struct.unpack_from("<IIBH", raw, 96)
    scale, offset = struct.unpack_from("<3d", raw, 131), struct.unpack_from("<3d", raw, 155)
    (count,) = struct.unpack_from("<Q", raw, 247)
    assert form == 6
    wanted, layers = expected(stored)
    assert count == len(wanted)
    row = np.dtype({
        "names": ["place", "returns", "class", "values"],
        "formats": [("<i4", 3), "u1", "u1", ("<f4", 4)],
        "offsets": [0, 14, 16, 30],
        "itemsize": length,
    })  # fmt: skip
    points = np.frombuffer(raw, row, count, begin)
    places, values = in_order(points["place"] * scale + offset, points["values"])
    assert places == pytest.approx(wanted, abs=scale[0] / 2 * 1.001, rel=0)
    assert np.array_equal(values, layers, equal_nan=True)
    assert set(points["class"]) == {2}
    assert set(points["returns"]) == {0x11}
    header = raw[struct.unpack_from("<H", raw, 94)[0] : begin]
    assert vlrs == 2
    assert wkt.encode() in header
    for name in OTHERS:
        assert name.encode() in header


def test_a_laz_holds_what_the_las_holds(export) -> None:
    import laspy

    las, laz = laspy.read(export("cells.las")), laspy.read(export("cells.laz"))
    assert np.array_equal(las.points.array, laz.points.array)


def test_a_code_becomes_wkt_where_a_format_has_no_codes(export) -> None:
    assert b"PROJCS[" in export("cells.las", "--crs", "EPSG:32633").read_bytes()
    said = export("ground.asc", "--crs", "EPSG:32633").with_suffix(".prj").read_text()
    assert said.startswith('PROJCS["WGS_1984_UTM_Zone_33N"')
