"""What a reader may be told about a recording."""

from dataclasses import dataclass
from pathlib import Path

from roughmap_schemas.ros2_sections import Ros2RobotConfig


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """Options of `roughmap build` and `roughmap simulate --from` for all readers; each reads those that it knows.

    `scan_seconds`: points with times of their own become scans of so many seconds; None: one cloud. `poses`: a file of
    poses beside clouds that have none. `topics`: which topics of a bag are a robot's; None: found by their types.
    `map_frame` and `mounted` (sensor frames whose extrinsics come from tf) are those of the configuration.
    """

    scan_seconds: float | None = None
    poses: Path | None = None
    topics: Ros2RobotConfig | None = None
    map_frame: str = "map"
    mounted: frozenset[str] = frozenset()
