"""Whatever bytes come, a decoder returns or raises BadRosMessage, and takes little memory for it."""

import tracemalloc
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ros_cdr_bytes import Cdr, livox, odometry, point_cloud, pose, tf_message

from roughmap_ros.messages import (
    BadRosMessage,
    cloud_message,
    grid_map_arrays,
    grid_map_cdr,
    livox_message,
    read_odometry,
    read_pose,
    read_pose_stamped,
    transforms_of,
)

Decoder = Callable[[bytes], Any]

POSE = [1.0, 2, 3, 0, 0, 0, 1]
FIELDS = (("x", 0, 7), ("y", 4, 7), ("z", 8, 8), ("t", 16, 6))
GOOD: dict[str, tuple[Decoder, bytes]] = {
    "cloud": (lambda cdr: cloud_message(cdr, 0), point_cloud(bytes(60), FIELDS, 20, 3)),
    "big_endian_cloud": (
        lambda cdr: cloud_message(cdr, 0),
        point_cloud(bytes(96), FIELDS, 20, 2, 2, row_step=48, big_endian=True, order=">"),
    ),
    "livox": (lambda cdr: livox_message(cdr, 0), livox([(1, 2, 3, 4, 5, 6, 7)] * 3, 5, 6)),
    "big_endian_livox": (lambda cdr: livox_message(cdr, 0), livox([(1, 2, 3, 4, 5, 6, 7)] * 3, 5, 6, ">")),
    "odometry": (read_odometry, odometry([*POSE, *range(36)])),
    "pose": (read_pose, pose(Cdr().header(5, "map"), [*POSE, *range(36)]).bytes()),
    "pose_stamped": (read_pose_stamped, pose(Cdr().header(5, "map"), POSE).bytes()),
    "tf": (transforms_of, tf_message([(5, "a", "b", POSE), (6, "b", "c", POSE)])),
    "grid_map": (
        grid_map_arrays,
        grid_map_cdr({"a": np.zeros((2, 3)), "b": np.ones((2, 3))}, (0, 0), 1.0, 5, "m", ["a"]),
    ),
}
MESSAGES = pytest.mark.parametrize(("decode", "cdr"), GOOD.values(), ids=GOOD)


def tried(decode: Decoder, cdr: bytes) -> None:
    said = ""
    try:
        decode(cdr)
    except BadRosMessage as error:
        said = str(error)
    assert "\n" not in said
    assert len(said) < 1000


@MESSAGES
def test_a_good_message_is_read(decode: Decoder, cdr: bytes) -> None:
    assert decode(cdr)


@MESSAGES
def test_a_message_that_is_cut_short_is_refused(decode: Decoder, cdr: bytes) -> None:
    for size in range(len(cdr)):
        with pytest.raises(BadRosMessage):
            decode(cdr[:size])


@MESSAGES
def test_only_the_padding_of_dds_may_follow(decode: Decoder, cdr: bytes) -> None:
    assert decode(cdr + b"\0\0\0")
    with pytest.raises(BadRosMessage, match="found 4 more bytes"):
        decode(cdr + b"\0\0\0\0")


@MESSAGES
@pytest.mark.parametrize("value", [2**32 - 1, 2**31, 2**31 - 1, 2**24, 257, 0])
def test_a_number_that_lies_brings_no_other_error_and_little_memory(decode: Decoder, cdr: bytes, value: int) -> None:
    order = "little" if cdr[1] else "big"
    tracemalloc.start()
    for at in range(4, len(cdr) - 3):
        tried(decode, cdr[:at] + value.to_bytes(4, order) + cdr[at + 4 :])  # type: ignore[arg-type]
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2_000_000


@MESSAGES
@given(data=st.data())
def test_changed_bytes_bring_no_other_error(decode: Decoder, cdr: bytes, data: st.DataObject) -> None:
    changed = bytearray(cdr)
    for at in data.draw(st.lists(st.integers(0, len(cdr) - 1), max_size=8)):
        changed[at] = data.draw(st.integers(0, 255))
    tried(decode, bytes(changed))


@MESSAGES
@given(body=st.binary(max_size=400), start=st.sampled_from([b"", b"\0\1\0\0", b"\0\0\0\0", b"\0\7\0\0"]))
def test_any_bytes_bring_no_other_error(decode: Decoder, cdr: bytes, body: bytes, start: bytes) -> None:
    tried(decode, start + body)


@MESSAGES
def test_another_representation_than_cdr_is_named(decode: Decoder, cdr: bytes) -> None:
    with pytest.raises(BadRosMessage, match="expected CDR, which begins with 00 01 or 00 00; found 00 07"):
        decode(b"\0\7" + cdr[2:])


def test_many_small_objects_are_refused_before_they_are_made() -> None:
    tracemalloc.start()
    field = Cdr().text("").put("IBI", 0, 7, 1).body
    clouds = Cdr().header(5, "lidar").put("III", 1, 1, 2**20)
    clouds.body += bytes(field) * 2**16
    before = tracemalloc.get_traced_memory()[0]
    tracemalloc.reset_peak()
    with pytest.raises(BadRosMessage, match="expected at most 64 fields"):
        cloud_message(clouds.bytes(), 0)
    peak = tracemalloc.get_traced_memory()[1] - before
    tracemalloc.stop()
    assert peak < 2 * len(clouds.body) + 100_000  # the bytes of the test itself


def test_a_name_has_a_limit() -> None:
    with pytest.raises(BadRosMessage, match="expected a name of at most 256 bytes"):
        read_pose_stamped(pose(Cdr().header(5, "a" * 300), POSE).bytes())


def test_a_name_must_be_text() -> None:
    cdr = pose(Cdr().header(5, "abc"), POSE).bytes()
    with pytest.raises(BadRosMessage, match="expected UTF-8"):
        read_pose_stamped(cdr.replace(b"abc", b"a\xff\xfe"))
    with pytest.raises(BadRosMessage, match="ends with 0"):
        read_pose_stamped(cdr.replace(b"abc\0", b"abcd"))
