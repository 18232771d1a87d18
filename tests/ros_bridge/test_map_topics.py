"""The map as ROS topics: what comes out of a running service equals what its client is told."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from net import WAIT_S, Gathered, wait_until
from processes import Feed, running
from ros_rover import LATCHED, ROS, SENSOR, START_NS, RosRover, get_map_request, messages, ros_session, settings

from roughmap_client import Region
from roughmap_ros.messages.types import TYPES, type_hash
from roughmap_ros.wire import Qos, RosNode

BOX = (-6.0, -6.0, 6.0, 5.0)
LAYERS = ["max_height", "mean_height", "slope"]
FAR = (500_100.0, 5_400_600.0, 500_110.0, 5_400_610.0)
"""UTM coordinates, which float32 resolves to half a metre."""

OUT = {
    "costmap": {"type": "OccupancyGrid", "box": BOX, "rate": 20.0},
    "limited": {"type": "OccupancyGrid", "box": BOX, "rate": 20.0, "threshold": 0.4, "topic": "/nav/limited"},
    "ground": {"type": "GridMap", "box": BOX, "rate": 20.0, "layers": LAYERS},
    "cells": {"type": "PointCloud2", "rate": 20.0, "size": (8.0, 6.0), "layers": ["traversability"]},
    "slow": {"type": "GridMap", "box": BOX, "rate": 2.0},
    "survey": {"type": "PointCloud2", "rate": 20.0, "box": FAR, "layers": ["count"]},
}
GRID, UPDATE = "nav_msgs/msg/OccupancyGrid", "map_msgs/msg/OccupancyGridUpdate"


class Driven(NamedTuple):
    """A service whose map a rover on ROS topics has made, a client, and where the rover stands."""

    endpoints: list[str]
    feed: Feed
    position: tuple[float, float]

    def region(self, *layers: str) -> Region:
        """Return layers over the box."""
        x, y, u, v = BOX
        return self.feed.client.region((x + 0.01, y + 0.01, u - 0.01, v - 0.01), layers)


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Driven]:
    sent = messages(1.5)
    clouds = sum(message.kind == "points" for message in sent)
    directory: Path = tmp_path_factory.mktemp("map-topics")
    with running(directory, **settings(out=OUT)) as (service, feed):
        endpoints = service.ready()["endpoints"]
        with ros_session(endpoints) as ros:
            rover = RosRover(ros)
            rover.wait_for_listeners()
            rover.drive(sent)
            wait_until(lambda: feed.client.status().clouds.accepted >= clouds, f"{clouds} clouds")
            last = [message for message in sent if message.kind == "odometry"][-1].payload
            yield Driven(endpoints, feed, position_of(last))


def position_of(payload: bytes) -> tuple[float, float]:
    from foxglove_schemas_protobuf.Odometry_pb2 import Odometry

    at = Odometry.FromString(payload).pose.position
    return at.x, at.y


def newest(endpoints: list[str], topic: str, ros_type: str, good: Any, qos: Qos = LATCHED) -> Any:
    """Join late; return the first message on a topic that is ``good``."""
    came: Gathered[Any] = Gathered()
    with ros_session(endpoints) as session, RosNode(session, "late", keys="rmw_zenoh") as node:
        node.subscriber(
            topic, ros_type, type_hash(ros_type), qos,
            lambda received: came(TYPES.deserialize_cdr(received.payload, ros_type)),
        )  # fmt: skip
        return came.wait(lambda items: any(map(good, items[-1:])), f"the right {ros_type} on {topic}")[-1]


def cells_of(message: Any) -> np.ndarray:
    return np.asarray(message.data).reshape(message.info.height, message.info.width)


def is_cost_of(cost: np.ndarray, traversability: np.ndarray) -> bool:
    """Tell whether these are 0 to 100 by traversability, 100 only where it is 0, and -1 where it is unknown."""
    known = ~np.isnan(traversability)
    t, c = traversability[known].astype(float), cost[known].astype(float)
    near = np.abs(c - 100 * (1 - t)) <= 0.5 + 1e-4
    return bool(
        (cost[~known] == -1).all() and (near | ((c == 99) & (t < 0.01))).all() and ((c == 100) == (t == 0)).all()
    )


def test_whoever_comes_later_gets_the_occupancy_grid(driven: Driven) -> None:
    region = driven.region("traversability")
    assert 100 < np.count_nonzero(~np.isnan(region["traversability"])) < region["traversability"].size
    grid = newest(
        driven.endpoints, "/roughmap/costmap", GRID, lambda one: is_cost_of(cells_of(one), region["traversability"])
    )
    assert grid.header.frame_id == "map"
    assert grid.header.stamp.sec >= START_NS // 10**9
    assert (grid.info.origin.position.x, grid.info.origin.position.y) == pytest.approx(region.origin)
    assert grid.info.resolution == pytest.approx(region.cell_size)


def test_with_a_threshold_a_cell_is_free_or_occupied(driven: Driven) -> None:
    t = driven.region("traversability")["traversability"]
    expected = np.where(np.isnan(t), -1, np.where(t >= 0.4, 0, 100))
    assert {*np.unique(expected)} == {-1, 0, 100}
    newest(driven.endpoints, "/nav/limited", GRID, lambda one: (cells_of(one) == expected).all())


def test_a_grid_map_has_each_layer_cell_by_cell(driven: Driven) -> None:
    region = driven.region(*LAYERS)
    known = ~np.isnan(region["mean_height"])

    def values(message: Any, name: str) -> np.ndarray:
        """Read a layer as grid_map does: index (i, j) lies at centre + length / 2 - (index + 0.5) resolution."""
        info, array = message.info, message.data[message.layers.index(name)]
        columns, rows = (dim.size for dim in array.layout.dim)
        assert (array.layout.dim[0].label, array.layout.dim[1].label) == ("column_index", "row_index")
        matrix = np.asarray(array.data).reshape((rows, columns), order="F")
        found = np.full(region.shape, np.nan, np.float32)
        for i in range(rows):
            for j in range(columns):
                x = info.pose.position.x + info.length_x / 2 - (i + 0.5) * info.resolution
                y = info.pose.position.y + info.length_y / 2 - (j + 0.5) * info.resolution
                at = int((y - region.origin[1]) / region.cell_size), int((x - region.origin[0]) / region.cell_size)
                found[at] = matrix[i, j]
        return found

    message = newest(
        driven.endpoints, "/roughmap/ground", "grid_map_msgs/msg/GridMap",
        lambda one: np.array_equal(values(one, "mean_height"), region["mean_height"], equal_nan=True),
    )  # fmt: skip
    assert known.any()
    assert (message.layers, message.basic_layers) == (LAYERS, LAYERS[:1])
    for name in LAYERS:
        assert np.array_equal(values(message, name), region[name], equal_nan=True), name


def test_cells_around_a_robot_are_points_in_a_local_frame(driven: Driven) -> None:
    name = "sensor_msgs/msg/PointCloud2"
    local = local_frame(driven, "map_local")
    moved = local.transform.translation

    def points_of(message: Any) -> np.ndarray:
        return np.asarray(message.data).view("<f4").reshape(-1, 4) + np.array([moved.x, moved.y, moved.z, 0.0])

    def is_the_map(message: Any) -> bool:
        """A message from before the map's last scan may come first."""
        points = points_of(message)
        there = driven.feed.client.cells(points[:, :2], ["mean_height", "traversability"])
        return bool(
            message.width > 100
            and np.allclose(points[:, 2], there["mean_height"], atol=1e-5)
            and np.allclose(points[:, 3], there["traversability"], atol=1e-6, equal_nan=True)
        )

    message = newest(driven.endpoints, "/roughmap/cells", name, is_the_map)
    assert message.header.frame_id == "map_local"
    assert [field.name for field in message.fields] == ["x", "y", "z", "traversability"]
    places = points_of(message)[:, :2]
    middle = (places.min(axis=0) + places.max(axis=0)) / 2
    assert (np.abs(middle - driven.position) < [4.0, 3.0]).all()
    assert (np.abs(places - driven.position) <= [4.2, 3.2]).all()


