"""The times of points, as drivers write them, are found in clouds that came from ROS."""

import struct

import numpy as np
import pytest
from ros_cdr_bytes import Field, livox, point_cloud

from roughmap_ros.messages import cloud_message, livox_message
from roughmap_schemas.cloud import Cloud, decode_cloud
from roughmap_schemas.point_times import TimeForm, timed
from roughmap_service.run.point_times import find_form

START = 1_700_000_000_000_000_000
OFFSETS_NS = np.linspace(0, 99_000_000, 200).astype(np.int64)


def decoded(payload: bytes) -> Cloud:
    return decode_cloud(payload, max_message=10**6, max_points=10**4)


def of_points(name: str, offset: int, datatype: int, step: int, values: list[float], stamp_ns: int) -> Cloud:
    fields: tuple[Field, ...] = (("x", 0, 7), ("y", 4, 7), ("z", 8, 7), (name, offset, datatype))
    data = bytearray(step * len(values))
    for number, value in enumerate(values):
        struct.pack_into("<" + {6: "I", 7: "f", 8: "d"}[datatype], data, number * step + offset, value)
    cdr = point_cloud(bytes(data), fields, step, len(values), stamp_ns=stamp_ns)
    return decoded(cloud_message(cdr, 0).payload)


def velodyne(start_ns: int) -> Cloud:
    """Seconds before the stamp, which is the last packet's."""
    return of_points("time", 18, 7, 22, [float(t - OFFSETS_NS[-1]) / 1e9 for t in OFFSETS_NS], start_ns + 99_000_000)


def ouster(start_ns: int) -> Cloud:
    """Nanoseconds after the stamp."""
    return of_points("t", 20, 6, 48, OFFSETS_NS.tolist(), start_ns)


def livox_points(start_ns: int) -> Cloud:
    """Nanoseconds since 1970."""
    return of_points("timestamp", 18, 8, 26, [float(start_ns + t) for t in OFFSETS_NS.tolist()], start_ns)


def hesai(start_ns: int) -> Cloud:
    """Seconds since 1970."""
    return of_points("timestamp", 18, 8, 26, [(start_ns + t) / 1e9 for t in OFFSETS_NS.tolist()], start_ns)


def livox_custom(start_ns: int) -> Cloud:
    points = [(t, 1.0, 2.0, 3.0, 0, 0, 0) for t in OFFSETS_NS.tolist()]
    return decoded(livox_message(livox(points, start_ns, start_ns + 100_000_000), 0).payload)


@pytest.mark.parametrize("driver", [velodyne, ouster, livox_points, hesai, livox_custom])
def test_five_clouds_of_a_driver_tell_its_times(driver: object) -> None:
    assert callable(driver)
    clouds = [driver(START + n * 100_000_000) for n in range(5)]
    form = find_form([(cloud.stamp_ns, cloud.time_fields) for cloud in clouds])
    assert isinstance(form, TimeForm)
    first = timed(clouds[0], form)
    assert abs(first.stamp_ns - START) < 1000
    assert first.offsets_ns is not None
    np.testing.assert_allclose(first.offsets_ns, OFFSETS_NS, atol=1000)
