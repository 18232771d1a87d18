"""The Zenoh keys of ROS topics and services, as rmw_zenoh and zenoh-bridge-ros2dds form them.

rmw_zenoh: ``<domain>/<topic without outer slashes>/<pkg>::msg::dds_::<Type>_/<type hash>``.
zenoh-bridge-ros2dds: the topic without its first slash.
"""

import re
from typing import Final, Literal, NamedTuple

KeyStyle = Literal["rmw_zenoh", "ros2dds"]

ROS_TYPE: Final = re.compile(r"([A-Za-z]\w*)/(msg|srv|action)/([A-Za-z]\w*)", re.ASCII)
DDS_TYPE: Final = re.compile(r"([A-Za-z]\w*)::(msg|srv|action)::dds_::([A-Za-z]\w*)_", re.ASCII)
NAME: Final = re.compile(r"(/[A-Za-z_]\w*)+", re.ASCII)
DOMAIN: Final = re.compile(r"\d{1,3}", re.ASCII)


class DataKey(NamedTuple):
    """What a data key of rmw_zenoh says; ``topic`` is absolute, ``ros_type`` as in sensor_msgs/msg/PointCloud2."""

    domain: int
    topic: str
    ros_type: str
    type_hash: str

    @property
    def text(self) -> str:
        """The key."""
        return f"{self.domain}/{self.topic.strip('/')}/{dds_name(self.ros_type)}/{self.type_hash}"


def bridge_key(name: str) -> str:
    """Return the key of a topic or service with zenoh-bridge-ros2dds."""
    return name.removeprefix("/")


def dds_name(ros_type: str) -> str:
    """Return the DDS name of a type: sensor_msgs::msg::dds_::PointCloud2_ for sensor_msgs/msg/PointCloud2.

    Raises ValueError if it is no name of a ROS type.
    """
    match = ROS_TYPE.fullmatch(ros_type)
    if match is None:
        raise ValueError(f"expected a ROS type such as sensor_msgs/msg/PointCloud2; found {ros_type!r:.200}")
    package, group, name = match.groups()
    return f"{package}::{group}::dds_::{name}_"


def ros_name(dds_type: str) -> str | None:
    """Return the ROS name of a type's DDS name, None if it is none."""
    match = DDS_TYPE.fullmatch(dds_type)
    return None if match is None else "/".join(match.groups())


def check_name(name: str) -> str:
    """Return an absolute name of a topic, service or node; raises ValueError for any other."""
    if NAME.fullmatch(name) is None:
        raise ValueError(f"expected an absolute ROS name such as /robot/points; found {name!r:.200}")
    return name
