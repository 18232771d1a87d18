"""ROS messages in CDR, the bytes that travel and that bags hold, from and to roughmap's own.

types.py     the types and their hashes; ROS 1's too, for `TYPES.ros1_to_cdr`
cdr.py       reads CDR, either byte order, within bounds
clouds.py    PointCloud2 in
livox.py     Livox's CustomMsg in
poses.py     Odometry, PoseWithCovarianceStamped and PoseStamped in; TFMessage in and out
grids.py     OccupancyGrid, OccupancyGridUpdate out
grid_maps.py GridMap out and in
cells.py     PointCloud2 of cells out
"""

from roughmap_ros.messages.cdr import BadRosMessage
from roughmap_ros.messages.cells import cells_cdr
from roughmap_ros.messages.clouds import cloud_message
from roughmap_ros.messages.grid_maps import GridMapRead, grid_map_arrays, grid_map_cdr
from roughmap_ros.messages.grids import occupancy, occupancy_grid_cdr, occupancy_update_cdr
from roughmap_ros.messages.livox import livox_message
from roughmap_ros.messages.poses import (
    PoseRead,
    read_odometry,
    read_pose,
    read_pose_stamped,
    tf_cdr,
    transforms_of,
)
from roughmap_ros.messages.types import TYPES, type_hash

__all__ = [
    "TYPES",
    "BadRosMessage",
    "GridMapRead",
    "PoseRead",
    "cells_cdr",
    "cloud_message",
    "grid_map_arrays",
    "grid_map_cdr",
    "livox_message",
    "occupancy",
    "occupancy_grid_cdr",
    "occupancy_update_cdr",
    "read_odometry",
    "read_pose",
    "read_pose_stamped",
    "tf_cdr",
    "transforms_of",
    "type_hash",
]
