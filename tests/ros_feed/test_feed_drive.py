"""Whole drives, where truth is known at every stamp."""

import math
from typing import NamedTuple

import numpy as np
import pytest
from feed_tools import (
    T0,
    Floats,
    Got,
    S,
    cloud,
    feed,
    from_matrix,
    matrix,
    odometry,
    pose_with_covariance,
    read,
    rigid,
    tf,
    transform,
)

from roughmap_ros.feed import RobotFeed
from roughmap_schemas import Transform
from roughmap_schemas.kinds import RobotMessage

MS = S // 1000
COVARIANCE = np.diag([0.01, 0.02, 0.03, 0.001, 0.002, 0.003])
LIDAR = transform("base_link", "lidar", 0, [0.2, 0.0, 1.1, 0.0, 0.1, 0.0])


class Message(NamedTuple):
    """A ROS message: when it came, on which topic."""

    log_ns: int
    topic: str
    cdr: bytes


def correction(t: float) -> Floats:
    """Map -> odom at t s: it drifts and turns evenly, so that interpolation is exact."""
    return matrix(rigid([400_000 + 0.05 * t, 5_600_000 - 0.02 * t, 0.1, 0, 0, 0.001 * t]))


def wheels(t: float) -> Floats:
    """Odom -> footprint: a slalom."""
    return matrix(rigid([1.2 * t, 2 * math.sin(0.3 * t), 0.05 * math.sin(t), 0, 0, 0.6 * math.cos(0.3 * t)]))


def tilt(t: float) -> Floats:
    """Footprint -> base: it rolls evenly."""
    return matrix(rigid([0, 0, 0.3, 0.01 * t, 0, 0]))


def link(parent: str, child: str, t_ns: int, m: Floats) -> Transform:
    """Return a transform from its matrix."""
    pose = from_matrix(m)
    return Transform(t_ns, parent, child, pose.translation, pose.rotation)


def drive(seconds: float, *, late_ms: int, ahead_ms: int = 0) -> list[Message]:
    """Record a drive: odometry at 50 Hz, tilt at 25 Hz, localisation at 10 Hz and late, clouds at 10 Hz."""
    messages = [Message(T0, "/tf_static", tf(LIDAR))]
    for ms in range(0, int(seconds * 1000), 10):
        t, at = ms / 1000, T0 + ms * MS
        if ms % 20 == 0:
            messages.append(Message(at + 1, "/tf", tf(link("odom", "base_footprint", at, wheels(t)))))
            messages.append(
                Message(at, "/odom", odometry(at, "odom", "base_link", from_matrix(wheels(t) @ tilt(t)), COVARIANCE))
            )
        if ms % 40 == 0:
            messages.append(Message(at + 2, "/tf", tf(link("base_footprint", "base_link", at, tilt(t)))))
        if ms % 100 == 0:
            stamp, t = at + ahead_ms * MS, t + ahead_ms / 1000
            messages.append(Message(at + late_ms * MS, "/tf", tf(link("map", "odom", stamp, correction(t)))))
            messages.append(Message(at + 50 * MS, "/points", cloud(at, "lidar")))
    return sorted(messages, key=lambda m: m.log_ns)


def play(one: RobotFeed, messages: list[Message]) -> list[RobotMessage]:
    """Give a feed all messages."""
    got = []
    for message in messages:
        got += one.take(message.topic, message.cdr, message.log_ns)
    return got + one.end()


@pytest.mark.parametrize(("late_ms", "ahead_ms"), [(3, 0), (80, 0), (3, 1000)])
def test_poses_composed_from_tf_are_the_truth(late_ms: int, ahead_ms: int) -> None:
    one = feed(["lidar"], poses="tf", odometry="/odom")
    got = read(play(one, drive(20, late_ms=late_ms, ahead_ms=ahead_ms)))
    stamps = [pose.stamp_ns for pose in got.poses]
    assert stamps == list(range(T0 + ahead_ms * MS, T0 + 20_000 * MS, 20 * MS))
    for pose in got.poses[:-10]:  # at the end, the last ones held
        t = (pose.stamp_ns - T0) / S
        truth = correction(t) @ wheels(t) @ tilt(t)
        np.testing.assert_allclose(pose.position, truth[:3, 3], rtol=0, atol=2e-9)
        np.testing.assert_allclose(matrix(rigid_of(pose.rotation))[:3, :3], truth[:3, :3], rtol=0, atol=1e-9)
        turn = np.kron(np.eye(2), correction(t)[:3, :3])
        assert pose.covariance is not None
        np.testing.assert_allclose(pose.covariance, turn @ COVARIANCE @ turn.T, atol=1e-12)
    assert [frame for frame, _ in got.clouds] == ["lidar"] * 200
    assert got.order.index("t") < got.order.index("p")
    assert len(got.transforms) == 1


def rigid_of(rotation: tuple[float, float, float, float]) -> Transform:
    """Return a transform that turns only."""
    return Transform(0, "a", "b", (0.0, 0.0, 0.0), rotation)


def test_odometry_and_its_transforms_give_the_truth_where_the_transforms_are() -> None:
    one = feed(["lidar"], odometry="/odom")
    got = read(play(one, drive(10, late_ms=0)))
    places = {one.stamp_ns: matrix(one) for one in got.transforms if one.child_frame_id == "odom"}
    assert len(places) == 100
    for pose in got.poses:
        if pose.stamp_ns in places:
            t = (pose.stamp_ns - T0) / S
            found = places[pose.stamp_ns] @ matrix(Transform(0, "a", "b", pose.position, pose.rotation))
            np.testing.assert_allclose(found, correction(t) @ wheels(t) @ tilt(t), rtol=0, atol=2e-9)


def test_amcls_pose_gives_the_covariance_of_poses_from_tf() -> None:
    one = feed(poses="tf", pose="/amcl_pose")
    one.take("/amcl_pose", pose_with_covariance(T0, "map", rigid([0] * 6), COVARIANCE), T0)
    [pose] = read(one.take("/tf", tf(transform("map", "base_link", T0 + S // 2)), T0 + 1)).poses
    assert pose.covariance is not None
    assert (pose.covariance == COVARIANCE).all()
    [pose] = read(one.take("/tf", tf(transform("map", "base_link", T0 + 2 * S)), T0 + 2)).poses
    assert pose.covariance is None


def test_the_same_messages_give_the_same_bytes() -> None:
    messages = drive(5, late_ms=150)
    assert play(feed(["lidar"], poses="tf", odometry="/odom"), messages) == play(
        feed(["lidar"], poses="tf", odometry="/odom"), messages
    )


def test_a_drive_that_is_played_twice_gives_its_poses_twice() -> None:
    messages = drive(20, late_ms=3)
    one = feed(["lidar"], poses="tf", odometry="/odom")

    def stamps(got: Got) -> list[int]:
        return [pose.stamp_ns for pose in got.poses]

    first, second = stamps(read(play(one, messages))), stamps(read(play(one, messages)))
    assert set(first) - set(second) <= set(first[:6])
    assert second == sorted(second)


def test_log_times_never_go_back() -> None:
    got = play(feed(["lidar"], poses="tf", odometry="/odom"), drive(5, late_ms=150))
    assert [m.log_ns for m in got] == sorted(m.log_ns for m in got)
