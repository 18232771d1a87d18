"""What a node of ROS 2 Kilted put onto rmw_zenoh's keys is read as it was said."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from roughmap_ros.messages import BadRosMessage, cloud_message, occupancy, occupancy_grid_cdr, read_odometry, type_hash
from roughmap_schemas.cloud import decode_cloud


@pytest.fixture(scope="session")
def ros_samples(recordings: Path) -> dict[str, Any]:
    return dict(json.loads((recordings / "ros2" / "rmw_zenoh_kilted.json").read_text()))


def test_its_keys_have_our_hashes(ros_samples: dict[str, Any]) -> None:
    entries = [*ros_samples["samples"].values(), ros_samples["service"]]
    for entry in entries:
        dds, found = entry["key"].split("/")[-2:]
        package, kind, _, name = dds.split("::")
        assert type_hash(f"{package}/{kind}/{name.removesuffix('_')}") == found


def test_its_odometry_is_read(ros_samples: dict[str, Any]) -> None:
    read = read_odometry(bytes.fromhex(ros_samples["samples"]["ros_odom"]["payload"]))
    assert (read.stamp_ns, read.frame_id, read.body_frame_id) == (1_000_000_000, "odom", "base_link")
    assert (read.position, read.rotation) == ((0.0, 2.5, 0.0), (0.0, 0.0, 0.0, 1.0))
    np.testing.assert_array_equal(read.covariance, np.zeros((6, 6)))


def test_its_grid_is_ours_but_for_padding(ros_samples: dict[str, Any]) -> None:
    theirs = bytes.fromhex(ros_samples["samples"]["ros_map"]["payload"])
    ease = np.array([[np.nan, 1.0, 0.5], [0.0, 1.0, np.nan]], np.float32)
    ours = occupancy_grid_cdr(occupancy(ease), (0.0, 0.0), 0.1, 0, "map")
    assert theirs[40:44] == b"t_ty"  # what happened to be in memory before a number at a multiple of eight
    assert ours == theirs[:40] + bytes(4) + theirs[44:]


def test_its_cloud_is_read(ros_samples: dict[str, Any]) -> None:
    """Only its first 400 bytes were recorded; the others count on."""
    sample = ros_samples["samples"]["ros_points"]
    begin = bytes.fromhex(sample["payload"].removesuffix("..."))
    data = (bytes(range(256)) * 63)[:16000]
    head = sample["size"] - len(data) - 1
    assert begin[head:] == data[: len(begin) - head]
    message = cloud_message(begin[:head] + data + b"\1", 7)
    cloud = decode_cloud(message.payload, max_message=10**5, max_points=1000)
    assert (cloud.stamp_ns, cloud.frame_id) == (0, "lidar")
    expected = np.frombuffer(data, "<f4").reshape(1000, 4)
    np.testing.assert_array_equal(cloud.points, expected[:, :3])
    np.testing.assert_array_equal(cloud.time_values("intensity"), expected[:, 3])


def test_its_cloud_without_the_rest_is_refused(ros_samples: dict[str, Any]) -> None:
    payload = ros_samples["samples"]["ros_points"]["payload"].removesuffix("...")
    with pytest.raises(BadRosMessage, match="expected 16000 bytes"):
        cloud_message(bytes.fromhex(payload), 7)
