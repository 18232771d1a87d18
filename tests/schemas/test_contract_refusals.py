"""Messages that are refused: the code, the words, and that a size is checked before anything is made of it."""

import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest
from contract_tools import (
    DECODERS,
    MESSAGES,
    XYZ,
    cloud_message,
    field,
    grid_message,
    odometry_message,
    read_cloud,
    refused,
    transform_message,
)
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud

from roughmap_schemas import MessageFault, check_encoding, decode_grid, decode_odometry, decode_transform
from roughmap_schemas.encodings import FRAME_TRANSFORM, GRID, ODOMETRY, POINT_CLOUD, json_encoding

MIB_POINTS = 1 << 20
NAN, INF = float("nan"), float("inf")
TWICE = [*XYZ, field("y", 8, 7)]
MIXED = [field("x", 0, 7), field("y", 4, 7), field("z", 8, 8)]


@pytest.mark.parametrize(
    ("stride", "fields", "size", "words"),
    [
        (0, XYZ, 0, ["point_stride", "found 0"]),
        (0, XYZ, 24, ["point_stride", "found 0"]),
        (12, XYZ, 25, ["multiple of point_stride 12", "25 bytes"]),
        (11, XYZ, 22, ["within point_stride 11"]),
        (12, [], 24, ["found none"]),
        (12, XYZ[:2], 24, ["x, y and z", "found x, y"]),
        (12, TWICE, 24, ["y once"]),
        (16, MIXED, 32, ["all FLOAT32", "7, 7, 8"]),
        (12, [field(n, 2 * i, 4) for i, n in enumerate("xyz")], 24, ["found 4, 4, 4"]),
        (12, [field("x", 0, 7), field("y", 3, 7), field("z", 8, 7)], 24, ["overlap", "y at 3"]),
        (12, [field("x", 0, 7), field("y", 0, 7), field("z", 0, 7)], 24, ["overlap"]),
        (12, [field("x", 0, 7), field("y", 4, 7), field("z", 2**32 - 1, 7)], 24, ["z within point_stride"]),
        (16, [*XYZ, field("t", 12, 9)], 32, ["t of a numeric type", "found 9"]),
        (16, [*XYZ, field("t", 10, 5)], 32, ["overlap"]),
        (16, [*XYZ, field("t", 12, 8)], 32, ["t within"]),
        (16, [*XYZ, field("t", 12, 5), field("t", 12, 5)], 32, ["t once"]),
        (12, [field("x", 0, 99), field("y", 4, 99), field("z", 8, 99)], 24, ["99"]),
    ],
)
def test_clouds_of_a_layout_that_cannot_be(stride: int, fields: list, size: int, words: list[str]) -> None:
    payload = cloud_message(bytes(size), stride, fields).SerializeToString()
    refused("bad_message", lambda: read_cloud(payload), "foxglove.PointCloud", *words)


@pytest.mark.parametrize("quaternion", [(0, 0, 0, 0), (0, 0, 9e-7, 0), (NAN, 0, 0, 1), (INF, 0, 0, 1)])
@pytest.mark.parametrize("kind", ["cloud", "odometry", "transform"])
def test_quaternions_without_a_direction(kind: str, quaternion: tuple) -> None:
    message = {"cloud": cloud_message(bytes(12)), "odometry": odometry_message(), "transform": transform_message()}[
        kind
    ]
    rotation = message.rotation if kind == "transform" else message.pose.orientation
    rotation.x, rotation.y, rotation.z, rotation.w = quaternion
    if kind == "cloud":
        message.pose.position.x = 1.0
    refused("bad_message", lambda: DECODERS[kind](message.SerializeToString()), "norm at least 1e-6")


@pytest.mark.parametrize("value", [NAN, INF, -INF])
@pytest.mark.parametrize("kind", ["cloud", "odometry", "transform", "grid"])
def test_positions_that_are_not_finite(kind: str, value: float) -> None:
    message = {"cloud": cloud_message(bytes(12)), "odometry": odometry_message(), "grid": grid_message()}.get(kind)
    message = message or transform_message()
    if kind == "transform":
        message.translation.y = value
    else:
        message.pose.position.y, message.pose.orientation.w = value, 1.0
    refused("bad_message", lambda: DECODERS[kind](message.SerializeToString()), "finite")


@pytest.mark.parametrize(("seconds", "nanos"), [(-1, 0), (2**32, 0), (0, -1), (0, 10**9), (2**62, 0), (5, 2**31 - 1)])
@pytest.mark.parametrize("kind", ["cloud", "odometry", "transform", "grid"])
def test_stamps_outside_what_a_cell_can_keep(kind: str, seconds: int, nanos: int) -> None:
    message = {"cloud": cloud_message(bytes(12)), "odometry": odometry_message(), "grid": grid_message()}.get(kind)
    message = message or transform_message()
    message.timestamp.seconds, message.timestamp.nanos = seconds, nanos
    refused("bad_message", lambda: DECODERS[kind](message.SerializeToString()), "timestamp", str(seconds))


def test_the_last_stamp_and_the_first_are_taken() -> None:
    message = cloud_message(bytes(12))
    message.timestamp.seconds, message.timestamp.nanos = 2**32 - 1, 10**9 - 1
    assert read_cloud(message.SerializeToString()).stamp_ns == 2**32 * 10**9 - 1
    message.ClearField("timestamp")
    assert read_cloud(message.SerializeToString()).stamp_ns == 0


