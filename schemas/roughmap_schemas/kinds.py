"""The kinds of messages, and of channels in the log."""

from enum import StrEnum


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
