"""What comes from ROS nodes, as functions of any bytes: only BadRosMessage and BadAttachment come out, and what is read
fits the contract."""

import contextlib
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from roughmap_ros.feed import RobotFeed
from roughmap_ros.messages import (
    BadRosMessage,
    cloud_message,
    grid_map_arrays,
    livox_message,
    read_odometry,
    read_pose,
    read_pose_stamped,
    transforms_of,
)
from roughmap_ros.wire.attachment import BadAttachment, pack_attachment, unpack_attachment
from roughmap_ros.wire.tokens import parse_token
from roughmap_schemas import MessageFault, decode_cloud, decode_odometry, decode_transform
from roughmap_schemas.kinds import Kind, RobotMessage
from roughmap_schemas.ros2_sections import Ros2RobotConfig

MAX_MESSAGE = 1 << 20
T0 = 1_700_000_000 * 10**9

READERS: tuple[Callable[[bytes], Any], ...] = (
    partial(cloud_message, log_ns=T0),
    partial(livox_message, log_ns=T0),
    read_odometry,
    read_pose,
    read_pose_stamped,
    transforms_of,
    grid_map_arrays,
)

ROBOT = Ros2RobotConfig(clouds=["/points"], livox=["/livox"], odometry="/odom", poses="tf", base="base")
GIVEN = Ros2RobotConfig(clouds=["/points"], odometry="/odom", base="base")
TOPICS = ("/points", "/livox", "/odom", "/tf", "/tf_static")


def ros_names(payload: bytes) -> None:
    """Tokens, a line each."""
    for line in payload.decode(errors="replace").splitlines():
        entity = parse_token(line)
        if entity is not None:
            assert line.isprintable()
            assert parse_token(entity.token) == entity
            assert len(entity.gid) == 16
            assert entity.qos.depth >= 0
    with contextlib.suppress(BadAttachment):
        assert pack_attachment(unpack_attachment(payload))[:16] == payload[:16]


def ros_messages(payload: bytes) -> None:
    """A message, read as each type."""
    for read in READERS:
        with contextlib.suppress(BadRosMessage):
            got = read(payload)
            if isinstance(got, RobotMessage):
                check(got)


def ros_feed(payload: bytes) -> None:
    """Messages to a robot, with its topic, how long after the last it came, and its size before each."""
    for robot in (ROBOT, GIVEN):
        feed = RobotFeed(robot, "map", {"lidar"})
        at, now = 0, T0
        while at + 4 <= len(payload):
            topic = TOPICS[payload[at] % len(TOPICS)]
            size = int.from_bytes(payload[at + 2 : at + 4], "little")
            now += payload[at + 1] * 10**7
            with contextlib.suppress(BadRosMessage):
                for message in feed.take(topic, payload[at + 4 : at + 4 + size], now):
                    check(message)
            at += 4 + size
        assert len(feed.problems(now)) <= 20
        for message in feed.end():
            check(message)
        assert feed.position is None or np.isfinite(feed.position).all()


def check(message: RobotMessage) -> None:
    """What is sent on is refused by the contract only for what it holds, never for its form."""
    with contextlib.suppress(MessageFault):
        if message.kind is Kind.POINTS:
            decode_cloud(message.payload, max_message=MAX_MESSAGE, max_points=10_000, map_frame="map")
        elif message.kind is Kind.ODOMETRY:
            decode_odometry(message.payload, max_message=MAX_MESSAGE)
        else:
            decode_transform(message.payload, max_message=MAX_MESSAGE)
