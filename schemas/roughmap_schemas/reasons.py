"""All reasons and codes: of refused messages, rejected clouds, poses and points, and error replies."""

from enum import StrEnum
from typing import Final


class PointReason(StrEnum):
    """Why a point of an integrated cloud was rejected; counted under the first that applies, in this order."""

    NOT_FINITE = "not_finite"
    NO_RETURN = "no_return"
    DUPLICATE_RETURN = "duplicate_return"
    TIME = "time"
    NO_POSE = "no_pose"
    SELF = "self"
    RANGE = "range"
    CEILING = "ceiling"
    COVARIANCE = "covariance"
    UNCERTAIN = "uncertain"
    BOUNDS = "bounds"


class CloudReason(StrEnum):
    """Why a logged cloud was rejected; the outcome of its event."""

    POSE_GAP = "pose_gap"
    POSE_JUMP = "pose_jump"
    NO_POSE = "no_pose"
    LATE = "late"
    TOO_MANY_TILES = "too_many_tiles"
    EMPTY = "empty"
    OVERLOAD = "overload"
    CLOCK_RESET = "clock_reset"
    CLOCK_OFFSET = "clock_offset"
    TIME_FORM = "time_form"
    NO_EXTRINSICS = "no_extrinsics"


class PoseReason(StrEnum):
    """Why a logged pose or transform was rejected."""

    DUPLICATE = "duplicate"
    STALE = "stale"
    AHEAD = "ahead"
    OUT_OF_ORDER = "out_of_order"
    FROZEN = "frozen"
    POSE_FRAME = "pose_frame"
    BAD_COVARIANCE = "bad_covariance"


class Refusal(StrEnum):
    """Why a message was refused: it never reached the log.

    ``duplicate`` is never an error reply. A published message that is already in the log is only counted; an ingested
    one gets the receipt of the first.
    """

    BAD_KEY = "bad_key"
    BAD_ENCODING = "bad_encoding"
    BAD_MESSAGE = "bad_message"
    TOO_LARGE = "too_large"
    UNKNOWN_SENSOR = "unknown_sensor"
    UNKNOWN_ROBOT = "unknown_robot"
    UNSET_STAMP = "unset_stamp"
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
"""The outcome of a cloud that is in the map; any other outcome is a ``CloudReason``."""

Reason = PointReason | CloudReason | PoseReason | Refusal
"""Every reason under which a message, pose, cloud or point is counted."""

MEANING: Final[dict[type[Reason], dict[str, str]]] = {
    PointReason: {
        "not_finite": "NaN or infinite",
        "no_return": "no echo, as from the sky",
        "duplicate_return": "one of hundreds of equal points: no echo, moved off zero",
        "time": "no valid time, or more than 1 s from the cloud's stamp or its first point",
        "no_pose": "no poses around its time",
        "self": "on the robot itself (sensors.*.exclude)",
        "range": "nearer than min_range or farther than max_range",
        "ceiling": "higher above the sensor than ceiling",
        "covariance": "invalid covariance",
        "uncertain": "error over max_horizontal_radius or max_vertical_sigma",
        "bounds": "outside map.bounds",
    },
    CloudReason: {
        "pose_gap": "neighbouring poses more than max_pose_gap apart",
        "pose_jump": "the robot's pose leapt within its time",
        "no_pose": "no poses around it within max_wait",
        "late": "older than the poses kept (pose_history)",
        "too_many_tiles": "needs more tiles than max_new_tiles or max_tiles allow",
        "empty": "no point was accepted",
        "overload": "dropped: more input than can be integrated",
        "clock_reset": "the robot's clock was set back",
        "clock_offset": "the sensor's clock differs from the robot's",
        "time_form": "the meaning of its points' times is unclear",
        "no_extrinsics": "the sensor's mounting has not come yet",
    },
    PoseReason: {
        "duplicate": "a second pose with the same stamp",
        "stale": "older than the poses kept (pose_history)",
        "ahead": "one stamp far ahead of all others",
        "out_of_order": "older than the pose before it",
        "frozen": "one stamp again and again",
        "pose_frame": "no transform from its frame to the map's",
        "bad_covariance": "invalid covariance",
    },
    Refusal: {
        "bad_key": "not the key of a robot",
        "bad_encoding": "wrong encoding for its key",
        "bad_message": "not a valid message",
        "too_large": "over max_message bytes or max_points",
        "unknown_sensor": "its frame has no [sensors] table",
        "unknown_robot": "not in input.robots, or over max_robots",
        "unset_stamp": "its stamp is 0, which means not set",
        "busy": "the input queue was full",
        "log_unavailable": "the log can't be written",
        "shutting_down": "the service was ending",
        "duplicate": "sent before; already in the log",
    },
}
"""A few words on each reason, for a table. ``schemas/README.md`` has the full definitions."""
