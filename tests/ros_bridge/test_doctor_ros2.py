"""`roughmap doctor` names what keeps ROS topics from making a map."""

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh
from net import open_listener
from processes import configuration
from ros_rover import (
    CLOUDS,
    ODOMETRY,
    ROBOT,
    SENSOR,
    START_NS,
    TF,
    TF_STATIC,
    RosRover,
    cloud,
    messages,
    odometry,
    settings,
    transform,
)

from roughmap_ros.wire import Qos
from roughmap_service.cli.main import run


@contextmanager
def driving(session: zenoh.Session) -> Iterator[RosRover]:
    """Drive on the spot at the rates of a robot, until the end."""
    rover, stop = RosRover(session), threading.Event()
    sent = messages(1.0)
    poses = [message for message in sent if message.kind == "odometry"]
    points = [message for message in sent if message.kind == "points"]

    def drive() -> None:
        rover.publishers[TF_STATIC].put(transform(START_NS, "base", "lidar"))
        number = 0
        while not stop.wait(0.02):
            number += 1
            pose = poses[number % len(poses)].payload
            rover.publishers[TF].put(transform(START_NS + number * 2 * 10**7, "odom", "base"))
            rover.publishers[ODOMETRY].put(odometry(pose))
            if number % 5 == 0:
                rover.publishers[CLOUDS].put(cloud(points[number // 5 % len(points)].payload))

    thread = threading.Thread(target=drive)
    thread.start()
    try:
        yield rover
    finally:
        stop.set()
        thread.join()


def found(directory: Path, capsys: pytest.CaptureFixture[str], endpoints: list[str], **ros2: Any) -> list[Any]:
    """Run doctor beside the rover; return what it found on ROS topics."""
    zenoh_settings = {"listen": [], "connect": endpoints, "scouting": True, "mode": "client"}
    config = configuration(directory, settings(**ros2) | {"zenoh": zenoh_settings})
    run(["doctor", "--seconds", "4", "--json", "-c", str(config)])
    findings = json.loads(capsys.readouterr().out)["findings"]
    return [(one["verdict"], one["text"]) for one in findings if one["area"] in ("ros2", "rover1")]


def test_of_a_robot_that_is_right_it_tells_the_rates(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with open_listener() as (session, endpoints), driving(session):
        findings = found(tmp_path, capsys, endpoints)
    ros = [(verdict, text) for verdict, text in findings if text.startswith("/")]
    assert {verdict for verdict, _ in ros} == {"ok"}
    assert {text.split()[0] for _, text in ros} == {CLOUDS, ODOMETRY, TF, TF_STATIC}
    # The clouds are judged as those of the contract are.
    assert any("points each, in 'lidar'" in text for _, text in findings)
    assert not any("message_seq" in text for _, text in findings), "ROS drivers can't send it"


def test_it_names_a_topic_without_publisher_another_type_and_hash_a_qos_and_a_link_of_the_tree(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = {
        "clouds": ["/pionts", "/scan", "/old"], "tf_static": "/fixed", "base": "base", "poses": "tf",
    }  # fmt: skip
    with open_listener() as (session, endpoints), driving(session) as rover:
        node = rover.node
        node.publisher("/scan", "sensor_msgs/msg/LaserScan", "RIHS01_" + "0" * 64, SENSOR)
        node.publisher("/old", "sensor_msgs/msg/PointCloud2", "RIHS01_" + "1" * 64, SENSOR)
        node.publisher("/fixed", "tf2_msgs/msg/TFMessage", rover.hash_of(TF), Qos(transient_local=False))
        findings = found(tmp_path, capsys, endpoints, robots={"rover1": robot})
    wrong = [text for verdict, text in findings if verdict == "wrong"]

    def told(*words: str) -> bool:
        return any(all(word in text for word in words) for text in wrong)

    assert told("/pionts", "no node publishes it", "sensor_msgs/msg/PointCloud2 is on /old, /points")
    assert told("/scan", "/rover", "sensor_msgs/msg/LaserScan")
    assert told("/old", "hash RIHS01_111", "another version")
    assert told("/fixed", "volatile", "transient_local")
    assert told("map -> odom never came", "odom -> base")
    for topic in ("/pionts", "/scan", "/fixed"):
        assert len([text for text in wrong if topic in text]) == 1, wrong


def test_a_robot_that_needs_no_transforms_needs_no_topic_of_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = ROBOT | {"tf": "/no_tf", "tf_static": "/no_tf_static"}
    with open_listener() as (session, endpoints), driving(session):
        findings = found(tmp_path, capsys, endpoints, robots={"rover1": robot})
    assert [verdict for verdict, text in findings if "/no_tf" in text] == ["note", "note"]


def test_with_no_ros_node_in_the_domain_it_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with open_listener() as (session, endpoints), driving(session):
        findings = found(tmp_path, capsys, endpoints, robots={"rover1": ROBOT}, domain=7)
    assert ("wrong", "no ROS node is seen in domain 7") in findings


@pytest.mark.parametrize(("mode", "wrong"), [("peer", True), ("router", False)])
def test_a_peer_where_ros_nodes_look_for_their_router_is_wrong(
    mode: str, wrong: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from roughmap_schemas import Config
    from roughmap_service.inputs.ros2_checks import standing

    given = settings() | {"zenoh": {"listen": ["tcp/127.0.0.1:7447"], "mode": mode}}
    assert (standing(Config.model_validate(given)) is not None) == wrong
