"""Clouds: what is taken, and what comes out of it."""

import numpy as np
import pytest
from contract_tools import (
    XYZ,
    cloud_message,
    few,
    field,
    finite,
    frames,
    many,
    quaternions,
    read_cloud,
    stamps,
    vectors,
)
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from roughmap_schemas import encode_cloud

FLOATS = {7: "<f4", 8: "<f8"}


def clouds(dtype: str) -> st.SearchStrategy[np.ndarray]:
    width = np.dtype(dtype).itemsize * 8
    return hnp.arrays(dtype, st.tuples(st.integers(0, 20), st.just(3)), elements=st.floats(width=width))


@many
@given(st.sampled_from(["<f4", "<f8"]).flatmap(clouds), stamps, frames, st.booleans(), st.data())
def test_what_is_encoded_is_decoded(
    points: np.ndarray, stamp: int, frame: str, timed: bool, data: st.DataObject
) -> None:
    times = data.draw(hnp.arrays(np.int64, len(points), elements=st.integers(0, 10**9))) if timed else None
    cloud = read_cloud(encode_cloud(points, stamp, frame, times))
    assert (cloud.stamp_ns, cloud.frame_id, cloud.points.dtype) == (stamp, frame, points.dtype)
    assert cloud.points.tobytes() == points.tobytes()  # bits: NaN and infinity pass, the map counts them
    assert (cloud.offsets_ns is None) == (times is None)
    assert times is None or cloud.offsets_ns.tolist() == times.tolist()


@many
@given(
    st.sampled_from([7, 8]),
    st.sampled_from([None, 5, 7, 8]),
    st.permutations(["x", "y", "z", "t", "intensity"]),
    st.lists(st.integers(0, 5), min_size=6, max_size=6),
    st.integers(0, 7),
)
def test_a_foreign_layout(kind: int, time_kind: int | None, order: list[str], gaps: list[int], count: int) -> None:
    """Any order, any gaps (so any alignment), another field between, padding at the end."""
    kinds = {"x": kind, "y": kind, "z": kind, "t": time_kind, "intensity": 1}
    types = {5: "<u4", 1: "u1", **FLOATS}
    offset, spans, fields = 0, {}, []
    for name, gap in zip([n for n in order if kinds[n] is not None], gaps, strict=False):
        offset += gap
        spans[name] = (offset, types[kinds[name]])
        fields.append(field(name, offset, kinds[name]))
        offset += np.dtype(types[kinds[name]]).itemsize
    stride = offset + gaps[-1]
    shape = {"names": list(spans), "formats": [t for _, t in spans.values()], "offsets": [o for o, _ in spans.values()]}
    packed = np.zeros(count, np.dtype({**shape, "itemsize": stride}))
    raw = np.frombuffer(bytearray(b"\xee" * (count * stride)), packed.dtype) if count else packed
    raw["intensity"] = 7
    for number, name in enumerate("xyz"):
        raw[name] = np.arange(count) + 100.25 * number
    if time_kind is not None:
        raw["t"] = np.arange(count) * 1000 if time_kind == 5 else np.arange(count) * 0.125
    cloud = read_cloud(cloud_message(raw.tobytes(), stride, fields).SerializeToString())
    assert cloud.points.dtype == FLOATS[kind]
    assert cloud.points.tolist() == [[i, i + 100.25, i + 200.5] for i in range(count)]
    step = 1000 if time_kind == 5 else 125_000_000
    assert (
        cloud.offsets_ns is None if time_kind is None else cloud.offsets_ns.tolist() == [step * i for i in range(count)]
    )


