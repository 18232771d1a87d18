"""OccupancyGrid, its update and GridMap: values, orientation and place, as other decoders read them."""

import numpy as np
import pytest
from ros_cdr_bytes import Cdr, pose
from ros_decoded import decoded_by_mcap

from roughmap_ros.messages import (
    BadRosMessage,
    grid_map_arrays,
    grid_map_cdr,
    occupancy,
    occupancy_grid_cdr,
    occupancy_update_cdr,
)

STAMP = 12_000_000_034
NAN = float("nan")
EASE = np.array([[1.0, 0.75, 0.0], [NAN, 0.001, 0.5]], np.float32)
"""Traversability of two rows of three cells; the lower row first."""


def test_an_occupancy_grid_has_place_size_and_costs() -> None:
    grid = decoded_by_mcap(
        "nav_msgs/msg/OccupancyGrid", occupancy_grid_cdr(occupancy(EASE), (500_000.25, -3.5), 0.1, STAMP, "map")
    )
    assert (grid.header.stamp.sec, grid.header.stamp.nanosec, grid.header.frame_id) == (12, 34, "map")
    info = grid.info
    assert (info.width, info.height, info.resolution) == (3, 2, np.float32(0.1))
    assert (info.origin.position.x, info.origin.position.y, info.origin.position.z) == (500_000.25, -3.5, 0.0)
    turned = info.origin.orientation
    assert (turned.x, turned.y, turned.z, turned.w) == (0, 0, 0, 1)
    assert list(grid.data) == [0, 25, 100, -1, 99, 50]


def test_a_threshold_makes_cells_free_or_occupied() -> None:
    ease = np.array([[0.7, 0.69, NAN]], np.float32)
    assert occupancy(ease, 0.7).tolist() == [[0, 100, -1]]


def test_an_update_says_which_cells_it_has() -> None:
    update = decoded_by_mcap(
        "map_msgs/msg/OccupancyGridUpdate", occupancy_update_cdr(occupancy(EASE), 7, 9, STAMP, "map")
    )
    assert (update.x, update.y, update.width, update.height) == (7, 9, 3, 2)
    assert list(update.data) == [0, 25, 100, -1, 99, 50]


def test_cells_of_a_grid_map_lie_where_grid_map_says() -> None:
    """By grid_map's own rule: the position of an index is centre + length / 2 - resolution (index + 1 / 2)."""
    heights = np.arange(12, dtype=np.float32).reshape(3, 4)
    cdr = grid_map_cdr({"mean_height": heights}, (10.0, 20.0), 0.5, STAMP, "map", ["mean_height"])
    read = decoded_by_mcap("grid_map_msgs/msg/GridMap", cdr)
    info, layer = read.info, read.data[0]
    assert (read.layers, read.basic_layers) == (["mean_height"], ["mean_height"])
    assert (info.length_x, info.length_y, info.resolution) == (2.0, 1.5, 0.5)
    assert [(d.label, d.size, d.stride) for d in layer.layout.dim] == [("column_index", 3, 12), ("row_index", 4, 4)]
    assert (read.outer_start_index, read.inner_start_index, layer.layout.data_offset) == (0, 0, 0)
    matrix = np.reshape(layer.data, (4, 3), order="F")
    for i in range(4):
        for j in range(3):
            x = info.pose.position.x + info.length_x / 2 - 0.5 * (i + 0.5)
            y = info.pose.position.y + info.length_y / 2 - 0.5 * (j + 0.5)
            assert matrix[i, j] == heights[int((y - 20.0) / 0.5), int((x - 10.0) / 0.5)]


def test_a_grid_map_is_read_as_it_was_written() -> None:
    layers = {"a": np.array([[1, NAN, 3]], np.float32), "b": np.array([[4.5, 5, -6]], np.float32)}
    read = grid_map_arrays(grid_map_cdr(layers, (-3.0, 7.0), 0.25, STAMP, "map", ["a"]))
    assert (read.stamp_ns, read.frame_id, read.origin, read.cell_size) == (STAMP, "map", (-3.0, 7.0), 0.25)
    assert read.basic_layers == ("a",)
    for name, layer in layers.items():
        np.testing.assert_array_equal(read.layers[name], layer)


def grid_map_by_hand(order: str, labels: tuple[str, str], data: list[float], start: tuple[int, int]) -> bytes:
    """A GridMap of 3 cells along x and 2 along y, the centre at (10, 20), cells of 1 m."""
    cdr = pose(Cdr(order).header(STAMP, "map"), [1.0, 3.0, 2.0, 10, 20, 0, 0, 0, 0, 1])
    cdr.put("I", 1).text("height").put("I", 0).put("I", 1)
    sizes = {"column_index": 2, "row_index": 3}
    cdr.put("I", 2)
    for label in labels:
        cdr.text(label).put("II", sizes[label], 0)
    cdr.put("II", 0, 6).put("f" * 6, *data)
    return cdr.put("HH", *start).bytes()


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(
    ("labels", "data", "start"),
    [
        (("column_index", "row_index"), [6, 5, 4, 3, 2, 1], (0, 0)),  # x falls from 3 to 1, then y
        (("row_index", "column_index"), [6, 3, 5, 2, 4, 1], (0, 0)),
        (("column_index", "row_index"), [4, 6, 5, 1, 3, 2], (1, 0)),  # the ring begins at the second index along x
        (("column_index", "row_index"), [3, 2, 1, 6, 5, 4], (0, 1)),
    ],
)
def test_grid_maps_of_others_are_read(
    order: str, labels: tuple[str, str], data: list[float], start: tuple[int, int]
) -> None:
    read = grid_map_arrays(grid_map_by_hand(order, labels, data, start))
    assert (read.origin, read.cell_size) == ((8.5, 19.0), 1.0)
    np.testing.assert_array_equal(read.layers["height"], [[1, 2, 3], [4, 5, 6]])


def test_a_grid_map_of_another_size_than_it_says_is_refused() -> None:
    cdr = grid_map_by_hand("<", ("row_index", "row_index"), [0] * 6, (0, 0))
    with pytest.raises(BadRosMessage, match="expected a layer of two dimensions"):
        grid_map_arrays(cdr)
