"""The kinds of messages, and of channels in the log."""

from enum import StrEnum
from typing import NamedTuple


class Kind(StrEnum):
    """What a message or a channel of the log holds."""

    POINTS = "points"
    ODOMETRY = "odometry"
    TRANSFORM = "transform"
    EVENTS = "events"
    UPDATES = "updates"
    GRIDS = "grids"
    QUERIES = "queries"


INPUTS = (Kind.POINTS, Kind.ODOMETRY, Kind.TRANSFORM)


class RobotMessage(NamedTuple):
    """A cloud, a pose or a transform: its payload for `robots/NAME/points` and its like, and when it came, in ns."""

    kind: Kind
    payload: bytes
    log_ns: int
