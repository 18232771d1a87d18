"""What one topic of the map sends, and how."""

import itertools
import math
import re
from collections.abc import Mapping
from typing import Final, NamedTuple, Protocol

import numpy as np

from roughmap_client import Region
from roughmap_ros.messages.cells import cells_cdr
from roughmap_ros.messages.grid_maps import grid_map_cdr
from roughmap_ros.messages.grids import Occupancy, occupancy, occupancy_grid_cdr, occupancy_update_cdr
from roughmap_ros.messages.poses import tf_cdr
from roughmap_ros.messages.types import (
    GET_MAP,
    GRID_MAP,
    OCCUPANCY_GRID,
    OCCUPANCY_UPDATE,
    POINT_CLOUD,
    TF,
    type_hash,
)
from roughmap_ros.out.window import Window
from roughmap_ros.wire import Qos, RosNode
from roughmap_schemas.ros2_sections import Ros2Config, Ros2OutConfig
from roughmap_schemas.transform import Transform

LATCHED: Final = Qos(reliable=True, transient_local=True, depth=1)
"""Who subscribes later gets the newest message."""

DEFAULT_LAYERS: Final = ("mean_height", "traversability", "confidence")

LOCAL_STEP: Final = 1000.0
"""Local origins are multiples of this, metres."""

LOCAL_REACH: Final = 2000.0
"""Metres from a local origin to the middle of a window beyond which another origin is chosen. float32 still resolves
0.2 mm there."""

MOST_UPDATED: Final = 0.5
"""Part of a grid beyond which it is sent as a whole and not as an update."""


class Shown(NamedTuple):
    """A part of the map, the window that it fills, the map's frame, and the stamp of the newest message in the map."""

    region: Region
    window: Window
    frame_id: str
    stamp_ns: int


class MapTopic(Protocol):
    """A topic of the map: its settings, the robot around which its window lies, and the layers that it asks for."""

    out: Ros2OutConfig
    robot: str
    layers: tuple[str, ...]

    def show(self, shown: Shown) -> None:
        """Publish a part of the map."""

    def rest(self) -> None:
        """Finish what is unfinished: the map has not changed since the last call."""


class GridMapTopic:
    """grid_map_msgs/GridMap."""

    def __init__(self, node: RosNode, topic: str, robot: str, out: Ros2OutConfig) -> None:
        self.out = out
        self.robot = robot
        self.layers = tuple(out.layers) or DEFAULT_LAYERS
        self._publisher = node.publisher(topic, GRID_MAP, type_hash(GRID_MAP), LATCHED)

    def show(self, shown: Shown) -> None:
        """Publish the window's layers."""
        region = shown.region
        layers = {name: region[name] for name in self.layers}
        self._publisher.put(
            grid_map_cdr(layers, region.origin, region.cell_size, shown.stamp_ns, shown.frame_id, self.layers[:1])
        )

    def rest(self) -> None:
        """Nothing is unfinished."""


class _Grid(NamedTuple):
    """A part of the map, and the occupancy of its cells."""

    shown: Shown
    values: Occupancy

    def cdr(self) -> bytes:
        shown, region = self.shown, self.shown.region
        return occupancy_grid_cdr(self.values, region.origin, region.cell_size, shown.stamp_ns, shown.frame_id)


class OccupancyTopic:
    """nav_msgs/OccupancyGrid, map_msgs/OccupancyGridUpdate on TOPIC_updates, and nav_msgs/GetMap at TOPIC/get_map.

    While the window stays and little changes, updates are sent: each covers all cells that changed since the last whole
    grid, so that a lost one does no harm. When the map rests, the whole grid follows for those who come later.
    """

    layers: tuple[str, ...] = ("traversability",)

    def __init__(self, node: RosNode, topic: str, robot: str, out: Ros2OutConfig) -> None:
        self.out = out
        self.robot = robot
        self._publisher = node.publisher(topic, OCCUPANCY_GRID, type_hash(OCCUPANCY_GRID), LATCHED)
        update_hash = type_hash(OCCUPANCY_UPDATE)
        self._updates = node.publisher(f"{topic}_updates", OCCUPANCY_UPDATE, update_hash, LATCHED)
        self._newest: _Grid | None = None
        self._touched = np.empty((0, 0), np.bool_)
        """Cells that changed since the last whole grid."""
        node.service(f"{topic}/get_map", GET_MAP, type_hash(GET_MAP), self._get_map)

    def show(self, shown: Shown) -> None:
        """Publish the window, or what has changed in it."""
        values = occupancy(shown.region["traversability"], self.out.threshold)
        before, self._newest = self._newest, _Grid(shown, values)
        if before is None or before.shown.window != shown.window or before.values.shape != values.shape:
            self._send()
            return
        changed = values != before.values
        if not changed.any():
            return
        self._touched |= changed
        rows, columns = (np.flatnonzero(self._touched.any(axis=axis)) for axis in (1, 0))
        box = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        if values[box].size > MOST_UPDATED * values.size:
            self._send()
            return
        column, row = int(columns[0]), int(rows[0])
        self._updates.put(occupancy_update_cdr(values[box], column, row, shown.stamp_ns, shown.frame_id))

    def rest(self) -> None:
        """Send the whole grid, if updates were the last that was sent."""
        if self._touched.any():
            self._send()

    def _send(self) -> None:
        if self._newest is not None:
            self._publisher.put(self._newest.cdr())
            self._touched = np.zeros(self._newest.values.shape, np.bool_)

    def _get_map(self, _request: bytes) -> bytes:
        """Answer with the newest grid; an empty one before there is any."""
        newest = self._newest
        return occupancy_grid_cdr(np.empty((0, 0), np.int8), (0.0, 0.0), 1.0, 0, "") if newest is None else newest.cdr()


