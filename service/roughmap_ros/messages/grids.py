"""Traversability as nav_msgs/OccupancyGrid, its updates, and the reply of nav_msgs/GetMap.

0 is free, 100 is occupied, -1 is unknown. Both grids begin with the cell of lowest x and y and go along x first.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from roughmap_ros.messages.poses import header_of, pose_of, time_of
from roughmap_ros.messages.types import OCCUPANCY_GRID, OCCUPANCY_UPDATE, TYPES, make

Numbers = npt.NDArray[np.floating[Any]]
Occupancy = npt.NDArray[np.int8]


def occupancy(traversability: Numbers, threshold: float | None = None) -> Occupancy:
    """Return the occupancy of cells, of the same shape.

    By default 100 (1 - traversability), rounded, but at most 99 where a cell is not impassable: Nav2 takes 100 as the
    one value that forbids. With ``threshold``, 0 where traversability is at least that, else 100.
    """
    given = np.asarray(traversability, np.float64)
    known = np.isfinite(given)
    values = np.clip(np.where(known, given, 0.0), 0.0, 1.0)
    if threshold is None:
        cost = np.rint(100.0 * (1.0 - values))
        cost[values > 0.0] = np.minimum(cost[values > 0.0], 99.0)
    else:
        # Compared in the layer's own type, in which 0.7 is 0.7.
        cost = np.where(traversability >= threshold, 0.0, 100.0)
    return np.where(known, cost, -1.0).astype(np.int8)


def occupancy_grid_cdr(
    values: Occupancy, origin: tuple[float, float], cell_size: float, stamp_ns: int, frame_id: str
) -> bytes:
    """Write a nav_msgs/OccupancyGrid, which is the reply of nav_msgs/GetMap too: that has no other field.

    ``values``: `occupancy` (rows along y, columns along x), both from the lowest; ``origin`` is the low corner of the
    first cell in ``frame_id``, metres.
    """
    rows, columns = values.shape
    message = make(
        OCCUPANCY_GRID,
        header=header_of(stamp_ns, frame_id),
        info=make(
            "nav_msgs/msg/MapMetaData",
            map_load_time=time_of(stamp_ns),
            resolution=cell_size,
            width=columns,
            height=rows,
            origin=pose_of(*origin),
        ),
        data=values.reshape(-1),
    )
    return bytes(TYPES.serialize_cdr(message, OCCUPANCY_GRID, little_endian=True))


def occupancy_update_cdr(values: Occupancy, column: int, row: int, stamp_ns: int, frame_id: str) -> bytes:
    """Write a map_msgs/OccupancyGridUpdate: cells that changed, the first at ``column`` and ``row`` of the grid."""
    rows, columns = values.shape
    message = make(
        OCCUPANCY_UPDATE,
        header=header_of(stamp_ns, frame_id),
        x=column,
        y=row,
        width=columns,
        height=rows,
        data=values.reshape(-1),
    )
    return bytes(TYPES.serialize_cdr(message, OCCUPANCY_UPDATE, little_endian=True))
