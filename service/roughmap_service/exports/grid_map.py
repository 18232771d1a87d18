"""A rosbag2 with one grid_map_msgs/GridMap: RViz's grid_map plugin and `ros2 bag play` show it."""

from pathlib import Path
from typing import Final

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError

from roughmap_ros.messages import TYPES, grid_map_cdr
from roughmap_ros.messages.types import GRID_MAP
from roughmap_service.exports.sheet import ExportFault, Sheet

TOPIC: Final = "/grid_map"

BAG_VERSION: Final = 9
"""Of the bag's metadata: Iron and later write it, Humble reads it."""

MAX_BYTES: Final = 1 << 29
"""Of the message: all layers of a GridMap are in one."""


def write_grid_map(sheet: Sheet, folder: Path) -> None:
    """Write a bag (MCAP) with the layers; the first one is GridMap's basic layer: cells without it are unknown."""
    sheet.check_cells(MAX_BYTES // 4 // len(sheet.layers), f"a GridMap with {len(sheet.layers)} layers")
    rows, columns = sheet.shape
    values = np.empty((rows, columns, len(sheet.layers)), np.float32)
    at = 0
    for band in sheet.bands(upward=True):
        values[at : at + len(band)] = band
        at += len(band)
    layers = {name: values[:, :, number] for number, name in enumerate(sheet.layers)}
    cdr = grid_map_cdr(layers, sheet.low, sheet.cell_size, sheet.stamp_ns, sheet.frame_id, sheet.layers[:1])
    try:
        with Writer(folder, version=BAG_VERSION, storage_plugin=StoragePlugin.MCAP) as bag:
            connection = bag.add_connection(TOPIC, GRID_MAP, typestore=TYPES)
            bag.write(connection, sheet.stamp_ns, cdr)
    except WriterError as error:
        raise ExportFault(f"{folder.name}: {error}") from None
