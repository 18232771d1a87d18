"""All kinds of faults that a walk tries."""

from random import Random

import cloud_faults
import pose_faults
import time_faults
import walks_paths  # noqa: F401 - before what it makes importable
from walk_fault import Fault, FaultKind, Names
from walker import SENSORS


def none(random: Random) -> Fault:
    return Fault(lambda m: [m], Names())


FAULTS: dict[str, FaultKind] = {
    "clock_back": FaultKind("a robot's clock steps back", time_faults.clock_back, "meanwhile", costs="sensors"),
    "clock_forward": FaultKind(
        "a robot's clock steps forward", time_faults.clock_forward, "meanwhile", costs="sensors"
    ),
    "stamps_unset": FaultKind("stamps are not set", time_faults.stamps_unset, costs="sensors"),
    "odometry_frozen": FaultKind("odometry has one stamp", time_faults.odometry_frozen, costs="sensors"),
    "bursts": FaultKind("odometry is stamped in bursts", time_faults.bursts),
    "cloud_frozen": FaultKind("a sensor's clouds have one stamp", time_faults.cloud_frozen),
    "wild_stamps": FaultKind("wild stamps of poses", time_faults.wild_stamps),
    "two_sources": FaultKind("two sources of odometry out of step", time_faults.two_sources),
    "sensor_ahead": FaultKind("a sensor's clock 37 s ahead", time_faults.sensor_ahead, "first"),
    "sensor_behind": FaultKind("a sensor's clock 12 s behind", time_faults.sensor_behind, "first"),
    "sensor_moves": FaultKind("a sensor's clock moves a little alone", time_faults.sensor_moves, "meanwhile"),
    "sensor_leaps": FaultKind("a sensor's clock leaps alone", time_faults.sensor_leaps, "meanwhile"),
    "leap": FaultKind("a localisation leaps once", pose_faults.leap, "meanwhile"),
    "leaps": FaultKind("a localisation leaps again and again", pose_faults.leaps, timed=True, costs="sensors"),
    "restart": FaultKind("a localisation restarts at the origin", pose_faults.restarts_at_origin, "meanwhile"),
    "no_odometry": FaultKind("odometry ends", pose_faults.no_odometry, costs="sensors"),
    "never_odometry": FaultKind("odometry never comes", pose_faults.never_odometry, "first", costs="sensors"),
    "odometry_slow": FaultKind("odometry is too slow", pose_faults.odometry_slow, costs="sensors"),
    "frame_slash": FaultKind("odometry in /map", pose_faults.frame_slash, costs="sensors"),
    "no_transform": FaultKind("a transform is missing", pose_faults.no_transform, costs="sensors"),
    "covariance_wide": FaultKind("covariance too large along x and y", pose_faults.covariance_wide, costs="sensors"),
    "covariance_high": FaultKind("covariance too large along z", pose_faults.covariance_high, costs="sensors"),
    "covariance_not_psd": FaultKind(
        "covariance is not positive semidefinite", pose_faults.covariance_not_psd, costs="sensors"
    ),
    "covariance_unknown": FaultKind("covariance is not estimated", pose_faults.covariance_unknown),
    "times_unclear": FaultKind("points' times from 0 to 1", cloud_faults.times_unclear),
    "times_change": FaultKind("points' times take another form", cloud_faults.times_change, timed=True),
    "unknown_frame": FaultKind("a sensor's frame is not configured", cloud_faults.unknown_frame, ends=False),
    "equal_points": FaultKind("a thousand equal points", cloud_faults.equal_points),
    "too_many_tiles": FaultKind("cells too small for the range", cloud_faults.too_many_tiles),
    "millimetres": FaultKind(
        "points in millimetres, beyond max_range", cloud_faults.millimetres,
        settings={"sensors": {frame: {"max_range": 100.0} for frame in SENSORS}},
    ),
    "excluded": FaultKind(
        "all points within exclude", cloud_faults.excluded,
        settings={"sensors": {frame: {"exclude": [[-2.0, -2.0, -1.0, 2.0, 2.0, 3.0]]} for frame in SENSORS}},
    ),
    "losses": FaultKind("numbered messages are lost on the way", cloud_faults.losses),
    "none": FaultKind("nothing is wrong", none),
}  # fmt: skip
"""By name, which is the robot's too."""