def local_frame(driven: Driven, name: str) -> Any:
    """Return the transform of a local frame in the map."""
    message = newest(
        driven.endpoints, "/tf_static", "tf2_msgs/msg/TFMessage",
        lambda one: name in [transform.child_frame_id for transform in one.transforms],
    )  # fmt: skip
    (local,) = [transform for transform in message.transforms if transform.child_frame_id == name]
    assert local.header.frame_id == "map"
    return local


def test_far_from_the_origin_cells_lose_nothing(driven: Driven) -> None:
    spread = np.random.default_rng(2).uniform(0.0, 1.0, (2000, 3)) * [9.9, 9.9, 0.01]
    driven.feed.cloud("surveyor", START_NS + 10**9, spread + np.array([*FAR[:2], 412.5]), frame="map")
    name = "sensor_msgs/msg/PointCloud2"
    message = newest(driven.endpoints, "/roughmap/survey", name, lambda one: one.width > 1000)
    local = local_frame(driven, "map_local2")
    moved = local.transform.translation
    assert (message.header.frame_id, moved.x, moved.y) == ("map_local2", 500_000.0, 5_401_000.0)
    points = np.asarray(message.data).view("<f4").reshape(-1, 4)
    places = points[:, :2].astype(float) + np.array([moved.x, moved.y])
    # Cells of 0.2 m: their middles are odd multiples of 0.1 m.
    assert np.allclose(places / 0.1, np.rint(places / 0.1), atol=0.01)
    assert np.allclose(points[:, 3], driven.feed.client.cells(places, ["count"])["count"])


