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

BY_ROSIDL = {
    "tf2_msgs/msg/TFMessage": "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    "map_msgs/msg/OccupancyGridUpdate": "c4095b0be2e4363f8978a1570e0293ee093436f1e1c61d99b48502ac317025e8",
    "grid_map_msgs/msg/GridMap": "343b0e72887541beda6b035cc053f2d6fffaad9d6dcb2773c15a808dfca31fde",
    "livox_ros_driver2/msg/CustomMsg": "2eb17e5e35bf5a2d6cd079f3c57f33abf95e5bf7d71b42cddc05daace73d815a",
}
"""From these packages' definitions, by Kilted's rosidl_generator_type_description."""


@pytest.mark.parametrize(("ros_type", "digest"), [*OF_KILTED.items(), *BY_ROSIDL.items()])
def test_a_hash_is_the_one_that_ros_has(ros_type: str, digest: str) -> None:
    assert type_hash(ros_type) == f"RIHS01_{digest}"


def test_an_unknown_type_has_no_hash() -> None:
    with pytest.raises(KeyError):
        type_hash("no_msgs/msg/Such")
