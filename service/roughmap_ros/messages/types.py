"""The ROS types that roughmap reads and writes, and their hashes, which rmw_zenoh puts into its keys."""

from functools import cache
from typing import Final

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

POINT_CLOUD: Final = "sensor_msgs/msg/PointCloud2"
ODOMETRY: Final = "nav_msgs/msg/Odometry"
POSE: Final = "geometry_msgs/msg/PoseWithCovarianceStamped"
POSE_STAMPED: Final = "geometry_msgs/msg/PoseStamped"
TF: Final = "tf2_msgs/msg/TFMessage"
LIVOX: Final = "livox_ros_driver2/msg/CustomMsg"
GRID_MAP: Final = "grid_map_msgs/msg/GridMap"
OCCUPANCY_GRID: Final = "nav_msgs/msg/OccupancyGrid"
OCCUPANCY_UPDATE: Final = "map_msgs/msg/OccupancyGridUpdate"
GET_MAP: Final = "nav_msgs/srv/GetMap"

LIVOX_ROS1: Final = "livox_ros_driver/msg/CustomMsg"
"""The older driver's name for the same message."""

TF_ROS1: Final = "tf/msg/tfMessage"
"""ROS 1's older name for TFMessage."""

CUSTOM_POINT: Final = """
uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line
"""

CUSTOM_MSG: Final = """
std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
CustomPoint[] points
"""

ADDED: Final = {
    "grid_map_msgs/msg/GridMapInfo": """
float64 resolution
float64 length_x
float64 length_y
geometry_msgs/Pose pose
""",
    GRID_MAP: """
std_msgs/Header header
GridMapInfo info
string[] layers
string[] basic_layers
std_msgs/Float32MultiArray[] data
uint16 outer_start_index
uint16 inner_start_index
""",
    OCCUPANCY_UPDATE: """
std_msgs/Header header
int32 x
int32 y
uint32 width
uint32 height
int8[] data
""",
    "livox_ros_driver2/msg/CustomPoint": CUSTOM_POINT,
    LIVOX: CUSTOM_MSG,
    "livox_ros_driver/msg/CustomPoint": CUSTOM_POINT,
    LIVOX_ROS1: CUSTOM_MSG,
    TF_ROS1: "geometry_msgs/TransformStamped[] transforms\n",
}
"""Definitions that rosbags does not have."""

SERVICE_HASHES: Final = {GET_MAP: "RIHS01_c8ae77c9995b3554b5ba80e4d4d443f970ac65143102a1d893ec24fc07b31147"}
"""As in ROS's own share/nav_msgs/srv/GetMap.json: rosbags has no services."""


def _typestore() -> Typestore:
    store = get_typestore(Stores.ROS2_KILTED)
    for name, definition in ADDED.items():
        store.register(get_types_from_msg(definition, name))
    return store


TYPES: Final = _typestore()
"""All of these types, also for bags of ROS 1: `TYPES.ros1_to_cdr(raw, type)`."""


@cache
def type_hash(ros_type: str) -> str:
    """Return the hash of a message or service, as "RIHS01_..."; KeyError for a type that is not known."""
    return SERVICE_HASHES.get(ros_type) or TYPES.hash_rihs01(ros_type)


def make(name: str, /, **fields: object) -> object:
    """Return a message of that type, for `TYPES.serialize_cdr`."""
    return TYPES.types[name](**fields)  # type: ignore[arg-type]  # rosbags checks nothing here, and serialising does
