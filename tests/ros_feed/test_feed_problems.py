"""What is told of a robot whose topics or transforms are incomplete."""

import pytest
from feed_tools import T0, S, cloud, feed, odometry, read, rigid, tf, transform

from roughmap_ros.feed import MAX_PROBLEMS, RobotFeed
from roughmap_ros.messages import BadRosMessage

MS = S // 1000
QUIET = {"poses": "tf", "clouds": []}


def run(one: RobotFeed, links: dict[tuple[str, str], int], seconds: float, start_ms: int = 0) -> None:
    """Send each link at its rate on /tf."""
    for ms in range(start_ms, start_ms + int(seconds * 1000)):
        due = [transform(a, b, T0 + ms * MS) for (a, b), hz in links.items() if ms % (1000 // hz) == 0]
        if due:
            one.take("/tf", tf(*due), T0 + ms * MS)


def static(one: RobotFeed, *links: tuple[str, str]) -> None:
    """Send static links."""
    one.take("/tf_static", tf(*(transform(a, b, 0) for a, b in links)), T0)


def test_a_link_that_never_came_is_named_with_what_is_there() -> None:
    one = feed(**QUIET)
    static(one, ("base_link", "lidar"))
    run(one, {("odom", "base_link"): 50}, 1)
    assert one.problems(T0 + S) == [
        "map -> odom never came; /tf has odom -> base_link at 50 Hz; /tf_static has base_link -> lidar"
    ]


def test_a_link_that_stopped_is_named_with_since_when() -> None:
    one = feed(**QUIET)
    static(one)
    run(one, {("map", "odom"): 20, ("odom", "base_link"): 50}, 2)
    assert one.problems(T0 + 2 * S) == []
    run(one, {("odom", "base_link"): 50}, 4.15, start_ms=2000)
    assert one.problems(T0 + 6150 * MS) == ["map -> odom stopped 4.2 s ago"]


def test_a_slow_link_has_not_stopped_between_its_messages() -> None:
    one = feed(**QUIET)
    static(one)
    run(one, {("map", "odom"): 1, ("odom", "base_link"): 50}, 3)
    run(one, {("odom", "base_link"): 50}, 2, start_ms=3000)
    assert one.problems(T0 + 5 * S) == []


def test_a_sensor_that_is_not_connected_is_named_with_the_frames_that_are() -> None:
    one = feed(["velodyne"], **QUIET)
    static(one, ("base_link", "imu"), ("base_link", "velodyne_link"))
    run(one, {("map", "base_link"): 50}, 1)
    [line] = one.problems(T0 + S)
    assert line == (
        "velodyne is not connected to base_link: /tf has map -> base_link at 50 Hz; "
        "/tf_static has base_link -> imu, base_link -> velodyne_link; or is velodyne_link meant by velodyne"
    )


def test_two_trees_are_named() -> None:
    one = feed(**QUIET)
    static(one)
    run(one, {("map", "odom"): 20, ("base_footprint", "base_link"): 10}, 1)
    [line] = one.problems(T0 + S)
    assert line.startswith("base_footprint is not connected to map: /tf has map -> odom at 20 Hz, base_footprint -> ")


def test_two_parents_are_named() -> None:
    one = feed(**QUIET)
    static(one)
    run(one, {("odom", "base_link"): 50, ("map", "base_link"): 20}, 1)
    assert one.problems(T0 + S) == ["two parents of base_link: odom, map"]


def test_a_loop_is_named() -> None:
    one = feed(**QUIET)
    static(one, ("map", "base_link"), ("a", "b"), ("b", "c"), ("c", "a"))
    one.take("/tf", tf(), T0)
    assert one.problems(T0) == ["a loop of transforms: a -> b -> c -> a"]


def test_a_link_on_both_topics_is_named() -> None:
    one = feed(**QUIET)
    static(one, ("map", "base_link"))
    run(one, {("map", "base_link"): 50}, 1)
    assert one.problems(T0 + S) == ["map -> base_link comes on /tf and on /tf_static: the last one counts"]


def test_computers_whose_clocks_differ_are_named() -> None:
    one = feed(**QUIET)
    static(one)
    for i in range(50):
        at = T0 + i * 20 * MS
        one.take("/tf", tf(transform("map", "odom", at + 60 * S), transform("odom", "base_link", at)), at)
    assert one.problems(T0 + S) == ["map -> odom is stamped 60 s after odom -> base_link: set the computers' clocks"]


def test_topics_that_never_came_or_stopped_are_named() -> None:
    one = feed(odometry="/odom")
    assert one.problems(T0) == ["nothing came on /points, /odom, /tf, /tf_static"]
    one.take("/odom", odometry(T0, "map", "base_link", rigid([0] * 6)), T0)
    assert one.problems(T0) == ["/points never came"]
    for i in range(20):
        one.take("/odom", odometry(T0 + i * MS, "map", "base_link", rigid([0] * 6)), T0 + i * 100 * MS)
        one.take("/points", cloud(T0, "lidar"), T0 + i * S)
    assert one.problems(T0 + 21 * S) == ["/odom stopped 19.1 s ago"]


def test_a_robot_whose_poses_need_no_transforms_needs_no_tf_topic() -> None:
    one = feed(odometry="/odom")
    one.take("/odom", odometry(T0, "map", "base_link", rigid([0] * 6)), T0)
    one.take("/points", cloud(T0, "lidar"), T0)
    assert one.problems(T0) == []
    one.take("/tf", tf(transform("odom", "base_link", T0)), T0)  # one that stops, of links that nothing needs
    one.take("/odom", odometry(T0 + 9 * S, "map", "base_link", rigid([0] * 6)), T0 + 9 * S)
    one.take("/points", cloud(T0 + 9 * S, "lidar"), T0 + 9 * S)
    assert one.problems(T0 + 9 * S) == []


def test_no_transforms_at_all_is_said() -> None:
    one = feed(["lidar"], poses="tf")
    one.take("/points", cloud(T0, "lidar"), T0)
    assert one.problems(T0) == [
        "map -> base_link never came; /tf and /tf_static have no transforms",
        "base_link -> lidar never came; /tf and /tf_static have no transforms",
    ]


def test_problems_are_bounded() -> None:
    one = feed([f"lidar{i}" for i in range(50)], **QUIET)
    static(one, ("a", "b"))
    lines = one.problems(T0)
    assert len(lines) == MAX_PROBLEMS
    assert lines[-1] == "and 32 more"


def test_a_bad_message_is_refused_and_a_topic_that_is_not_wanted_gives_nothing() -> None:
    one = feed(odometry="/odom")
    for topic in one.wanted():
        with pytest.raises(BadRosMessage):
            one.take(topic, b"\x00\x01\x00\x00", T0)
    assert one.take("/other", b"", T0) == []
    assert read(one.end()).order == ""


def test_what_is_wanted_is_what_is_used() -> None:
    tf_topics = {"/tf": "tf2_msgs/msg/TFMessage", "/tf_static": "tf2_msgs/msg/TFMessage"}
    cloud_topic = {"/points": "sensor_msgs/msg/PointCloud2"}
    assert feed(odometry="/odom", pose="/amcl_pose", pose_stamped="/p").wanted() == {
        **cloud_topic, "/odom": "nav_msgs/msg/Odometry", **tf_topics,
    }  # fmt: skip
    assert feed(poses="tf", pose="/amcl_pose").wanted() == {
        **cloud_topic, "/amcl_pose": "geometry_msgs/msg/PoseWithCovarianceStamped", **tf_topics,
    }  # fmt: skip
    assert feed(pose_stamped="/p", tf="", tf_static="", livox=["/livox"]).wanted() == {
        **cloud_topic, "/livox": "livox_ros_driver2/msg/CustomMsg", "/p": "geometry_msgs/msg/PoseStamped",
    }  # fmt: skip