class CellsTopic:
    """sensor_msgs/PointCloud2 of cells: x, y, z (mean_height) and layers as float32 about a local origin."""

    def __init__(
        self, node: RosNode, topic: str, robot: str, out: Ros2OutConfig, frames: "LocalFrames", local: str
    ) -> None:
        self.out = out
        self._local = local
        self.robot = robot
        self._names = tuple(out.layers) or DEFAULT_LAYERS[1:]
        self.layers = tuple(dict.fromkeys(("mean_height", *self._names)))
        self._frames = frames
        self._publisher = node.publisher(topic, POINT_CLOUD, type_hash(POINT_CLOUD), LATCHED)

    def show(self, shown: Shown) -> None:
        """Publish the known cells of the window."""
        region = shown.region
        frame, origin = self._frames.frame_of(self._local, shown)
        layers = {name: region[name] for name in self._names}
        self._publisher.put(
            cells_cdr(
                region["mean_height"], layers, region.origin, region.cell_size, origin, shown.stamp_ns, frame
            )
        )  # fmt: skip

    def rest(self) -> None:
        """Nothing is unfinished."""


class LocalFrames:
    """Publishes the local frame of each topic of cells, `<map frame>_local`, on /tf_static.

    Its origin lies within `LOCAL_REACH` of the topic's cells and moves only when they leave that. With several such
    topics, those after the first have `<map frame>_local2` and so on.
    """

    def __init__(self, node: RosNode) -> None:
        self._publisher = node.publisher("/tf_static", TF, type_hash(TF), LATCHED)
        self._frames: dict[str, Transform] = {}

    def frame_of(self, local: str, shown: Shown) -> tuple[str, tuple[float, float, float]]:
        """Return the frame for these cells, whose name ends in ``local``, and its origin in the map frame, metres."""
        x, y = shown.window.centre
        held = self._frames.get(local)
        if held is None or math.dist(held.translation[:2], (x, y)) > LOCAL_REACH:
            origin = round(x / LOCAL_STEP) * LOCAL_STEP, round(y / LOCAL_STEP) * LOCAL_STEP, 0.0
            held = Transform(shown.stamp_ns, shown.frame_id, shown.frame_id + local, origin, (0.0, 0.0, 0.0, 1.0))
            self._frames[local] = held
            self._publisher.put(tf_cdr(list(self._frames.values())))
        x, y, z = held.translation
        return held.child_frame_id, (x, y, z)


def topic_of(name: str, out: Ros2OutConfig) -> str:
    """Return the topic of a table ``[ros2.out.NAME]``."""
    return out.topic or "/roughmap/" + re.sub(r"\W", "_", name)


def robot_of(out: Ros2OutConfig, config: Ros2Config) -> str:
    """Return the robot around which a topic's window lies; "" with a box."""
    return "" if out.box is not None else out.robot or next(iter(config.robots))


def map_topics(node: RosNode, config: Ros2Config) -> Mapping[str, MapTopic]:
    """Declare the topics of ``[ros2.out]``; return them by name."""
    found: dict[str, MapTopic] = {}
    frames: LocalFrames | None = None
    local = itertools.chain(("_local",), map("_local{}".format, itertools.count(2)))
    for name, out in config.out.items():
        topic, robot = topic_of(name, out), robot_of(out, config)
        if out.type == "GridMap":
            found[name] = GridMapTopic(node, topic, robot, out)
        elif out.type == "OccupancyGrid":
            found[name] = OccupancyTopic(node, topic, robot, out)
        else:
            frames = frames or LocalFrames(node)
            found[name] = CellsTopic(node, topic, robot, out, frames, next(local))
    return found