@pytest.mark.parametrize("kind", DECODERS)
@pytest.mark.parametrize("sent", MESSAGES)
def test_messages_of_another_type(kind: str, sent: str) -> None:
    if kind == sent:
        DECODERS[kind](MESSAGES[sent])
    else:
        refused("bad_message", lambda: DECODERS[kind](MESSAGES[sent]), "expected foxglove.")


@pytest.mark.parametrize("kind", DECODERS)
def test_messages_cut_off_anywhere(kind: str) -> None:
    """A cut mostly falls within a field. Once it may fall between two, with all that a message of the kind needs before
    it: a cloud whose data come last is then one of no points, odometry one without its covariance."""
    payload, whole = MESSAGES[kind], 0
    for length in range(len(payload)):
        try:
            DECODERS[kind](payload[:length])
            whole += 1
        except MessageFault as fault:
            assert fault.code == "bad_message"  # noqa: PT017
    assert whole <= 1


def test_an_empty_payload_is_none_of_them() -> None:
    for decode in DECODERS.values():
        refused("bad_message", lambda decode=decode: decode(b""))


@pytest.mark.parametrize(
    "payload",
    [b"\x0b\x0c", b"\x07", b"\x00\x00", b"\xff" * 11, b"\x0a\xff\xff\xff\xff\x0f", b'{"x": 1}', b"\x80"],
    ids=["group", "wire type 7", "field 0", "endless number", "length of 4 GiB", "json", "cut number"],
)
def test_what_is_no_protobuf(payload: bytes) -> None:
    for decode in DECODERS.values():
        refused("bad_message", lambda decode=decode: decode(payload))


def test_limits_of_size() -> None:
    payload = MESSAGES["cloud"]
    refused("too_large", lambda: read_cloud(payload, max_message=len(payload) - 1), str(len(payload)))
    refused("too_large", lambda: read_cloud(payload, max_points=2), "at most 2 points", "found 3")
    read_cloud(payload, max_message=len(payload), max_points=3)
    for decode, sent in ((decode_odometry, MESSAGES["odometry"]), (decode_transform, MESSAGES["transform"])):
        decode(sent, max_message=len(sent))
        refused("too_large", lambda decode=decode, sent=sent: decode(sent, max_message=len(sent) - 1))
    refused("too_large", lambda: decode_grid(MESSAGES["grid"], max_data=87), "at most 87")


def allocated(call: Callable[[], object]) -> int:
    """The most bytes that were held at once during the call."""
    tracemalloc.start()
    try:
        call()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_nothing_is_made_of_a_cloud_of_too_many_points() -> None:
    """Beside a payload of 12 MB the refusal takes a few kilobytes: no copy of the data, no array. (numpy's and Python's
    memory is traced; the C++ side never gets the data.)"""
    payload = cloud_message(bytes(12 * MIB_POINTS)).SerializeToString()
    call = lambda: refused("too_large", lambda: read_cloud(payload, max_message=len(payload), max_points=1000))  # noqa: E731
    assert allocated(call) < 200_000


def test_a_cloud_is_read_without_a_copy_of_its_data() -> None:
    payload = cloud_message(bytes(12 * MIB_POINTS)).SerializeToString()
    assert allocated(lambda: read_cloud(payload, max_message=len(payload), max_points=MIB_POINTS)) < 200_000


def test_a_message_of_very_many_entries_is_refused_before_an_object_is_made_of_each() -> None:
    """Two bytes an empty field: 64 MiB of them would be 32 million Python objects."""
    payload = MESSAGES["cloud"] + bytes([PointCloud.FIELDS_FIELD_NUMBER << 3 | 2, 0]) * 500_000
    call = lambda: refused("too_large", lambda: read_cloud(payload), "4096 entries")  # noqa: E731
    assert allocated(call) < 2_000_000


def test_fields_of_a_later_schema_are_passed_over() -> None:
    """Field 200, as text: not in any of these schemas."""
    for kind, decode in DECODERS.items():
        decode(MESSAGES[kind] + b"\xc2\x0c\x05later")


def test_data_that_stands_twice() -> None:
    """As protobuf has it, the last one holds."""
    first, last = cloud_message(bytes(24)), cloud_message(np.array([1, 2, 3], "<f4").tobytes(), fields=[])
    assert read_cloud(first.SerializeToString() + last.SerializeToString()).points.tolist() == [[1, 2, 3]]


@pytest.mark.parametrize("expected", [POINT_CLOUD, ODOMETRY, FRAME_TRANSFORM, GRID, json_encoding("Receipt")])
def test_encodings(expected: str) -> None:
    for said in (expected, "", "zenoh/bytes"):
        check_encoding(said, expected)
    if "protobuf" in expected:
        check_encoding("application/protobuf", expected)  # Zenoh's own constant
    else:
        refused("bad_encoding", lambda: check_encoding("application/protobuf", expected), expected)
    for said in ("application/json", "application/protobuf;", expected.upper(), "zenoh/string", expected + ";v=2"):
        refused("bad_encoding", lambda said=said: check_encoding(said, expected), expected)


def test_the_encodings_of_the_contract() -> None:
    assert POINT_CLOUD == "application/protobuf;foxglove.PointCloud"
    assert ODOMETRY == "application/protobuf;foxglove.Odometry"
    assert FRAME_TRANSFORM == "application/protobuf;foxglove.FrameTransform"
    assert GRID == "application/protobuf;foxglove.Grid"
    assert json_encoding("TileInfo") == "application/json;roughmap.TileInfo"
