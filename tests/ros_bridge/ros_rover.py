"""A rover on ROS topics: the simulated rover's messages, written as ROS messages by rosbags from plain data."""

import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import zenoh
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from net import peer_config, wait_until
from rosbags.typesys import Stores, get_typestore

from roughmap_ros.wire import Qos, RosNode, RosPublisher
from roughmap_service.simulation.rover import Message, rovers, sensor_settings
from roughmap_service.simulation.scanner import Scanner

ROS = get_typestore(Stores.ROS2_KILTED)

SCANNER = Scanner(rings=16, columns=96)
START_NS = 1_700_000_000 * 10**9

DATATYPES = {1: 2, 2: 1, 3: 4, 4: 3, 5: 6, 6: 5, 7: 7, 8: 8}
"""From a foxglove field's type to a PointField's: UINT8, INT8, UINT16, INT16, UINT32, INT32, FLOAT32, FLOAT64."""

CLOUDS, ODOMETRY, TF, TF_STATIC = "/points", "/odom", "/tf", "/tf_static"
TYPES = {
    CLOUDS: "sensor_msgs/msg/PointCloud2",
    ODOMETRY: "nav_msgs/msg/Odometry",
    TF: "tf2_msgs/msg/TFMessage",
    TF_STATIC: "tf2_msgs/msg/TFMessage",
}
SENSOR, LATCHED = Qos(reliable=False, depth=5), Qos(transient_local=True, depth=1)

LEVEL = (0.0, 0.0, 0.0, 1.0)

ROBOT = {"clouds": [CLOUDS], "odometry": ODOMETRY, "base": "base"}
"""`[ros2.robots.rover1]`."""


def settings(**ros2: Any) -> dict[str, Any]:
    """Return a service's settings for the rover on ROS topics; ``ros2`` are further values of that section."""
    return {
        "map": {"cell_size": 0.2},
        "sensors": {"lidar": sensor_settings(SCANNER)},
        "ros2": {"robots": {"rover1": ROBOT}, **ros2},
    }


def messages(seconds: float, seed: int = 1) -> list[Message]:
    """Return the rover's messages of the contract, in order."""
    (rover,) = rovers(1, seed, START_NS, SCANNER)
    return list(rover.messages(seconds))


def made(name: str, /, **fields: Any) -> Any:
    """Return a ROS message."""
    return ROS.types[name](**fields)


