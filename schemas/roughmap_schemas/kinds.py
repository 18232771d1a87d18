"""What a message, a channel of the log or a record holds."""

from enum import StrEnum


class Kind(StrEnum):
    """What a channel holds."""

    POINTS = "points"
    ODOMETRY = "odometry"
    TRANSFORM = "transform"
    EVENTS = "events"
    UPDATES = "updates"
    GRIDS = "grids"
    QUERIES = "queries"


INPUTS = (Kind.POINTS, Kind.ODOMETRY, Kind.TRANSFORM)
