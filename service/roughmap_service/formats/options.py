"""What a reader may be told about a recording."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from roughmap_schemas.robot_sections import SensorConfig
from roughmap_schemas.ros2_sections import Ros2RobotConfig


def _nobody(_share: float) -> None:
    """Nobody looks at the progress."""


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """Options of `roughmap build` and `roughmap simulate --from` for all readers; each reads those that it knows.

    `scan_seconds`: points with times of their own become scans of so many seconds; None: one cloud. `poses`: a file of
    poses beside clouds that have none. `topics`: which topics of a bag are a robot's; None: found by their types among
    `clouds` and `odometry`, if they are given. `map_frame` and `sensors`, by frame, are those of the configuration; with
    `any_sensor` clouds in other frames are read too. `reached` is called with the share of the recording that has been
    read, 0 to 1.
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