def header(stamp_ns: int, frame: str) -> Any:
    """Return a std_msgs/Header."""
    stamp = made("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return made("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def ns_of(stamp: Any) -> int:
    """Return a protobuf timestamp in ns."""
    return int(stamp.seconds) * 10**9 + int(stamp.nanos)


def cloud(payload: bytes) -> bytes:
    """Return a cloud of the contract as PointCloud2."""
    given = PointCloud.FromString(payload)
    size, step = len(given.data) // given.point_stride, given.point_stride
    return cdr(
        "sensor_msgs/msg/PointCloud2",
        header=header(ns_of(given.timestamp), given.frame_id),
        height=1,
        width=size,
        fields=[
            made("sensor_msgs/msg/PointField", name=f.name, offset=f.offset, datatype=DATATYPES[f.type], count=1)
            for f in given.fields
        ],
        is_bigendian=False,
        point_step=step,
        row_step=step * size,
        data=np.frombuffer(given.data, np.uint8),
        is_dense=True,
    )


def odometry(payload: bytes) -> bytes:
    """Return a pose of the contract as Odometry."""
    given = Odometry.FromString(payload)
    zero = made("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    still = made("geometry_msgs/msg/Twist", linear=zero, angular=zero)
    return cdr(
        "nav_msgs/msg/Odometry",
        header=header(ns_of(given.timestamp), given.frame_id),
        child_frame_id=given.body_frame_id,
        pose=made("geometry_msgs/msg/PoseWithCovariance", pose=pose(given), covariance=np.array(given.pose_covariance)),
        twist=made("geometry_msgs/msg/TwistWithCovariance", twist=still, covariance=np.zeros(36)),
    )


def pose(given: Odometry) -> Any:
    """Return a pose of the contract as Pose."""
    p, q = given.pose.position, given.pose.orientation
    return made(
        "geometry_msgs/msg/Pose",
        position=made("geometry_msgs/msg/Point", x=p.x, y=p.y, z=p.z),
        orientation=made("geometry_msgs/msg/Quaternion", x=q.x, y=q.y, z=q.z, w=q.w),
    )


def transform(stamp_ns: int, parent: str, child: str, xyz: Any = (0.0, 0.0, 0.0), xyzw: Any = LEVEL) -> bytes:
    """Return a TFMessage of one transform."""
    return transforms((stamp_ns, parent, child, xyz, xyzw))


def transforms(*given: tuple[int, str, str, Any, Any]) -> bytes:
    """Return a TFMessage."""
    return cdr(
        "tf2_msgs/msg/TFMessage",
        transforms=[
            made(
                "geometry_msgs/msg/TransformStamped",
                header=header(stamp_ns, parent),
                child_frame_id=child,
                transform=made(
                    "geometry_msgs/msg/Transform",
                    translation=made("geometry_msgs/msg/Vector3", x=xyz[0], y=xyz[1], z=xyz[2]),
                    rotation=made("geometry_msgs/msg/Quaternion", x=xyzw[0], y=xyzw[1], z=xyzw[2], w=xyzw[3]),
                ),
            )
            for stamp_ns, parent, child, xyz, xyzw in given
        ],
    )


def cdr(name: str, /, **fields: Any) -> bytes:
    """Return a message's bytes."""
    return bytes(ROS.serialize_cdr(made(name, **fields), name))


class RosRover:
    """A node with the publishers of a robot: clouds, odometry, and the transforms of a robot on a `map`."""

    def __init__(self, session: zenoh.Session, keys: Any = "rmw_zenoh") -> None:
        self.node = RosNode(session, "rover", keys=keys)
        self.publishers: dict[str, RosPublisher] = {
            topic: self.node.publisher(topic, name, ROS.hash_rihs01(name), LATCHED if topic == TF_STATIC else SENSOR)
            for topic, name in TYPES.items()
        }

    def hash_of(self, topic: str) -> str:
        """Return the hash of a topic's type."""
        return str(ROS.hash_rihs01(TYPES[topic]))

    def wait_for_listeners(self, *topics: str) -> None:
        """Wait until topics, or all of them, have a subscriber."""
        awaited = [self.publishers[topic] for topic in topics or self.publishers]
        wait_until(lambda: all(publisher.matched for publisher in awaited), "subscribers of the rover's topics")

    def drive(self, sent: list[Message]) -> None:
        """Publish messages, in order: clouds, odometry, and its pose as the transform odom -> base."""
        for message in sent:
            if message.kind == "points":
                self.publishers[CLOUDS].put(cloud(message.payload))
                continue
            self.publishers[ODOMETRY].put(odometry(message.payload))
            at = Odometry.FromString(message.payload).pose
            p, q = at.position, at.orientation
            self.publishers[TF].put(transform(message.stamp_ns, "odom", "base", (p.x, p.y, p.z), (q.x, q.y, q.z, q.w)))


@contextmanager
def ros_session(endpoints: list[str]) -> Iterator[zenoh.Session]:
    """Open the session of a ROS node; on a busy machine it waits instead of dropping messages."""
    config = peer_config(connect=endpoints, timestamping__enabled=True)
    config.insert_json5("transport/link/tx/queue/congestion_control/drop/wait_before_drop", str(10**7))  # us
    with zenoh.open(config) as session:
        yield session


def get_map_request(number: int = 1) -> bytes:
    """Return the attachment of a service's request, as rmw_zenoh has it."""
    return struct.pack("<qqB16s", number, time.time_ns(), 16, bytes(range(16)))
