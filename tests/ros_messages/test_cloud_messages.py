"""PointCloud2 becomes a cloud of the contract with the same points and fields."""

import io
import struct

import numpy as np
import pytest
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from mcap.reader import make_reader
from mcap_ros2.writer import Writer
from ros_cdr_bytes import Field, point_cloud

from roughmap_ros.messages import TYPES, BadRosMessage, cloud_message
from roughmap_schemas.cloud import Cloud, decode_cloud
from roughmap_schemas.kinds import Kind

XYZ32: tuple[Field, ...] = (("x", 0, 7), ("y", 4, 7), ("z", 8, 7))
LETTERS = dict(zip(range(1, 9), "bBhHiIfd", strict=True))
KINDS = dict(zip(range(1, 9), ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"), strict=True))


def decoded(cdr: bytes) -> Cloud:
    return decode_cloud(cloud_message(cdr, 99).payload, max_message=10**7, max_points=10**5)


def points_of(fields: tuple[Field, ...], rows: list[list[float]], step: int, order: str = "<") -> bytes:
    data = bytearray(b"\xab" * (step * len(rows)))
    for number, row in enumerate(rows):
        for (_, offset, datatype, *_), value in zip(fields, row, strict=True):
            struct.pack_into(order + LETTERS[datatype], data, number * step + offset, value)
    return bytes(data)


def test_kind_and_arrival_are_told() -> None:
    message = cloud_message(point_cloud(bytes(12), XYZ32, 12, 1), 99)
    assert (message.kind, message.log_ns) == (Kind.POINTS, 99)


def test_stamp_and_frame_are_kept_and_a_first_slash_is_not() -> None:
    cloud = decoded(point_cloud(bytes(12), XYZ32, 12, 1, stamp_ns=1_700_000_000_123_456_789, frame="/velo/dyne"))
    assert (cloud.stamp_ns, cloud.frame_id) == (1_700_000_000_123_456_789, "velo/dyne")


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("coordinates", [7, 8])
@pytest.mark.parametrize("big_endian", [False, True])
def test_all_types_at_odd_offsets_in_any_byte_order(order: str, coordinates: int, big_endian: bool) -> None:
    size = 4 if coordinates == 7 else 8
    fields: list[Field] = [("z", 3, coordinates), ("x", 3 + size, coordinates), ("y", 5 + 2 * size, coordinates)]
    at = 6 + 3 * size
    for datatype, kind in KINDS.items():
        fields.append((f"extra_{kind}", at, datatype))
        at += np.dtype(kind).itemsize + 1
    rows = [[1.5, 2.5, -3.25, -1, 2, -300, 400, -70000, 80000, 0.5, 0.1], [4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14]]
    data = points_of(tuple(fields), rows, at, ">" if big_endian else "<")
    cloud = decoded(point_cloud(data, fields, at, 2, big_endian=big_endian, order=order))
    assert cloud.points.dtype == np.dtype("<f4" if coordinates == 7 else "<f8")
    np.testing.assert_array_equal(cloud.points, [[2.5, -3.25, 1.5], [5, 6, 4]])
    for column, kind in enumerate(KINDS.values(), 3):
        values = cloud.time_values(f"extra_{kind}")
        assert values is not None
        assert values.dtype == np.dtype("<" + kind)
        np.testing.assert_array_equal(values, np.array([row[column] for row in rows], kind))


def test_the_data_of_a_little_endian_cloud_are_its_own_bytes() -> None:
    fields = (*XYZ32, ("time", 14, 7))
    data = points_of(fields, [[1, 2, 3, 0.25], [4, 5, 6, 0.5]], 22)
    message = PointCloud.FromString(cloud_message(point_cloud(data, fields, 22, 2), 0).payload)
    assert message.data == data
    assert message.point_stride == 22
    assert [(f.name, f.offset, f.type) for f in message.fields] == [
        ("x", 0, 7),
        ("y", 4, 7),
        ("z", 8, 7),
        ("time", 14, 7),
    ]


@pytest.mark.parametrize("big_endian", [False, True])
def test_rows_with_padding_are_joined(big_endian: bool) -> None:
    order = ">" if big_endian else "<"
    rows = [[float(n), n + 0.5, -n] for n in range(6)]
    first, second = (points_of(XYZ32, part, 16, order) for part in (rows[:3], rows[3:]))
    for data in (first + b"pad!" + second + b"pad!", first + b"pad!" + second):
        cloud = decoded(point_cloud(data, XYZ32, 16, 3, 2, row_step=52, big_endian=big_endian))
        np.testing.assert_array_equal(cloud.points, rows)


@pytest.mark.parametrize("row_step", [0, 24, 48, 96, 2**32 - 1])
def test_a_wrong_row_step_does_not_matter_where_the_data_are_just_the_points(row_step: int) -> None:
    rows = [[float(n), n + 0.5, -n] for n in range(4)]
    cloud = decoded(point_cloud(points_of(XYZ32, rows, 12), XYZ32, 12, 2, 2, row_step=row_step))
    np.testing.assert_array_equal(cloud.points, rows)


def test_bytes_after_the_points_of_a_single_row_are_left_out() -> None:
    data = points_of(XYZ32, [[1, 2, 3]], 12) + b"more"
    np.testing.assert_array_equal(decoded(point_cloud(data, XYZ32, 12, 1)).points, [[1, 2, 3]])


def test_points_without_a_return_stay() -> None:
    data = points_of(XYZ32, [[float("nan")] * 3, [0, 0, 0]], 12)
    cloud = decoded(point_cloud(data, XYZ32, 12, 2, dense=False))
    np.testing.assert_array_equal(cloud.points, [[np.nan] * 3, [0, 0, 0]])


@pytest.mark.parametrize("big_endian", [False, True])
def test_coordinates_of_two_types_become_float64(big_endian: bool) -> None:
    fields = (("x", 0, 7), ("y", 4, 7), ("z", 8, 8), ("t", 16, 6))
    data = points_of(fields, [[0.5, 2, 0.1, 7], [float("nan"), 5, 1e300, 8]], 20, ">" if big_endian else "<")
    cloud = decoded(point_cloud(data, fields, 20, 2, big_endian=big_endian))
    np.testing.assert_array_equal(cloud.points, [[0.5, 2, 0.1], [np.nan, 5, 1e300]])
    np.testing.assert_array_equal(cloud.time_values("t"), [7, 8])


def test_fields_that_are_no_single_known_number_are_left_out() -> None:
    fields = (*XYZ32, ("many", 12, 7, 2), ("unknown", 12, 9), ("beyond", 20, 8), ("last", 20, 7), ("old", 12, 7, 0))
    cloud = decoded(point_cloud(bytes(24), fields, 24, 1))
    assert [field.name for field in cloud.time_fields] == ["last", "old"]


def test_fields_may_share_bytes_and_names() -> None:
    fields = (*XYZ32, ("rgb", 12, 7), ("rgba", 12, 6), ("", 16, 2), ("_", 17, 2), ("_", 18, 2))
    cloud = decoded(point_cloud(bytes(range(20)), fields, 20, 1, big_endian=True))
    assert {field.name: int(field.values[0]) for field in cloud.time_fields if field.name != "rgb"} == {
        "rgba": 0x0C0D0E0F,
        "": 16,
        "_": 17,
    }


@pytest.mark.parametrize(("width", "height"), [(0, 1), (0, 0), (5, 0)])
@pytest.mark.parametrize("big_endian", [False, True])
def test_a_cloud_without_points_is_empty_and_has_its_fields(width: int, height: int, big_endian: bool) -> None:
    cloud = decoded(point_cloud(b"", (*XYZ32, ("t", 12, 6)), 16, width, height, big_endian=big_endian))
    assert cloud.points.shape == (0, 3)
    assert [field.name for field in cloud.time_fields] == ["t"]


@pytest.mark.parametrize(
    ("cdr", "said"),
    [
        (point_cloud(bytes(8), (("x", 0, 7), ("y", 4, 7)), 8, 1), "expected fields x, y and z within point_step 8"),
        (point_cloud(bytes(12), XYZ32, 10, 1), "found x, y"),
        (point_cloud(bytes(6), (("x", 0, 3), ("y", 2, 3), ("z", 4, 3)), 6, 1), "expected x, y, z as float32"),
        (point_cloud(bytes(12), (("x", 0, 7), ("y", 2, 7), ("z", 8, 7)), 12, 1), "apart; found y at 2"),
        (point_cloud(bytes(12), (*XYZ32, ("t", 8, 6)), 12, 1), "apart; found t at 8"),
        (point_cloud(bytes(23), XYZ32, 12, 2), "expected 1 x 2 points of 12 bytes"),
        (point_cloud(bytes(40), XYZ32, 12, 2, 2, row_step=20), "found 40 bytes of data"),
        (point_cloud(bytes(12), XYZ32, 12, 2**31, 2**31, row_step=24), "found 12 bytes of data"),
        (point_cloud(b"", XYZ32, 2**31, 0), "expected a point_step of at most 65535"),
        (point_cloud(bytes(12), XYZ32 * 22, 12, 1), "expected at most 64 fields; found 66"),
        (point_cloud(bytes(12), XYZ32, 12, 1, stamp_ns=-1), "expected a stamp"),
    ],
)
def test_what_is_no_cloud_is_refused_in_one_line(cdr: bytes, said: str) -> None:
    with pytest.raises(BadRosMessage, match=said) as error:
        cloud_message(cdr, 0)
    assert str(error.value).startswith("sensor_msgs/PointCloud2: ")
    assert "\n" not in str(error.value)


def test_clouds_of_another_encoder_are_read() -> None:
    fields = (*XYZ32, ("timestamp", 18, 8))
    rows = [[1, 2, 3, 1.7e18], [4, 5, 6, 1.7e18 + 512]]
    file = io.BytesIO()
    writer = Writer(file)
    name = "sensor_msgs/msg/PointCloud2"
    schema = writer.register_msgdef(name, TYPES.generate_msgdef(name, ros_version=2)[0])
    writer.write_message(
        "/points",
        schema,
        {
            "header": {"stamp": {"sec": 5, "nanosec": 6}, "frame_id": "livox"},
            "height": 1,
            "width": 2,
            "fields": [{"name": n, "offset": o, "datatype": d, "count": 1} for n, o, d in fields],
            "is_bigendian": False,
            "point_step": 26,
            "row_step": 52,
            "data": points_of(fields, rows, 26),
            "is_dense": True,
        },
    )
    writer.finish()
    ((_, _, message),) = make_reader(io.BytesIO(file.getvalue())).iter_messages()
    cloud = decoded(message.data)
    np.testing.assert_array_equal(cloud.points, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(cloud.time_values("timestamp"), [1.7e18, 1.7e18 + 512])
    assert cloud.stamp_ns == 5_000_000_006


def test_clouds_of_ros_1_are_read_after_rosbags_turned_them_to_cdr() -> None:
    data = points_of(XYZ32, [[1, 2, 3], [4, 5, 6]], 12)
    raw = struct.pack("<III", 77, 5, 6) + _text("/velodyne") + struct.pack("<III", 1, 2, 3)
    for name, offset, datatype in XYZ32:  # type: ignore[misc]  # three of each
        raw += _text(name) + struct.pack("<IBI", offset, datatype, 1)
    raw += struct.pack("<BIII", 0, 12, 24, len(data)) + data + b"\1"
    cloud = decoded(bytes(TYPES.ros1_to_cdr(raw, "sensor_msgs/msg/PointCloud2")))
    np.testing.assert_array_equal(cloud.points, [[1, 2, 3], [4, 5, 6]])
    assert (cloud.stamp_ns, cloud.frame_id) == (5_000_000_006, "velodyne")


def _text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()
