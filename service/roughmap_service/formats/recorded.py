"""What the readers of recordings return: scans with poses, points in the map frame, or the messages of a robot."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roughmap_schemas.faults import ReportedError
from roughmap_schemas.kinds import RobotMessage

Floats = npt.NDArray[np.float64]

PART_ROWS = 500_000
"""Most points in one `PlacedPoints`: 12 MB of coordinates."""


class CloudFileFault(ReportedError):
    """A file is not a readable cloud; one line that names the file, what was expected and what was found."""

    exit_code = 2


class RecordedScan(NamedTuple):
    """One scan: `points` (N, 3) in the sensor's frame, metres; pose of the sensor in the map.

    `position` is (3,) in metres, `rotation` (4,) a unit quaternion x, y, z, w.
    """

    points: Floats
    stamp_ns: int
    position: Floats
    rotation: Floats


class PlacedPoints(NamedTuple):
    """`points` (N, 3) in the map frame, metres; `stamp_ns` one or (N,); `covariance` (3, 3), (N, 3, 3) or None."""

    points: Floats
    stamp_ns: int | npt.NDArray[np.int64]
    covariance: Floats | None


class Contents(NamedTuple):
    """What comes before the messages of a recording: the frame of the map that its poses lead to.

    The transforms among its messages give the extrinsics of the sensors with the frames `mounted`; those with the
    frames `placed` are at the pose itself, unless they are configured.
    """

    map_frame: str
    mounted: frozenset[str] = frozenset()
    placed: frozenset[str] = frozenset()


Recorded = RecordedScan | PlacedPoints | Contents | RobotMessage
"""One part of a recording. Messages come after their `Contents`."""
