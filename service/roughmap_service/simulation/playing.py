"""Recorded scans as messages: the scans of an NPZ file as clouds, and their poses as odometry."""

from collections.abc import Iterator
from pathlib import Path

from roughmap_schemas.cloud import encode_cloud
from roughmap_schemas.odometry import encode_odometry
from roughmap_service.formats.npz import read_scans
from roughmap_service.formats.recorded import RecordedScan
from roughmap_service.simulation.rover import BODY_FRAME, MAP_FRAME, SENSOR_FRAME, Message


def recorded_messages(file: Path, robot: str = "rover1", sensor_frame: str = SENSOR_FRAME) -> Iterator[Message]:
    """Return each scan's pose, then the scan, in order. `formats.npz` describes the file.

    The recorded pose is the sensor's, and is published as the robot's: the service must have the sensor at the robot's
    origin. The pose has exactly the scan's stamp, so one is enough; it has no covariance. Raises CloudFileFault if the
    file does not hold scans with poses.
    """
    scans = read_scans(file)  # outside of the generator, so that a bad file raises here and not at the first message

    def messages() -> Iterator[Message]:
        for scan in scans:
            yield _pose(scan, robot)
            payload = encode_cloud(scan.points, scan.stamp_ns, sensor_frame)
            yield Message(scan.stamp_ns, "points", payload, robot, scan.stamp_ns)

    return messages()


def _pose(scan: RecordedScan, robot: str) -> Message:
    payload = encode_odometry(scan.stamp_ns, MAP_FRAME, scan.position, scan.rotation, None, BODY_FRAME)
    return Message(scan.stamp_ns, "odometry", payload, robot, scan.stamp_ns)
