"""Recorded scans as messages: the clouds of an NPZ file and, as odometry, the poses recorded with them."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from roughmap_schemas.cloud import encode_cloud
from roughmap_schemas.odometry import encode_odometry
from roughmap_service.formats.clouds_in import RecordedScan, read_scans
from roughmap_service.simulation.rotations import of_matrix
from roughmap_service.simulation.rover import BODY_FRAME, MAP_FRAME, SENSOR_FRAME, Message


def recorded_messages(file: Path, robot: str = "rover1", sensor_frame: str = SENSOR_FRAME) -> Iterator[Message]:
    """Each scan's pose, then the scan, in order; `file` in the layout of scans that `clouds_in` describes.

    The recorded pose is the sensor's, so robot and sensor are one: the service needs the sensor at its default
    place on the robot. A pose at exactly the scan's stamp needs no second one; the covariance is left out (unknown).
    Raises CloudFileFault where the file holds no scans with poses.
    """
    scans = read_scans(file)  # here, not at the first message: a fault of the file is to be heard before anything else

    def messages() -> Iterator[Message]:
        for scan in scans:
            yield _pose(scan, robot)
            payload = encode_cloud(scan.points, scan.stamp_ns, sensor_frame)
            yield Message(scan.stamp_ns, "points", payload, robot, scan.stamp_ns)

    return messages()


def _pose(scan: RecordedScan, robot: str) -> Message:
    position, rotation = scan.pose[:3, 3], rotation_of(scan.pose)
    payload = encode_odometry(scan.stamp_ns, MAP_FRAME, position, rotation, None, BODY_FRAME)
    return Message(scan.stamp_ns, "odometry", payload, robot, scan.stamp_ns)


def rotation_of(pose: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """The unit quaternion x, y, z, w of a (4, 4) pose, whose rotation may be rounded."""
    return np.array(of_matrix(pose[:3, :3]))
