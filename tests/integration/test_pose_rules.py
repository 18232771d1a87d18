"""What becomes of a pose and of a transform: the reasons are counted, the messages stay in the log."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from processes import GROUND, LEVEL, PRECISE, T0, Feed, Service, inputs_in, running

from roughmap_schemas import encode_odometry, encode_transform

S = 10**9

Running = tuple[Service, Feed]


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    with running(tmp_path_factory.mktemp("poses"), map={"error_model": "point"}, input={"max_wait": 0.3}) as both:
        feed = both[1]
        feed.decided(feed.cloud("first", T0, GROUND, "map"))
        yield both


def rejected(both: Running, robot: str, payload: bytes, reason: str, kind: str = "odometry") -> None:
    """The message is counted under that reason, and in the log."""
    service, feed = both
    before = feed.settle().poses
    receipt = feed.ingest(kind, robot, payload)
    after = feed.settle().poses
    assert after.accepted == before.accepted
    assert after.rejected == {**before.rejected, reason: before.rejected.get(reason, 0) + 1}  # type: ignore[call-overload]
    logged = inputs_in(service.log)[receipt.input - 1]
    assert (logged.topic, logged.data) == (f"robots/{robot}/{kind}", payload)


def height(feed: Feed, x: float, y: float) -> float:
    """What the map says there."""
    return float(feed.client.cells([(x, y)])["mean_height"][0])


def scan(feed: Feed, robot: str, stamp_ns: int) -> str:
    """Two returns from one spot, a metre ahead and a metre down: one alone is not yet ground. The outcome."""
    return str(feed.decided(feed.cloud(robot, stamp_ns, np.array([[1.0, 0.0, -1.0]] * 2))).outcome)


def test_of_two_poses_of_one_stamp_the_first_wins(both: Running) -> None:
    _, feed = both
    feed.pose("twice", T0, (10.05, 10.05, 5.0))
    rejected(both, "twice", encode_odometry(T0, "map", (10.05, 10.05, 9.0), LEVEL, PRECISE), "duplicate")
    feed.pose("twice", T0 + S // 10, (10.05, 10.05, 5.0))  # it moves on: the clock does not stand still
    assert scan(feed, "twice", T0) == "integrated"
    assert height(feed, 11.05, 10.05) == 4.0


def test_a_clock_that_stands_still_maps_nothing(both: Running) -> None:
    """The scans that come with it would all be put where the robot was at first."""
    _, feed = both
    feed.pose("still", T0, (10.05, 80.05, 5.0))
    for n in range(1, 10):
        rejected(both, "still", encode_odometry(T0, "map", (10.05 + n, 80.05, 5.0), LEVEL, PRECISE), "duplicate")
    rejected(both, "still", encode_odometry(T0, "map", (20.05, 80.05, 5.0), LEVEL, PRECISE), "frozen")
    assert scan(feed, "still", T0) == "no_pose"


@pytest.mark.parametrize(
    ("second", "reason"), [(9.0, "stale"), (15.0, "out_of_order"), (3600.0, "ahead"), (-3600.0, "stale")]
)
def test_a_stamp_that_nothing_follows_up(both: Running, second: float, reason: str) -> None:
    """It is counted once the next pose shows that it was wild, and leaves no trace in the way."""
    _, feed = both
    robot = f"wild{reason}{second < 0.0}"
    for half in range(41):
        feed.pose(robot, T0 + half * S // 2, (20.05, 0.05, 1.0))
    before = feed.settle().poses
    feed.pose(robot, T0 + round(second * S), (20.05, 0.05, 3.0))
    assert feed.settle().poses == before, "held"
    feed.pose(robot, T0 + 41 * S // 2, (20.05, 0.05, 1.0))
    after = feed.settle().poses
    assert after.accepted == before.accepted + 1
    assert after.rejected == {**before.rejected, reason: before.rejected.get(reason, 0) + 1}  # type: ignore[call-overload]
    assert scan(feed, robot, T0 + 81 * S // 4) == "integrated"
    assert height(feed, 21.05, 0.05) == 0.0


def test_a_frame_that_nobody_knows(both: Running) -> None:
    _, feed = both
    rejected(both, "framed", encode_odometry(T0, "odom", (0, 0, 0), LEVEL), "pose_frame")
    assert scan(feed, "framed", T0) == "no_pose"


def test_a_transform_covers_its_frame_from_its_stamp_on(both: Running) -> None:
    """Chosen when the pose is logged: the newest that is not after the pose's stamp; if all are, the oldest."""
    _, feed = both
    quarter = (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))
    feed.put("transform", "via", encode_transform(T0, "map", "odom", (30.05, 40.05, 2.0), quarter))
    feed.put("transform", "via", encode_transform(T0 + 5 * S, "map", "odom", (0.0, 0.0, 100.0), LEVEL))
    feed.put("odometry", "via", encode_odometry(T0 - 1, "odom", (1.0, 0.0, 0.5), LEVEL, PRECISE))
    feed.put("odometry", "via", encode_odometry(T0 + S // 2 - 1, "odom", (1.0, 0.0, 0.5), LEVEL, PRECISE))
    assert scan(feed, "via", T0 + S // 4) == "integrated"
    # The robot stands at (30.05, 41.05, 2.5) and looks along +y; the point lies a metre ahead and a metre down.
    assert height(feed, 30.05, 42.05) == pytest.approx(1.5, abs=1e-12)


def test_a_transform_of_another_parent(both: Running) -> None:
    payload = encode_transform(T0, "world", "odom", (0, 0, 0), LEVEL)
    rejected(both, "parent", payload, "pose_frame", kind="transform")


def test_a_transform_that_jumps(both: Running) -> None:
    """Counted, and what was placed before stays: poses carry the transform of their time."""
    _, feed = both
    feed.put("transform", "jumper", encode_transform(T0, "map", "odom", (50.05, 0.05, 0.0), LEVEL))
    feed.put("odometry", "jumper", encode_odometry(T0, "odom", (0.0, 0.0, 1.0), LEVEL, PRECISE))
    feed.put("transform", "jumper", encode_transform(T0 + 1, "map", "odom", (50.05, 0.05, 7.0), LEVEL))
    assert feed.settle().jumps["jumper"] == 1
    assert scan(feed, "jumper", T0) == "integrated"
    assert height(feed, 51.05, 0.05) == 0.0


@pytest.mark.parametrize(
    ("row", "column", "value"),
    [(0, 0, np.nan), (2, 3, np.inf), (1, 1, -1e-9), (0, 1, 2e-12)],
    ids=["nan", "infinite", "negative", "asymmetric"],
)
def test_a_covariance_that_is_none(both: Running, row: int, column: int, value: float) -> None:
    """The last one is off by 2e-6 of what its variances allow."""
    covariance = PRECISE.copy()
    covariance[row, column] = value
    rejected(both, f"c{row}{column}", encode_odometry(T0, "map", (0, 0, 0), LEVEL, covariance), "bad_covariance")


def test_a_covariance_of_35_numbers(both: Running) -> None:
    from foxglove_schemas_protobuf.Odometry_pb2 import Odometry

    message = Odometry.FromString(encode_odometry(T0, "map", (0, 0, 0), LEVEL, PRECISE))
    del message.pose_covariance[-1]
    rejected(both, "c35", message.SerializeToString(), "bad_covariance")


def test_quaternions_of_any_length_but_none(both: Running) -> None:
    """Twice a quaternion is the same rotation; next to nothing is none."""
    _, feed = both
    half: Any = (0.0, 0.0, np.sqrt(0.5) * 2, np.sqrt(0.5) * 2)
    feed.pose("long", T0, (60.05, 0.05, 1.0), half)
    assert scan(feed, "long", T0) == "integrated"
    assert height(feed, 60.05, 1.05) == pytest.approx(0.0, abs=1e-12)
    nothing = encode_odometry(T0, "map", (0, 0, 0), (0.0, 0.0, 0.0, 1e-7))
    assert feed.refused("odometry", "short", nothing) == "bad_message"


def test_one_pose_from_the_far_future_is_got_over(both: Running) -> None:
    """Even where it comes first: three that follow show that it was wild, and the robot maps."""
    _, feed = both
    feed.pose("future", T0 + 10**9 * S, (0.0, 0.0, 0.0))
    for tenth in range(4):
        feed.pose("future", T0 + tenth * S // 10, (70.05, 0.05, 1.0))
    assert scan(feed, "future", T0 + S // 4) == "integrated"
    assert height(feed, 71.05, 0.05) == 0.0
