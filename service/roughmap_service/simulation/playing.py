"""Recordings as messages: those of a robot as they are; scans as clouds, with their poses as odometry."""

from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import numpy as np

from roughmap_schemas.cloud import encode_cloud
from roughmap_schemas.kinds import RobotMessage
from roughmap_schemas.odometry import encode_odometry
from roughmap_service.formats.clouds import read_cloud
from roughmap_service.formats.options import ReadOptions
from roughmap_service.formats.recorded import Contents, PlacedPoints, Recorded, RecordedScan
from roughmap_service.simulation.rover import BODY_FRAME, SENSOR_FRAME, Kind, Message

KINDS: dict[str, Kind] = {"points": "points", "odometry": "odometry", "transform": "transform"}


def recorded_messages(
    path: Path, robot: str = "rover1", sensor_frame: str = SENSOR_FRAME, options: ReadOptions | None = None
) -> Iterator[Message]:
    """Return the messages of a recording in order; of scans each one's pose, then the scan.

    A scan's recorded pose is the sensor's, and is published as the robot's: the service must have the sensor at the
    robot's origin. The pose has exactly the scan's stamp, so one is enough; it has no covariance. Points in the map
    frame are clouds in that frame. Raises CloudFileFault if the file can't be read.
    """
    options = options or ReadOptions()
    parts = read_cloud(path, options)
    first = next(parts, None)  # outside of the generator, so that a bad file raises here and not at the first message

    def messages() -> Iterator[Message]:
        if first is not None:
            for part in chain((first,), parts):
                yield from _of(part, robot, sensor_frame, options.map_frame)

    return messages()


def _of(part: Recorded, robot: str, sensor_frame: str, map_frame: str) -> Iterator[Message]:
    if isinstance(part, RobotMessage):
        yield Message(part.log_ns, KINDS[part.kind], part.payload, robot, part.log_ns)
    elif isinstance(part, RecordedScan):
        pose = encode_odometry(part.stamp_ns, map_frame, part.position, part.rotation, None, BODY_FRAME)
        yield Message(part.stamp_ns, "odometry", pose, robot, part.stamp_ns)
        yield _cloud(part.points, part.stamp_ns, sensor_frame, robot)
    elif isinstance(part, PlacedPoints):
        stamp_ns = int(np.min(part.stamp_ns, initial=2**62)) if len(part.points) else 0
        yield _cloud(part.points, stamp_ns, map_frame, robot)
    else:
        assert isinstance(part, Contents)  # noqa: S101 - there is no other part


def _cloud(points: np.ndarray, stamp_ns: int, frame_id: str, robot: str) -> Message:
    return Message(stamp_ns, "points", encode_cloud(points, stamp_ns, frame_id), robot, stamp_ns)
