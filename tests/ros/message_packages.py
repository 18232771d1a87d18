"""ROS packages of messages that PyPI has no wheels of; a colcon workspace generates their type support."""

from pathlib import Path

DEFINITIONS: dict[str, dict[str, str]] = {
    "tf2_msgs": {"TFMessage": "geometry_msgs/TransformStamped[] transforms"},
    "map_msgs": {
        "OccupancyGridUpdate": "std_msgs/Header header\nint32 x\nint32 y\nuint32 width\nuint32 height\nint8[] data",
    },
    "grid_map_msgs": {
        "GridMapInfo": "float64 resolution\nfloat64 length_x\nfloat64 length_y\ngeometry_msgs/Pose pose",
        "GridMap": "std_msgs/Header header\nGridMapInfo info\nstring[] layers\nstring[] basic_layers\n"
        "std_msgs/Float32MultiArray[] data\nuint16 outer_start_index\nuint16 inner_start_index",
    },
    "livox_ros_driver2": {
        "CustomPoint": "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line",
        "CustomMsg": "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
        "CustomPoint[] points",
    },
}
"""The fields of each message, by package: their names and types are what other ROS packages expect."""

NEEDED = ("builtin_interfaces", "geometry_msgs", "std_msgs")

PACKAGE = """<?xml version="1.0"?>
<package format="3">
  <name>{name}</name>
  <version>0.0.0</version>
  <description>Messages for a test</description>
  <maintainer email="test@example.com">test</maintainer>
  <license>Apache-2.0</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  <buildtool_depend>rosidl_default_generators</buildtool_depend>
  {depends}
  <member_of_group>rosidl_interface_packages</member_of_group>
  <export><build_type>ament_cmake</build_type></export>
</package>
"""

CMAKE = """cmake_minimum_required(VERSION 3.12)
project({name})
find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
{find}
rosidl_generate_interfaces({name} {files} DEPENDENCIES {needed})
ament_package()
"""


def write_packages(folder: Path) -> None:
    """Write the packages into ``folder``, the sources of a workspace."""
    for name, messages in DEFINITIONS.items():
        own = folder / name
        (own / "msg").mkdir(parents=True, exist_ok=True)
        depends = "".join(f"<depend>{needed}</depend>" for needed in NEEDED)
        find = "\n".join(f"find_package({needed} REQUIRED)" for needed in NEEDED)
        files = " ".join(f"msg/{message}.msg" for message in messages)
        (own / "package.xml").write_text(PACKAGE.format(name=name, depends=depends))
        (own / "CMakeLists.txt").write_text(CMAKE.format(name=name, find=find, files=files, needed=" ".join(NEEDED)))
        for message, fields in messages.items():
            (own / "msg" / f"{message}.msg").write_text(fields + "\n")
