"""What is wrong on ROS topics is counted, told in the status and on the pages, and stops nothing."""

from pathlib import Path

from net import WAIT_S, wait_until
from processes import Service, connected, running
from ros_rover import (
    CLOUDS,
    ODOMETRY,
    ROBOT,
    SENSOR,
    START_NS,
    TF,
    TF_STATIC,
    RosRover,
    messages,
    odometry,
    ros_session,
    settings,
    transform,
)

from roughmap_ros.wire import RosNode


def test_a_message_that_cannot_be_read_is_counted_and_the_next_one_is_taken(tmp_path: Path) -> None:
    sent = messages(0.5)
    bad = [b"", b"\x00\x01\x00\x00", b"\x00\x01\x00\x00" + b"\xff" * 64, b"\x07" * 40]
    with running(tmp_path, **settings()) as (service, feed), ros_session(service.ready()["endpoints"]) as ros:
        rover = RosRover(ros)
        rover.wait_for_listeners()
        for payload in bad:
            for topic in (CLOUDS, ODOMETRY, TF):
                rover.publishers[topic].put(payload)
        rover.drive(sent)
        wait_until(lambda: feed.client.status().clouds.accepted >= 4, "clouds in the map")
        assert feed.client.status().refused == {"bad_message": 3 * len(bad)}
        assert "robot rover1" in service.line('"reason": "bad_message"')


def test_a_cloud_that_is_too_large_is_refused_by_that_name(tmp_path: Path) -> None:
    limits = {"input": {"max_message": 20_000}}
    with running(tmp_path, **settings(), **limits) as (service, feed), ros_session(service.ready()["endpoints"]) as ros:
        rover = RosRover(ros)
        rover.wait_for_listeners()
        rover.publishers[CLOUDS].put(bytes(20_001))
        wait_until(lambda: feed.client.status().refused.get("too_large"), "the refusal")


def test_messages_lost_on_the_way_are_counted(tmp_path: Path) -> None:
    with running(tmp_path, **settings()) as (service, feed), ros_session(service.ready()["endpoints"]) as ros:
        rover = RosRover(ros)
        rover.wait_for_listeners()
        poses = [odometry(message.payload) for message in messages(0.5) if message.kind == "odometry"]
        rover.publishers[ODOMETRY].put(poses[0])
        for _ in range(3):
            next(rover.publishers[ODOMETRY]._numbers)  # as if these had been dropped by a router
        rover.publishers[ODOMETRY].put(poses[1])
        wait_until(lambda: feed.client.status().gaps.get("rover1") == 3, "three lost messages")


def test_a_missing_link_of_the_tree_is_told_while_it_lasts(tmp_path: Path) -> None:
    robots = {"rover1": {"clouds": [CLOUDS], "base": "base", "poses": "tf"}}
    with Service(tmp_path, **settings(robots=robots), http={"listen": "127.0.0.1:0"}) as service:
        with connected(service) as feed, ros_session(service.ready()["endpoints"]) as ros:
            rover = RosRover(ros)
            rover.wait_for_listeners(CLOUDS, TF, TF_STATIC)

            def told(word: str) -> str | None:
                nonlocal stamp_ns
                stamp_ns += 10**8
                rover.publishers[TF].put(transform(stamp_ns, "odom", "base"))
                status = feed.client.status()
                return next((text for text in status.problems.values() if word in text), None)

            stamp_ns = START_NS
            text = wait_until(lambda: told("map -> odom"), "the missing link", WAIT_S)
            assert text.startswith("robot rover1 ros2: ")
            assert text.endswith("; start what publishes it, or correct ros2.robots")
            assert feed.client.status().health == "degraded"
            service.line('"event": "ros2_problem"')
            assert len([line for line in service.err if '"event": "ros2_problem"' in line]) <= 2
            rover.publishers[TF_STATIC].put(transform(START_NS, "map", "odom"))
            wait_until(lambda: told("map -> odom") is None, "the end of the problem", WAIT_S)
        assert service.stop() == 0


def test_a_topic_of_another_type_is_told(tmp_path: Path) -> None:
    robots = {"rover1": ROBOT | {"clouds": ["/scan"]}}
    with (
        running(tmp_path, **settings(robots=robots)) as (service, feed),
        ros_session(service.ready()["endpoints"]) as ros,
        RosNode(ros, "driver", keys="rmw_zenoh") as node,
    ):
        node.publisher("/scan", "sensor_msgs/msg/LaserScan", "RIHS01_" + "0" * 64, SENSOR)
        status = wait_until(
            lambda: next((s for s in [feed.client.status()] if "ros2 /scan" in s.problems), None), "the mismatch"
        )
        assert "sensor_msgs/msg/LaserScan" in status.problems["ros2 /scan"]
