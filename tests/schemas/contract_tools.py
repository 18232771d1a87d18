"""Strategies and messages for the tests of the contract; messages are built by the plain protobuf classes, as a client
in another language would build them."""

import struct
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from hypothesis import strategies as st
from properties import examples

from roughmap_schemas import MessageFault, contract_timed, decode_cloud, decode_grid, decode_odometry, decode_transform

MIB = 1 << 20
STAMP = 1_600_000_000_123_456_789

few = examples(60)
many = examples(250)

stamps = st.integers(0, 2**32 * 10**9 - 1)
finite = st.floats(allow_nan=False, allow_infinity=False)
metres = st.floats(-1e7, 1e7)
vectors = st.tuples(metres, metres, metres)
frames = st.text(st.characters(codec="utf-8"), max_size=20)
names = st.from_regex(r"[A-Za-z0-9_.-]{1,64}", fullmatch=True)
int32s = st.integers(-(2**31), 2**31 - 1)


@st.composite
def quaternions(draw: st.DrawFn) -> tuple[float, float, float, float]:
    """Of any length that is taken, and not only of length one."""
    parts = draw(st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: sum(p * p for p in q) > 1e-6))
    scale = draw(st.sampled_from([1.0, 0.01, 50.0]))
    x, y, z, w = (part * scale for part in parts)
    return x, y, z, w


def stamped(message: Any, stamp_ns: int = STAMP) -> Any:
    """Set the timestamp."""
    message.timestamp.seconds, message.timestamp.nanos = divmod(stamp_ns, 10**9)
    return message


def field(name: str, offset: int, kind: int) -> PackedElementField:
    return PackedElementField(name=name, offset=offset, type=kind)


XYZ = [field("x", 0, 7), field("y", 4, 7), field("z", 8, 7)]


def cloud_message(
    data: bytes, stride: int = 12, fields: Iterable[PackedElementField] = XYZ, frame_id: str = "lidar"
) -> PointCloud:
    """A cloud as a foreign client would write it."""
    message = stamped(PointCloud(frame_id=frame_id, point_stride=stride, data=data))
    message.fields.extend(fields)
    return message


def odometry_message(covariance: Iterable[float] = ()) -> Odometry:
    message = stamped(Odometry(frame_id="map", body_frame_id="base"))
    message.pose.position.x, message.pose.position.y, message.pose.position.z = 1.0, 2.0, 3.0
    message.pose.orientation.w = 1.0
    message.pose_covariance.extend(covariance)
    return message


def transform_message() -> FrameTransform:
    message = stamped(FrameTransform(parent_frame_id="map", child_frame_id="odom"))
    message.translation.x = 4.0
    message.rotation.z = 1.0
    return message


def grid_message(rows: int = 2, columns: int = 3) -> Grid:
    """A grid of two float32 layers with four bytes between cells and eight between rows."""
    message = stamped(Grid(frame_id="map", column_count=columns, cell_stride=12, row_stride=12 * columns + 8))
    message.cell_size.x = message.cell_size.y = 0.5
    message.pose.position.x, message.pose.position.y = -32.0, 64.0
    message.pose.orientation.w = 1.0
    message.fields.extend([field("mean_height", 4, 7), field("range", 0, 7)])
    cells = ((float(c), 10.0 * r) for r in range(rows) for c in range(columns))
    packed = [struct.pack("<ffI", spread, height, 0xFFFFFFFF) for spread, height in cells]
    lines = (b"".join(packed[row * columns : (row + 1) * columns]) + b"\xff" * 8 for row in range(rows))
    message.data = b"".join(lines)
    return message


def read_cloud(payload: bytes, *, max_message: int = MIB, max_points: int = 10_000, map_frame: str = "map") -> Any:
    """Decode a cloud, its times in the contract's form."""
    return contract_timed(decode_cloud(payload, max_message=max_message, max_points=max_points, map_frame=map_frame))


DECODERS: dict[str, Callable[[bytes], Any]] = {
    "cloud": read_cloud,
    "odometry": lambda payload: decode_odometry(payload, max_message=MIB),
    "transform": lambda payload: decode_transform(payload, max_message=MIB),
    "grid": lambda payload: decode_grid(payload, max_data=MIB),
}

MESSAGES: dict[str, bytes] = {
    "cloud": cloud_message(np.arange(9, dtype="<f4").tobytes()).SerializeToString(),
    "odometry": odometry_message(np.eye(6).reshape(36).tolist()).SerializeToString(),
    "transform": transform_message().SerializeToString(),
    "grid": grid_message().SerializeToString(),
}
"""A good message of each kind."""


def refused(code: str, decode: Callable[[], object], *words: str) -> None:
    """The call raises a ``MessageFault`` of that code; its message holds the words."""
    with pytest.raises(MessageFault) as caught:
        decode()
    assert caught.value.code == code, caught.value
    assert "\n" not in caught.value.message
    for word in words:
        assert word in caught.value.message, caught.value
