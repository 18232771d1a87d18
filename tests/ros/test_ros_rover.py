"""A rover that is a real ROS 2 node on Fast DDS drives into the map, and Nav2's costmap comes out to ROS."""

import base64
from pathlib import Path
from typing import Any

import numpy as np
from net import wait_until
from processes import events_in, running
from ros_processes import Peer, Ros, roughmap_node
from ros_rover import CLOUDS, ODOMETRY, ROS, SCANNER, TYPES, cloud, messages, odometry, settings

from roughmap_schemas import CheckpointEvent

SECONDS = 1.5
GRID = "nav_msgs/msg/OccupancyGrid"
COSTMAP = "/roughmap/costmap"


def digest_of(log: Path) -> str:
    return [event for event in events_in(log) if isinstance(event, CheckpointEvent)][-1].digest


def decided(feed: Any) -> None:
    clouds = round(SECONDS * SCANNER.rate_hz)
    wait_until(lambda: feed.client.status().clouds.accepted >= clouds, f"{clouds} clouds in the map")


def as_ros(kind: str, payload: bytes) -> tuple[str, str]:
    """Return the topic of a message, and its CDR in base64."""
    topic, cdr = (CLOUDS, cloud(payload)) if kind == "points" else (ODOMETRY, odometry(payload))
    return topic, base64.b64encode(cdr).decode()


def grid(cdr: bytes) -> Any:
    return ROS.deserialize_cdr(cdr, GRID)


def test_a_rover_on_dds_makes_the_same_map_and_the_costmap_comes_back(ros: Ros, robot: Peer, tmp_path: Path) -> None:
    sent = messages(SECONDS)
    (tmp_path / "plain").mkdir()
    plain = settings()
    del plain["ros2"]
    with running(tmp_path / "plain", **plain) as (_, feed):
        for message in sent:
            feed.ingest(message.kind, "rover1", message.payload)
        decided(feed)

    for topic in (CLOUDS, ODOMETRY):
        robot.ask("advertise", topic=topic, type=TYPES[topic], depth=100)
    (tmp_path / "ros").mkdir()
    out = {"costmap": {"type": "OccupancyGrid", "rate": 5}}
    with (
        running(tmp_path / "ros", **settings(keys="ros2dds", out=out)) as (service, feed),
        roughmap_node(
            ros, tmp_path, service.ready()["endpoints"][0],
            clouds=[CLOUDS], odometry=[ODOMETRY], occupancy_grids=[COSTMAP],
        ),
    ):  # fmt: skip
        for topic in (CLOUDS, ODOMETRY):
            robot.ask("matched", topic=topic, reliable=True)
        wait_until(lambda: feed.client.status() is not None, "the service")
        drive = [
            ((message.stamp_ns - sent[0].stamp_ns) / 1e9, *as_ros(message.kind, message.payload)) for message in sent
        ]
        robot.ask("publish_cdr", messages=drive)
        decided(feed)

        robot.ask("subscribe", topic=COSTMAP, type=GRID, latched=True, depth=1)  # late, as Nav2 would
        costmap = grid(robot.received(COSTMAP, GRID)[0][0])
        reply = robot.ask("call", service=f"{COSTMAP}/get_map", type="nav_msgs/srv/GetMap")
        asked = grid(base64.b64decode(reply["cdr"]))  # the reply has no other field
    assert digest_of(tmp_path / "ros/log") == digest_of(tmp_path / "plain/log")
    assert costmap.header.frame_id == "map"
    assert costmap.data.size == costmap.info.width * costmap.info.height > 0
    known = costmap.data[costmap.data >= 0]
    assert known.size > 500
    assert known.max() <= 100
    assert np.count_nonzero(asked.data >= 0) > 500
