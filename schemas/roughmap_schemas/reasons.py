"""Why something was not taken: every reason and code that can appear on the wire, in the log or in a count."""

from enum import StrEnum
from typing import Final


class PointReason(StrEnum):
    """Why a point of an integrated cloud did not reach a cell; counted under the first that holds, in this order."""

    NOT_FINITE = "not_finite"
    NO_RETURN = "no_return"
    TIME = "time"
    NO_POSE = "no_pose"
    SELF = "self"
    RANGE = "range"
    CEILING = "ceiling"
    COVARIANCE = "covariance"
    UNCERTAIN = "uncertain"
    BOUNDS = "bounds"


class CloudReason(StrEnum):
    """Why a logged cloud changed nothing; the outcome of its event."""

    POSE_GAP = "pose_gap"
    POSE_JUMP = "pose_jump"
    NO_POSE = "no_pose"
    LATE = "late"
    TOO_MANY_TILES = "too_many_tiles"
    EMPTY = "empty"
    OVERLOAD = "overload"
    CLOCK_RESET = "clock_reset"


class PoseReason(StrEnum):
    """Why a logged pose was not taken into its robot's buffer."""

    DUPLICATE = "duplicate"
    STALE = "stale"
    POSE_FRAME = "pose_frame"
    BAD_COVARIANCE = "bad_covariance"


class Refusal(StrEnum):
    """Why a message never reached the log.

    ``duplicate`` is never an error reply: a published message that the log holds already is only counted, and an
    ingested one gets the receipt of the first.
    """

    BAD_KEY = "bad_key"
    BAD_ENCODING = "bad_encoding"
    BAD_MESSAGE = "bad_message"
    TOO_LARGE = "too_large"
    UNKNOWN_SENSOR = "unknown_sensor"
    UNKNOWN_ROBOT = "unknown_robot"
    BUSY = "busy"
    LOG_UNAVAILABLE = "log_unavailable"
    SHUTTING_DOWN = "shutting_down"
    DUPLICATE = "duplicate"


class QueryCode(StrEnum):
    """Why a query was answered with an error."""

    BAD_KEY = "bad_key"
    BAD_LEVEL = "bad_level"
    UNKNOWN_PARAMETER = "unknown_parameter"
    BAD_PARAMETER = "bad_parameter"
    UNKNOWN_LAYER = "unknown_layer"
    BAD_BBOX = "bad_bbox"
    TOO_LARGE = "too_large"
    SINCE_AHEAD = "since_ahead"
    BUSY = "busy"
    SHUTTING_DOWN = "shutting_down"
    INTERNAL = "internal"


INTEGRATED = "integrated"
"""The outcome of a cloud that was taken; any other outcome is a ``CloudReason``."""

Reason = PointReason | CloudReason | PoseReason | Refusal
"""Every reason under which a message, a pose, a cloud or a point can be counted."""

MEANING: Final[dict[type[Reason], dict[str, str]]] = {
    PointReason: {
        "not_finite": "NaN or infinite",
        "no_return": "no echo, as from the sky",
        "time": "its time is not within 1 s after its scan's stamp",
        "no_pose": "no poses around its time",
        "self": "on the robot itself (sensors.*.exclude)",
        "range": "nearer than min_range or beyond max_range",
        "ceiling": "higher above the scanner than ceiling",
        "covariance": "invalid covariance",
        "uncertain": "uncertain by more than max_horizontal_radius",
        "bounds": "outside map.bounds",
    },
    CloudReason: {
        "pose_gap": "poses around it more than max_pose_gap apart",
        "pose_jump": "poses around it exceed max_speed or max_turn",
        "no_pose": "poses around it did not come within max_wait",
        "late": "older than the kept poses (pose_history)",
        "too_many_tiles": "too many tiles (max_new_tiles, max_tiles)",
        "empty": "no accepted point",
        "overload": "dropped: more input than can be integrated",
        "clock_reset": "the robot's clock was set back",
    },
    PoseReason: {
        "duplicate": "a second pose with the same stamp",
        "stale": "older than the kept poses (pose_history)",
        "pose_frame": "no transform from its frame to the map's",
        "bad_covariance": "invalid covariance",
    },
    Refusal: {
        "bad_key": "not a key of a robot",
        "bad_encoding": "wrong encoding for its key",
        "bad_message": "can't be read",
        "too_large": "more than max_message bytes or max_points points",
        "unknown_sensor": "no [sensors] table for its frame",
        "unknown_robot": "not in input.robots, or beyond max_robots",
        "busy": "the queue was full",
        "log_unavailable": "the log is not writable",
        "shutting_down": "the service was shutting down",
        "duplicate": "sent again; already in the log",
    },
}
"""What each reason means, in a few words for a table."""
