"""Livox's CustomMsg, of livox_ros_driver2 and livox_ros_driver, to ``foxglove.PointCloud``.

In CDR a point takes 20 bytes, of which the last is padding, which the last point has not. That is a cloud's layout
already: the points are copied once, as a whole.
"""

from typing import Final

import numpy as np

from roughmap_ros.messages.cdr import CdrReader, Header
from roughmap_ros.messages.clouds import NUMBERS, PlacedField, cloud_payload, converted_payload, record
from roughmap_schemas.geometry import SECOND_NS
from roughmap_schemas.kinds import Kind, RobotMessage

WHAT: Final = "livox_ros_driver2/CustomMsg"
POINT: Final = 20
POINT_DATA: Final = 19
FIELDS: Final = tuple(
    PlacedField(name, offset, NUMBERS[datatype])
    for name, offset, datatype in (
        ("t", 0, 6),
        ("x", 4, 7),
        ("y", 8, 7),
        ("z", 12, 7),
        ("reflectivity", 16, 2),
        ("tag", 17, 2),
        ("line", 18, 2),
    )
)
SAME_CLOCK_NS: Final = SECOND_NS
"""A stamp and a timebase nearer than this are of the same clock: no scan takes longer."""


def livox_message(cdr: bytes, log_ns: int) -> RobotMessage:
    """Turn a CustomMsg into a message of the contract; raises ``BadRosMessage``.

    ``offset_time`` becomes the contract's field `t`: UINT32, ns after the stamp. The stamp is ``timebase``, from which
    the offsets count. If that is not of the header's clock, such as a scanner's own that counts from power-on, it is
    the header's.
    """
    reader = CdrReader(cdr, WHAT)
    header = reader.header()
    timebase = reader.uint64()
    reader.skip(4 + 1 + 3, 4)  # point_num, which repeats the number of points; lidar_id, rsvd
    number = reader.uint32()
    size = max(number * POINT - (POINT - POINT_DATA), 0)
    at = reader.skip(size, 4 if number else 1)
    reader.end()

    if abs(timebase - header.stamp_ns) < SAME_CLOCK_NS:
        header = Header(timebase, header.frame_id)
    data = memoryview(cdr)[at : at + size]
    padding = bytes(POINT - POINT_DATA) if number else b""
    if reader.order == "<":
        payload = cloud_payload(header, FIELDS, POINT, data, padding)
    else:
        points = np.frombuffer(b"".join([data, padding]), record(FIELDS, reader.order, POINT))
        payload = converted_payload(header, FIELDS, points)
    return RobotMessage(Kind.POINTS, payload, log_ns)
