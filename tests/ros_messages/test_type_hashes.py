"""The hashes of types are those of ROS itself, for rmw_zenoh drops what has another one."""

import pytest

from roughmap_ros.messages import type_hash

OF_KILTED = {
    "sensor_msgs/msg/PointCloud2": "9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5",
    "nav_msgs/msg/Odometry": "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    "nav_msgs/msg/OccupancyGrid": "8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7",
    "geometry_msgs/msg/PoseStamped": "10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e",
    "geometry_msgs/msg/TransformStamped": "0a241f87d04668d94099cbb5ba11691d5ad32c2f29682e4eb5653424bd275206",
    "std_msgs/msg/Float32MultiArray": "0599f6f85b4bfca379873a0b4375a0aca022156bd2d7021275d116ed1fa8bfe0",
    "nav_msgs/srv/GetMap": "c8ae77c9995b3554b5ba80e4d4d443f970ac65143102a1d893ec24fc07b31147",
}
"""From the JSON files beside the message definitions of ROS 2 Kilted."""


@pytest.mark.parametrize(("ros_type", "digest"), OF_KILTED.items())
def test_a_hash_is_the_one_that_ros_installs(ros_type: str, digest: str) -> None:
    assert type_hash(ros_type) == f"RIHS01_{digest}"


@pytest.mark.parametrize(
    ("ros_type", "begins", "ends"),
    [
        ("livox_ros_driver2/msg/CustomMsg", "RIHS01_2eb17e5e", "815a"),
        ("grid_map_msgs/msg/GridMap", "RIHS01_343b0e72", "31fde"),
    ],
)
def test_hashes_of_types_outside_ros_are_those_in_use(ros_type: str, begins: str, ends: str) -> None:
    found = type_hash(ros_type)
    assert (found[:15], found[-len(ends) :], len(found)) == (begins, ends, 71)


def test_an_unknown_type_has_no_hash() -> None:
    with pytest.raises(KeyError):
        type_hash("no_msgs/msg/Such")
