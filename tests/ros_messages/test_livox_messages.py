"""Livox's CustomMsg becomes a cloud whose points have times after its stamp."""

import struct

import numpy as np
import pytest
from ros_cdr_bytes import livox

from roughmap_ros.messages import TYPES, livox_message
from roughmap_schemas.cloud import Cloud, decode_cloud
from roughmap_schemas.kinds import Kind
from roughmap_schemas.point_times import TimeForm, timed

STAMP = 1_700_000_000_000_000_000
POINTS = [(0, 1.5, 2.5, -3.5, 9, 16, 0), (50_000_000, 4, 5, 6, 255, 0, 1), (99_999_999, 0, 0, 0, 0, 32, 3)]


def decoded(cdr: bytes) -> Cloud:
    return decode_cloud(livox_message(cdr, 7).payload, max_message=10**6, max_points=10**5)


@pytest.mark.parametrize("order", ["<", ">"])
def test_points_and_fields_are_read(order: str) -> None:
    cloud = decoded(livox(POINTS, STAMP, STAMP, order))
    np.testing.assert_array_equal(cloud.points, [point[1:4] for point in POINTS])
    for column, name in ((0, "t"), (4, "reflectivity"), (5, "tag"), (6, "line")):
        np.testing.assert_array_equal(cloud.time_values(name), [point[column] for point in POINTS])
    assert (cloud.stamp_ns, cloud.frame_id) == (STAMP, "livox_frame")


def test_kind_and_arrival_of_a_custom_msg_are_told() -> None:
    message = livox_message(livox(POINTS, STAMP, STAMP), 7)
    assert (message.kind, message.log_ns) == (Kind.POINTS, 7)


def test_times_are_the_contracts() -> None:
    cloud = timed(decoded(livox(POINTS, STAMP, STAMP)), TimeForm("t", "ns", "start"))
    assert cloud.stamp_ns == STAMP
    np.testing.assert_array_equal(cloud.offsets_ns, [0, 50_000_000, 99_999_999])


@pytest.mark.parametrize(
    ("timebase", "stamp", "expected"),
    [
        (STAMP, STAMP + 100_000_000, STAMP),  # the header's stamp is when the scan ended or was sent
        (STAMP, STAMP - 213, STAMP),  # the header's stamp went through a float
        (123_456_789, STAMP, STAMP),  # the scanner counts from power-on
        (0, STAMP, STAMP),  # simulators leave it
        (STAMP + 37_000_000_000, STAMP, STAMP),  # the scanner's clock has TAI
        (2**64 - 1, STAMP, STAMP),
    ],
)
def test_the_stamp_is_the_timebase_if_that_is_of_the_same_clock(timebase: int, stamp: int, expected: int) -> None:
    assert decoded(livox(POINTS, timebase, stamp)).stamp_ns == expected


@pytest.mark.parametrize("order", ["<", ">"])
def test_a_custom_msg_without_points_is_empty(order: str) -> None:
    assert decoded(livox([], STAMP, STAMP, order)).points.shape == (0, 3)


@pytest.mark.parametrize("driver", ["livox_ros_driver", "livox_ros_driver2"])
def test_those_of_ros_1_are_read_after_rosbags_turned_them_to_cdr(driver: str) -> None:
    raw = struct.pack("<IIII", 1, STAMP // 10**9, 0, 11) + b"livox_frame" + struct.pack("<QIBBBB", STAMP, 3, 1, 0, 0, 0)
    raw += struct.pack("<I", 3) + b"".join(struct.pack("<IfffBBB", *point) for point in POINTS)
    cloud = decoded(bytes(TYPES.ros1_to_cdr(raw, f"{driver}/msg/CustomMsg")))
    np.testing.assert_array_equal(cloud.points, [point[1:4] for point in POINTS])
    np.testing.assert_array_equal(cloud.time_values("t"), [point[0] for point in POINTS])