def test_coordinates_from_last_to_first() -> None:
    fields = [field("z", 0, 7), field("y", 4, 7), field("x", 8, 7)]
    data = np.array([[3, 2, 1], [6, 5, 4]], "<f4").tobytes()
    assert read_cloud(cloud_message(data, 12, fields).SerializeToString()).points.tolist() == [[1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize(
    ("kind", "given_times", "expected"),
    [
        (5, [0, 10**9, 10**9 + 1, 2**32 - 1], [0, 10**9, -1, -1]),
        (8, [0.0, 1.0, -1e-12, 1.0000001, np.nan, np.inf, 0.25], [0, 10**9, -1, -1, -1, -1, 250_000_000]),
        (7, [0.5, -0.5, 2.0, np.nan, -0.0], [500_000_000, -1, -1, -1, 0]),
    ],
)
def test_times_that_are_off_are_marked_point_by_point(kind: int, given_times: list, expected: list[int]) -> None:
    """Off by itself, a point's time is the point's fault (`time`), not the message's."""
    width = 8 if kind == 8 else 4
    record = np.zeros(len(given_times), [("xyz", "<f4", 3), ("t", {5: "<u4", 7: "<f4", 8: "<f8"}[kind])])
    record["t"] = given_times
    message = cloud_message(record.tobytes(), 12 + width, [*XYZ, field("t", 12, kind)])
    assert read_cloud(message.SerializeToString()).offsets_ns.tolist() == expected


@few
@given(vectors, quaternions(), st.lists(vectors, min_size=1, max_size=5))
def test_the_pose_applies_first(translation: tuple, rotation: tuple, rows: list[tuple]) -> None:
    points = np.array(rows)
    cloud = read_cloud(encode_cloud(points, 0, "map", pose=(translation, rotation)))
    expected = Rotation.from_quat(rotation).apply(points) + translation
    # A dozen roundings on numbers of up to 2e7 m.
    np.testing.assert_allclose(cloud.points, expected, rtol=0, atol=1e-7)
    assert cloud.points.dtype == np.float64


def test_no_return_stays_one_under_a_pose_but_in_the_map_frame_it_is_a_point() -> None:
    pose = ((1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0))
    rows = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], np.float32)
    assert read_cloud(encode_cloud(rows, 0, "lidar", pose=pose)).points.tolist() == [[0, 0, 0], [2, 2, 3]]
    assert read_cloud(encode_cloud(rows, 0, "map", pose=pose)).points.tolist() == [[1, 2, 3], [2, 2, 3]]


def test_an_identity_pose_and_none_leave_the_points_alone() -> None:
    rows = np.array([[0.1, 0.2, 0.3]], np.float32)
    plain = read_cloud(encode_cloud(rows, 0, "lidar"))
    posed = read_cloud(encode_cloud(rows, 0, "lidar", pose=((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))))
    assert plain.points.tobytes() == posed.points.tobytes() == rows.tobytes()
    assert posed.points.dtype == np.float32


def test_zero_points_are_a_cloud() -> None:
    message = cloud_message(b"", 16, [*XYZ, field("t", 12, 5)])
    cloud = read_cloud(message.SerializeToString())
    assert cloud.points.shape == (0, 3)
    assert cloud.offsets_ns.shape == (0,)


def test_the_points_are_not_copied() -> None:
    cloud = read_cloud(encode_cloud(np.ones((1000, 3), np.float32), 0, "lidar", np.zeros(1000, np.int64)))
    assert not cloud.points.flags.owndata
    assert not cloud.points.flags.writeable


@few
@given(st.lists(st.tuples(finite, finite, finite), max_size=4), stamps, vectors, quaternions())
def test_a_foreign_reader_sees_what_was_encoded(rows: list, stamp: int, translation: tuple, rotation: tuple) -> None:
    points = np.array(rows, np.float64).reshape(-1, 3)
    message = PointCloud.FromString(encode_cloud(points, stamp, "lidar", np.arange(len(rows)), (translation, rotation)))
    assert message.timestamp.seconds * 10**9 + message.timestamp.nanos == stamp
    assert [(f.name, f.offset, f.type) for f in message.fields] == [
        ("x", 0, 8),
        ("y", 8, 8),
        ("z", 16, 8),
        ("t", 24, 5),
    ]
    assert message.point_stride == 28
    assert np.frombuffer(message.data, "<f8,<f8,<f8,<u4").tolist() == [(*row, i) for i, row in enumerate(rows)]
    position, turned = message.pose.position, message.pose.orientation
    assert (position.x, position.y, position.z) == translation
    assert (turned.x, turned.y, turned.z, turned.w) == rotation


@pytest.mark.parametrize(
    "arguments",
    [
        (np.zeros(3), 0, "lidar"),
        (np.zeros((2, 4)), 0, "lidar"),
        (np.zeros((2, 3)), -1, "lidar"),
        (np.zeros((2, 3)), 2**32 * 10**9, "lidar"),
        (np.zeros((2, 3)), 0, "lidar", [0]),
        (np.zeros((2, 3)), 0, "lidar", [0, -1]),
        (np.zeros((2, 3)), 0, "lidar", [0, 2**32]),
    ],
)
def test_what_cannot_be_encoded(arguments: tuple) -> None:
    with pytest.raises(ValueError, match="expected"):
        encode_cloud(*arguments)


def test_the_size_that_a_cloud_reports() -> None:
    """Its payload where the points are a view of it; where they had to be moved, three times as much."""
    points = np.zeros((1000, 3), np.float32)
    plain = encode_cloud(points, 0, "lidar")
    timed = encode_cloud(points, 0, "lidar", offsets_ns=np.zeros(1000))
    moved = encode_cloud(points, 0, "lidar", offsets_ns=np.zeros(1000), pose=((1, 2, 3), (0, 0, 0, 1)))
    held = [read_cloud(payload).held_bytes - 1024 for payload in (plain, timed, moved)]
    assert held == [len(plain), len(timed) + 8000, 24_000 + 8000]
