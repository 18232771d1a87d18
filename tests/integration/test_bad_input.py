"""Messages that no service can use: each gets its word, is counted, is not logged, and harms nothing that follows."""

from collections.abc import Callable, Iterator
from itertools import pairwise

import numpy as np
import pytest
import zenoh
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from processes import GROUND, LEVEL, PRECISE, T0, Feed, Service, inputs_in, read_log, running

from roughmap_client import QueryRefused
from roughmap_client.session import ask
from roughmap_schemas import QueryError, encode_cloud, encode_odometry, encode_transform

S = 10**9
MAX_MESSAGE = 13 << 20
GOOD = encode_cloud(GROUND, T0, "lidar")
POSE = encode_odometry(T0, "map", (0, 0, 0), LEVEL)

Running = tuple[Service, Feed]


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """After all that the tests send it, the service must map a good scan, end in order, and replay as equal."""
    settings = {
        "input": {
            "max_wait": 0.3, "max_points": 1_000_000, "max_message": MAX_MESSAGE,
            "robots": ["rover", "settle", "million", "stamps"],
        },
        "map": {"error_model": "ellipsoid"},
    }  # fmt: skip
    with running(tmp_path_factory.mktemp("bad"), **settings) as both:
        _, feed = both
        yield both
        for tenth in range(3):
            feed.pose("rover", T0 + 1000 * S + tenth * S // 10, (5.0, 5.0, 1.0))
        assert feed.decided(feed.cloud("rover", T0 + 1000 * S + S // 20)).accepted == len(GROUND)
        status = feed.settle()
        assert status.health in {"ok", "degraded"}
        others = [subject for subject in status.problems if not subject.startswith("robot")]
        assert not others, status.problems


def changed(change: Callable[[PointCloud], object]) -> bytes:
    message = PointCloud.FromString(GOOD)
    change(message)
    return bytes(message.SerializeToString())


def all_of_type(kind: int) -> Callable[[PointCloud], object]:
    def change(message: PointCloud) -> None:
        for field in message.fields:
            field.type = kind

    return change


CLOUDS = {
    "nothing": b"",
    "cut off": GOOD[:-5],
    "noise": bytes(range(256)) * 4,
    "text": b'{"points": []}',
    "another message": POSE,
    "no fields": changed(lambda m: m.ClearField("fields")),
    "x twice": changed(lambda m: m.fields.append(m.fields[0])),
    "no z": changed(lambda m: m.fields.pop()),
    "integers": changed(all_of_type(5)),
    "no stride": changed(lambda m: setattr(m, "point_stride", 0)),
    "a stride beyond the data": changed(lambda m: setattr(m, "point_stride", 1_000_003)),
    "a field beyond the stride": changed(lambda m: setattr(m.fields[2], "offset", 4_000_000_000)),
    "half a point": changed(lambda m: setattr(m, "data", m.data[:-1])),
    "a pose that turns nowhere": changed(lambda m: m.pose.orientation.SetInParent()),
    "a stamp before 1970": changed(lambda m: m.timestamp.FromNanoseconds(-1)),
    "a stamp after 2106": changed(lambda m: m.timestamp.FromSeconds(2**32)),
}
POSES = {
    "nothing": b"",
    "cut off": POSE[:-3],
    "a cloud": GOOD,
    "at infinity": encode_odometry(T0, "map", (np.inf, 0, 0), LEVEL),
    "turned by nan": encode_odometry(T0, "map", (0, 0, 0), (np.nan, 0, 0, 1)),
}
TRANSFORMS = {
    "cut off": encode_transform(T0, "map", "odom", (0, 0, 0), LEVEL)[:-2],
    "at infinity": encode_transform(T0, "map", "odom", (0, -np.inf, 0), LEVEL),
}
UNUSABLE = [
    pytest.param(kind, payload, id=f"{kind}: {name}")
    for kind, payloads in (("points", CLOUDS), ("odometry", POSES), ("transform", TRANSFORMS))
    for name, payload in payloads.items()
]


def refused_twice(both: Running, kind: str, robot: str, payload: bytes, code: str) -> None:
    """As a request it gets its code; published it is counted; neither is logged."""
    service, feed = both
    before = feed.settle()
    assert feed.refused(kind, robot, payload) == code
    feed.put(kind, robot, payload)
    after = feed.settle()
    assert after.refused == {**before.refused, code: before.refused.get(code, 0) + 2}  # type: ignore[call-overload]
    assert after.input == before.input
    assert (after.clouds, after.poses, after.sequence) == (before.clouds, before.poses, before.sequence)
    assert service.process.poll() is None


@pytest.mark.parametrize(("kind", "payload"), UNUSABLE)
def test_what_is_no_message(both: Running, kind: str, payload: bytes) -> None:
    refused_twice(both, kind, "rover", payload, "bad_message")


@pytest.mark.parametrize(("robot", "code"), [("thief", "unknown_robot"), ("rover!", "bad_key"), ("r" * 65, "bad_key")])
def test_robots_that_are_not_expected(both: Running, robot: str, code: str) -> None:
    refused_twice(both, "odometry", robot, POSE, code)


def test_a_frame_of_no_sensor(both: Running) -> None:
    refused_twice(both, "points", "rover", encode_cloud(GROUND, T0, "sonar"), "unknown_sensor")
    key, payload = "maps/site/ingest/rover/points", encode_cloud(GROUND, T0, "")
    with pytest.raises(QueryRefused, match="set frame_id"):
        ask(both[1].session, key, timeout=30.0, payload=payload, encoding="").single()


@pytest.mark.parametrize("count", [1_000_001, MAX_MESSAGE // 12 + 1], ids=["points", "bytes"])
def test_too_much(both: Running, count: int) -> None:
    refused_twice(both, "points", "rover", encode_cloud(np.zeros((count, 3), np.float32), T0, "lidar"), "too_large")


def test_another_encoding(both: Running) -> None:
    _, feed = both
    before = feed.settle()
    wrong = "application/protobuf;foxglove.LaserScan"
    assert feed.refused("points", "rover", GOOD, wrong) == "bad_encoding"
    feed.put("points", "rover", GOOD, encoding=zenoh.Encoding(wrong))
    after = feed.settle()
    assert after.refused["bad_encoding"] == before.refused.get("bad_encoding", 0) + 2  # type: ignore[call-overload, index]
    assert after.input == before.input


MISTYPED = (
    "*/points",
    "**",
    "rover/foo",
    "rover/trajectory",
    "rover/points/x",
    "a/b/odometry",
    "no!name/points",
    "points",
)
"""Behind ``maps/site/ingest/``: each is told what keys there are, once."""


def test_wildcard_keys_deletes_and_empty_requests(both: Running) -> None:
    _, feed = both
    before = feed.settle()
    feed.put("points", "*", GOOD)
    feed.session.delete("robots/rover/points")
    for key, payload, code in (
        *((f"maps/site/ingest/{key}", GOOD, "bad_key") for key in MISTYPED),
        ("maps/site/ingest/rover/points", None, "bad_message"),
    ):
        (error,) = ask(feed.session, key, timeout=30.0, payload=payload).errors
        told = QueryError.model_validate_json(error[0])
        assert told.code == code
        assert code != "bad_key" or "maps/site/ingest/{robot}/odometry" in told.message
    after = feed.settle()
    assert after.refused["bad_key"] == before.refused.get("bad_key", 0) + 1 + len(MISTYPED)  # type: ignore[call-overload, index]
    assert after.refused["bad_message"] == before.refused.get("bad_message", 0) + 2  # type: ignore[call-overload, index]
    assert after.input == before.input


def test_points_that_are_no_places_leave_the_rest_alone(both: Running) -> None:
    _, feed = both
    feed.pose("rover", T0, (0.0, 0.0, 1.0))
    points = np.vstack([GROUND, [[np.nan, 0, 0], [0, np.inf, 0], [0, 0, -np.inf], [0, 0, 0], [1e300, 0, 0]]])
    event = feed.decided(feed.cloud("rover", T0, points))
    assert (event.outcome, event.accepted) == ("integrated", len(GROUND))
    rejected = {str(reason): n for reason, n in event.rejected.items()}
    assert (rejected["not_finite"], rejected["no_return"]) == (3, 1)
    assert sum(rejected.values()) == 5, "and the one beyond all bounds too"


def test_a_covariance_with_a_negative_eigenvalue(both: Running) -> None:
    """Symmetric, no negative diagonal, and yet no covariance: seen in the pose, before any point is placed by it."""
    _, feed = both
    C = PRECISE.copy()
    C[0, 1] = C[1, 0] = 0.5
    before = feed.settle().poses
    feed.put("odometry", "rover", encode_odometry(T0 + S // 10, "map", (0, 0, 0), LEVEL, C))
    after = feed.settle().poses
    assert after.accepted == before.accepted
    assert after.rejected["bad_covariance"] == before.rejected.get("bad_covariance", 0) + 1  # type: ignore[call-overload, index]
    assert feed.decided(feed.cloud("rover", T0 + S // 10)).outcome == "no_pose"


def test_a_million_points(both: Running) -> None:
    _, feed = both
    points = np.random.default_rng(3).uniform((-20, -20, -1.5), (20, 20, -1.0), (1_000_000, 3)).astype(np.float32)
    feed.pose("million", T0, (0.0, 0.0, 1.0))
    event = feed.decided(feed.cloud("million", T0, points))
    assert event.accepted + sum(event.rejected.values()) == 1_000_000
    assert event.accepted > 900_000


@pytest.mark.parametrize(
    ("stamp_ns", "outcome"),
    [(1, "late"), (T0 - 3600 * S, "late"), (T0 + 10**9 * S, "no_pose"), (2**32 * S - 1, "no_pose")],
)
def test_clouds_of_another_time(both: Running, stamp_ns: int, outcome: str) -> None:
    _, feed = both
    for second in (0, 11):
        feed.pose("stamps", T0 + second * S)
    assert feed.decided(feed.cloud("stamps", stamp_ns)).outcome == outcome


@pytest.mark.parametrize("kind", ["points", "odometry"])
def test_a_stamp_that_was_never_set(both: Running, kind: str) -> None:
    """A driver that leaves the header empty; in a transform it means that it holds at all times."""
    payload = encode_cloud(GROUND, 0, "lidar") if kind == "points" else encode_odometry(0, "map", (0, 0, 0), LEVEL)
    refused_twice(both, kind, "stamps", payload, "unset_stamp")


def test_stamps_that_go_backwards_or_stand_still(both: Running) -> None:
    """Clouds need no order of their stamps: each is placed with the poses of its own time."""
    _, feed = both
    for tenth in range(6):
        feed.pose("rover", T0 + 700 * S + tenth * S // 10, (0.1 * tenth, 50.0, 1.0))
    stamps = [T0 + 700 * S + tenth * S // 10 for tenth in (4, 1, 1, 3)]
    points = [GROUND, GROUND, GROUND + 0.01, GROUND]
    numbers = [feed.cloud("rover", stamp, cloud) for stamp, cloud in zip(stamps, points, strict=True)]
    assert [feed.decided(number).accepted for number in numbers] == [len(GROUND)] * 4


def test_only_what_was_taken_is_in_the_log(both: Running) -> None:
    service, feed = both
    status = feed.settle()
    logged = inputs_in(service.log)
    assert len(logged) == status.input
    bad = {
        (kind, payload)
        for kind, payloads in (("points", CLOUDS), ("odometry", POSES), ("transform", TRANSFORMS))
        for payload in payloads.values()
    }
    assert not bad & {(message.topic.split("/")[2], message.data) for message in logged}
    assert {message.topic.split("/")[1] for message in logged} <= {"rover", "settle", "million", "stamps"}
    stamps = [message.log_time for message in read_log(service.log)]
    assert all(a < b for a, b in pairwise(stamps)), "log time rises by at least 1 ns"