def test_get_map_answers_with_the_grid(driven: Driven) -> None:
    t = driven.region("traversability")["traversability"]
    # The hash is that of ROS's own nav_msgs/srv/GetMap.json.
    key = (
        "0/roughmap/costmap/get_map/nav_msgs::srv::dds_::GetMap_/"
        "RIHS01_c8ae77c9995b3554b5ba80e4d4d443f970ac65143102a1d893ec24fc07b31147"
    )
    beside = get_map_request()
    with ros_session(driven.endpoints) as session:

        def asked() -> Any:
            replies = list(session.get(key, payload=bytes([0, 1, 0, 0, 0]), attachment=beside, timeout=WAIT_S))
            (ok,) = [reply.ok for reply in replies if reply.ok is not None]
            assert ok.attachment.to_bytes()[:8] == beside[:8]
            grid = ROS.deserialize_cdr(ok.payload.to_bytes(), GRID)
            return is_cost_of(cells_of(grid), t)

        wait_until(asked, "the grid of the map as it is")


def test_updates_bring_a_grid_to_the_state_of_the_next_whole_one(driven: Driven) -> None:
    came: Gathered[Any] = Gathered()
    with ros_session(driven.endpoints) as session, RosNode(session, "costmap", keys="rmw_zenoh") as node:
        for topic, name in (("/roughmap/costmap", GRID), ("/roughmap/costmap_updates", UPDATE)):
            node.subscriber(
                topic, name, type_hash(name), LATCHED if name == GRID else SENSOR,
                lambda received, name=name: came((name, TYPES.deserialize_cdr(received.payload, name))),
            )  # fmt: skip
        came.wait(lambda items: any(name == GRID for name, _ in items), "the first grid")
        before = driven.feed.client.status().sequence
        random = np.random.default_rng(1)
        for k in range(3):
            spread = random.uniform(-0.5, 0.5, (4000, 3)) * [1.0, 1.0, 0.02]
            stamp_ns = driven.feed.client.status().newest_stamp_ns + 10**8
            driven.feed.cloud("surveyor", stamp_ns, spread + np.array([3.0 - k, -4.0, 0.1]), frame="map")
        wait_until(lambda: driven.feed.client.status().sequence >= before + 3, "three clouds")
        t = driven.region("traversability")["traversability"]
        items = came.wait(
            lambda items: len(items) > 1 and items[-1][0] == GRID and is_cost_of(cells_of(items[-1][1]), t),
            "the whole grid, once the map rests",
        )
    state, updated = None, 0
    for name, message in items:
        if name == GRID:
            if updated and state is not None and message is items[-1][1]:
                assert (state == cells_of(message)).all()
            state = cells_of(message).copy()
        elif state is not None:
            part = np.asarray(message.data).reshape(message.height, message.width)
            state[message.y : message.y + message.height, message.x : message.x + message.width] = part
            updated += 1
    assert updated


def test_other_nodes_see_the_node_and_its_topics(driven: Driven) -> None:
    with ros_session(driven.endpoints) as session:
        tokens = [
            str(reply.ok.key_expr)
            for reply in session.liveliness().get("@ros2_lv/0/**", timeout=WAIT_S)
            if reply.ok is not None
        ]
    ours = [token.split("/") for token in tokens if "/%/%/roughmap" in token]
    assert {(part[5], *part[9:10]) for part in ours} >= {
        ("NN",), ("MS", "%points"), ("MS", "%odom"), ("MS", "%tf"), ("MS", "%tf_static"), ("MP", "%tf_static"),
        ("MP", "%roughmap%costmap"), ("MP", "%roughmap%costmap_updates"), ("SS", "%roughmap%costmap%get_map"),
        ("MP", "%roughmap%ground"), ("MP", "%roughmap%cells"), ("MP", "%nav%limited"),
    }  # fmt: skip


def test_a_changing_map_is_sent_at_its_rate_at_most(driven: Driven) -> None:
    came: Gathered[float] = Gathered()
    name, stamp_ns = "grid_map_msgs/msg/GridMap", driven.feed.client.status().newest_stamp_ns
    with ros_session(driven.endpoints) as session, RosNode(session, "slow", keys="rmw_zenoh") as node:
        node.subscriber("/roughmap/slow", name, type_hash(name), SENSOR, lambda received: came(time.monotonic()))
        while len(came.items) < 4:
            stamp_ns += 10**8
            driven.feed.cloud("surveyor", stamp_ns, np.full((50, 3), [0.3, 0.3, 0.1]), frame="map")
    # At 2 Hz three intervals take 1.5 s from sending to sending; on the way one may lose a little.
    assert came.items[3] - came.items[0] > 1.2


def test_a_map_that_does_not_change_sends_nothing(driven: Driven) -> None:
    came: Gathered[bytes] = Gathered()
    with ros_session(driven.endpoints) as session, RosNode(session, "still", keys="rmw_zenoh") as node:
        name = "grid_map_msgs/msg/GridMap"
        node.subscriber("/roughmap/ground", name, type_hash(name), LATCHED, lambda received: came(received.payload))
        came.wait(lambda items: len(items) >= 1, "the latched map")

        def rests() -> bool:
            """Tell whether nothing comes during half a second of queries: at 20 Hz ten messages would."""
            before, until = len(came.items), time.monotonic() + 0.5
            while time.monotonic() < until:
                driven.feed.client.region((-5.0, -5.0, 5.0, 5.0))
            return len(came.items) == before

        wait_until(rests, "a topic that rests", 10.0)
