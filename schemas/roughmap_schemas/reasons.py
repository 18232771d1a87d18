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
        "no_return": "nothing came back, as from the sky",
        "time": "its own time is not within a second after its scan's",
        "no_pose": "no poses around its own time",
        "self": "on the robot itself (sensors.*.exclude)",
        "range": "nearer than min_range, or beyond max_range",
        "ceiling": "higher above the scanner than ceiling",
        "covariance": "its covariance is none",
        "uncertain": "could lie beyond max_horizontal_radius",
        "bounds": "outside map.bounds",
    },
    CloudReason: {
        "pose_gap": "poses around it farther apart than max_pose_gap",
        "pose_jump": "poses around it imply more than max_speed, max_turn",
        "no_pose": "poses around it did not come within max_wait",
        "late": "older than the poses that are kept (pose_history)",
        "too_many_tiles": "more new tiles than max_new_tiles, max_tiles",
        "empty": "no point of it was accepted",
        "overload": "dropped: more comes in than can be integrated",
        "clock_reset": "its robot's clock was set back",
    },
    PoseReason: {
        "duplicate": "a second pose of one stamp",
        "stale": "older than the poses that are kept (pose_history)",
        "pose_frame": "no transform leads from its frame to the map's",
        "bad_covariance": "its covariance is none",
    },
    Refusal: {
        "bad_key": "a key that no robot has",
        "bad_encoding": "another encoding than its key's",
        "bad_message": "can't be read",
        "too_large": "more than max_message bytes, or max_points",
        "unknown_sensor": "its frame has no [sensors] table",
        "unknown_robot": "not among input.robots, or one too many",
        "busy": "the queue was full",
        "log_unavailable": "the log can't be written",
        "shutting_down": "the service was ending",
        "duplicate": "sent again; the log has it",
    },
}
"""What each reason says, in a few words for a table; the contract's own words stand in the classes above."""
