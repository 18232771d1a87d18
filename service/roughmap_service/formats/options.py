"""What a reader may be told about a recording."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from roughmap_schemas.robot_sections import SensorConfig
from roughmap_schemas.ros2_sections import Ros2RobotConfig


def _nobody(_share: float) -> None:
    """Nobody looks at the progress."""


def _uncounted(_reason: str, _points: int) -> None:
    """Nobody counts the points that a reader leaves out."""


def _unread(_note: str) -> None:
    """Nobody reads the notes."""


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """Options of `roughmap build` and `roughmap simulate --from` for all readers; each reads those that it knows.

    `scan_seconds`: points with times of their own become scans of so many seconds; None: one cloud. `poses`: a file of
    poses beside clouds that have none. `topics`: which topics of a bag are a robot's; None: found by their types,
    unless `clouds` and `odometry` name them. `map_frame` and `sensors`, by frame, are those of the configuration; with
    `any_sensor` clouds in other frames are read too.

    `reached` is called with the share of the recording that has been read, 0 to 1; `left_out` with a reason and a
    number of points that the reader left out for it ("noise", "withheld", "no_pose"); `note` with a line for the user,
    such as how stamps were read.
    """

    scan_seconds: float | None = None
    poses: Path | None = None
    topics: Ros2RobotConfig | None = None
    clouds: tuple[str, ...] = ()
    odometry: str | None = None
    map_frame: str = "map"
    sensors: Mapping[str, SensorConfig] = field(default_factory=dict)
    any_sensor: bool = True
    reached: Callable[[float], None] = _nobody
    left_out: Callable[[str, int], None] = _uncounted
    note: Callable[[str], None] = _unread
