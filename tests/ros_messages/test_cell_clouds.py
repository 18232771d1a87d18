"""Cells as a PointCloud2: where they lie, and to which precision."""

import numpy as np
from ros_decoded import decoded_by_mcap

from roughmap_ros.messages import cells_cdr, cloud_message
from roughmap_schemas.cloud import decode_cloud

NAN = float("nan")
HEIGHTS = np.array([[1.0, NAN, 3.0], [4.0, 5.0, NAN]])
SLOPES = np.array([[0.1, 0.2, NAN], [0.4, 0.5, 0.6]], np.float32)


def test_each_known_cell_is_a_point_with_its_layers() -> None:
    cdr = cells_cdr(HEIGHTS, {"slope": SLOPES}, (10.0, 20.0), 0.5, (10.0, 20.0, 1.0), 12_000_000_034, "roughmap")
    message = decoded_by_mcap("sensor_msgs/msg/PointCloud2", cdr)
    assert [(f.name, f.offset, f.datatype, f.count) for f in message.fields] == [
        ("x", 0, 7, 1),
        ("y", 4, 7, 1),
        ("z", 8, 7, 1),
        ("slope", 12, 7, 1),
    ]
    assert (message.width, message.height, message.point_step, message.row_step) == (4, 1, 16, 64)
    assert (message.header.frame_id, message.is_bigendian, message.is_dense) == ("roughmap", False, True)
    expected = [[0.25, 0.25, 0.0, 0.1], [1.25, 0.25, 2.0, NAN], [0.25, 0.75, 3.0, 0.4], [0.75, 0.75, 4.0, 0.5]]
    np.testing.assert_array_equal(np.frombuffer(bytes(message.data), "<f4").reshape(4, 4), np.float32(expected))


def test_far_from_the_map_frames_origin_no_precision_is_lost() -> None:
    origin, local = (500_000.0, 5_800_000.0), (500_000.0, 5_800_000.0, 0.0)
    cdr = cells_cdr(HEIGHTS, {}, origin, 0.1, local, 5, "roughmap")
    cloud = decode_cloud(cloud_message(cdr, 0).payload, max_message=10**4, max_points=10)
    np.testing.assert_allclose(cloud.points[:, 1].astype(float), [0.05, 0.05, 0.15, 0.15], atol=1e-7)


def test_an_unknown_part_of_the_map_is_a_cloud_without_points() -> None:
    cdr = cells_cdr(np.full((2, 2), NAN), {"slope": np.zeros((2, 2))}, (0, 0), 0.1, (0, 0, 0), 5, "roughmap")
    assert decode_cloud(cloud_message(cdr, 0).payload, max_message=10**4, max_points=10).points.shape == (0, 3)
