"""The faults of robots' traffic that `roughmap doctor` must name, and the words by which it does."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from doctor_traffic import GOOD, LEVEL, NOW, SENSORS, Drive, ground, heard_transform

S = 10**9


def diagonal(*variances: float) -> np.ndarray:
    return np.diag(np.array(variances, np.float64))


def stamped(ahead_s: Callable[[float, int], float]) -> Callable[[float, int], int]:
    """Stamps that are ahead of the time by a function of time and number."""
    return lambda t, n: NOW + round((t + ahead_s(t, n)) * S)


def leaping(t: float) -> Any:
    return (0.0 if t < 4.0 else 2.5, 0.0, 0.0), LEVEL


def turned(t: float) -> Any:
    half = 0.0 if t < 4.0 else 0.7
    return (t, 0.0, 0.0), (0.0, 0.0, math.sin(half), math.cos(half))


def jittering(t: float) -> Any:
    return (0.1 * t, 0.02 * (round(t * 400) % 2), 0.0), LEVEL


def overflowing(_: int, s: np.ndarray) -> np.ndarray:
    good = np.rint(s * 1e9)
    return np.where(np.arange(len(s)) % 5 == 0, 2**32 - 1 - np.arange(len(s)), good).astype(np.uint32)


LIDAR = SENSORS["lidar"]
NOT_DEFINITE = np.diag([0.003, 1e-4, 1e-6, 1e-6, 1e-6, 1e-4])
NOT_DEFINITE[0, 2] = NOT_DEFINITE[2, 0] = -0.0024
LOP_SIDED = GOOD.copy()
LOP_SIDED[0, 1] = 5e-5
FAR = np.random.default_rng(0).uniform(-180.0, 180.0, (9000, 3)) * [1, 1, 0] + [0, 0, -1]
EXACT = np.eye(6) * 1e-8
AHEAD = [heard_transform(k, NOW + (3600 + k) * S) for k in range(8)]
ROUND_POSES = np.concatenate([ground(), np.tile([0.05, 0.0, 0.0], (1000, 1))])


class Fault(NamedTuple):
    """A drive with a fault, and the beginning of each thing that is not well, with its verdict."""

    drive: Drive
    verdict: str
    words: str
    settings: dict[str, Any] = {}  # noqa: RUF012 - nobody changes it


FAULTS = {
    "stamps of poses are unset": Fault(
        Drive(pose_stamps=lambda t, n: 0), "wrong", "400 of 400 poses have no stamp (0): the service refuses them"),
    "stamps of clouds are unset": Fault(
        Drive(cloud_stamps=lambda t, n: 0), "wrong", "79 of 79 clouds in 'lidar' have no stamp (0): the service"),
    "stamps of poses are frozen": Fault(
        Drive(pose_stamps=lambda t, n: NOW), "wrong", "poses have one stamp again and again: up to 400 in a row"),
    "stamps of clouds are frozen": Fault(
        Drive(cloud_stamps=lambda t, n: NOW + S), "wrong", "clouds in 'lidar' have one stamp again and again"),
    "one pose in eight is an hour ahead": Fault(
        Drive(pose_stamps=stamped(lambda t, n: 3600.0 * (n % 8 == 3))), "wrong", "50 of 400 poses have wild stamps"),
    "one cloud in eight is an hour ahead": Fault(
        Drive(cloud_stamps=stamped(lambda t, n: 3600.0 * (n % 8 == 3))), "wrong",
        "10 of 79 clouds in 'lidar' have wild stamps, up to 3,600.00 s ahead of the others"),
    "one pose in eight is a year behind": Fault(
        Drive(pose_stamps=stamped(lambda t, n: -3e7 * (n % 8 == 3))), "wrong", "50 of 400 poses have wild stamps"),
    "the robot's clock goes back by 2 s": Fault(
        Drive(pose_stamps=stamped(lambda t, n: -2.0 * (t > 4))), "wrong", "stamps of poses went back by 2.00 s"),
    "the robot's clock goes back by 0.3 s": Fault(
        Drive(pose_stamps=stamped(lambda t, n: -0.3 * (t > 4))), "wrong", "stamps of poses went back by 0.30 s"),
    "the robot's clock leaps ahead": Fault(
        Drive(pose_stamps=stamped(lambda t, n: 5.0 * (t > 4))), "wrong", "stamps of poses leapt ahead by 5.00 s"),
    "two sources of poses": Fault(
        Drive(pose_stamps=stamped(lambda t, n: -0.05 * (n % 2))), "wrong", "199 of 400 poses are older than the one"),
    "two poses of each stamp": Fault(
        Drive(pose_stamps=lambda t, n: NOW + n // 2 * S // 25), "note", "200 of 400 poses have the stamp of the"),
    "clouds stamped by TAI": Fault(
        Drive(cloud_stamps=stamped(lambda t, n: 37.0)), "wrong",
        "clouds in 'lidar' are stamped 37.0 s ahead of the odometry: their clocks differ (37 s: TAI instead of UTC)"),
    "clouds stamped in another time zone": Fault(
        Drive(cloud_stamps=stamped(lambda t, n: -7200.1)), "wrong",
        "clouds in 'lidar' are stamped 7,200.0 s behind the odometry: their clocks differ (whole hours: a time zone)"),
    "clouds 12 s behind": Fault(
        Drive(cloud_stamps=stamped(lambda t, n: -12.0)), "wrong", "clouds in 'lidar' are stamped 12.0 s behind"),
    "clouds 1.5 s behind, with an offset that is set": Fault(
        Drive(cloud_stamps=stamped(lambda t, n: -4.0)), "wrong", "clouds in 'lidar' are stamped 1.50 s behind",
        {"sensors": {"lidar": {**LIDAR, "time_offset": 2.5}}}),
    "the sensor's clock moves alone": Fault(
        Drive(cloud_stamps=stamped(lambda t, n: 0.7 * (t > 4))), "wrong",
        "clouds in 'lidar' came 0.70 s sooner after their stamps than before"),
    "clouds that come later and later": Fault(
        Drive(cloud_latency=lambda n: 0.12 + 0.4 * (n > 40)), "note", "clouds in 'lidar' came 0.40 s later after"),
    "poses that come late": Fault(
        Drive(pose_latency=lambda _: 0.7), "wrong", "73 of 73 clouds in 'lidar' had no pose within"),
    "a recording": Fault(
        Drive(cloud_stamps=stamped(lambda t, n: -9e6), pose_stamps=stamped(lambda t, n: -9e6)), "note",
        "stamps are 9,000,000.0 s behind this machine's clock"),
    "a machine that is slow": Fault(
        Drive(cloud_stamps=stamped(lambda t, n: 60.0), pose_stamps=stamped(lambda t, n: 60.0)), "note",
        "stamps are 60.0 s ahead of this machine's clock"),
    "dead reckoning": Fault(
        Drive(covariance=lambda t: diagonal(0.09, 0.09, 1e-4, 1e-5, 1e-5, 1e-5)), "wrong",
        "all points are rejected as uncertain: the pose's horizontal error alone is 2 sigma = 0.60 m, "
        "map.max_horizontal_radius = 0.5"),
    "an uncertain height": Fault(
        Drive(covariance=lambda t: diagonal(1e-4, 1e-4, 0.36, 1e-5, 1e-5, 1e-5)), "wrong",
        "all points are rejected as uncertain: the pose's height error alone is 1 sigma = 0.60 m, "
        "map.max_vertical_sigma = 0.5"),
    "an uncertain heading": Fault(
        Drive(covariance=lambda t: diagonal(1e-4, 1e-4, 1e-4, 1e-5, 1e-5, 0.04)), "wrong",
        "points beyond 1.2 m are rejected as uncertain: the pose's sigma of yaw is 0.200 rad"),
    "dead reckoning that grows": Fault(
        Drive(covariance=lambda t: diagonal(*[(0.02 * (t + 3)) ** 2] * 2, 1e-4, 1e-5, 1e-5, 1e-5)), "note",
        "the pose's horizontal error (2 sigma) grows from 0.14 to 0.42 m in 7 s"),
    "wheels: 1e6 means unknown": Fault(
        Drive(covariance=lambda t: diagonal(1e-3, 1e-3, 1e6, 1e6, 1e6, 1e3)), "wrong",
        "400 of 400 poses have no estimate of z, roll, pitch and yaw"),
    "-1 means unknown": Fault(
        Drive(covariance=lambda t: diagonal(-1.0, 0, 0, 0, 0, 0)), "wrong",
        "400 of 400 poses have no estimate of x, y, z, roll, pitch and yaw"),
    "not positive semidefinite": Fault(
        Drive(covariance=lambda t: NOT_DEFINITE), "wrong", "400 of 400 poses are rejected for an invalid covariance"),
    "not symmetric": Fault(
        Drive(covariance=lambda t: LOP_SIDED), "wrong",
        "400 of 400 poses are rejected for an invalid covariance: it is not symmetric"),
    "negative": Fault(
        Drive(covariance=lambda t: -GOOD), "wrong", "400 of 400 poses are rejected for an invalid covariance"),
    "planar": Fault(
        Drive(covariance=lambda t: diagonal(1e-4, 1e-4, 0, 0, 0, 1e-4)), "note",
        "the covariance says that z, roll and pitch are exact (variance 0)"),
    "no covariance": Fault(Drive(covariance=lambda t: None), "note", "400 of 400 poses have no covariance"),
    "dead reckoning alone": Fault(
        Drive(frame="odom"), "note", "odometry in 'odom', the map's own frame, drifts", {"map": {"frame_id": "odom"}}),
    "a frame with a slash": Fault(
        Drive(frame="/map"), "wrong", "odometry in frame '/map' is rejected (pose_frame): the map's frame is 'map'"),
    "no transform": Fault(
        Drive(frame="odom"), "note", "odometry is in frame 'odom': no transform to 'map' came"),
    "another transform": Fault(
        Drive(frame="odom", transforms=[heard_transform(0.1, NOW, "vio")]), "wrong",
        "odometry in frame 'odom' is rejected (pose_frame): no transform leads to 'map'"),
    "a transform an hour ahead": Fault(
        Drive(frame="odom", transforms=AHEAD), "wrong", "the transform to 'odom' is stamped 3,592.0 s later"),
    "a static transform of today": Fault(
        Drive(frame="odom", transforms=[heard_transform(k, NOW + 99 * S) for k in range(8)]), "note",
        "the transform to 'odom' is stamped 91.0 s later than the poses"),
    "poses that leap": Fault(
        Drive(odometry_hz=10, motion=leaping), "wrong", "odometry leapt by 2.50 m within 100 ms"),
    "poses that turn at once": Fault(Drive(motion=turned), "wrong", "odometry leapt by 1.40 rad within 20 ms"),
    "poses in bursts": Fault(
        Drive(odometry_hz=16, pose_stamps=lambda t, n: NOW + n // 4 * S // 4 + n % 4 * S // 1000), "wrong",
        "odometry is stamped in bursts: about 4 poses 1.0 ms apart, then none for 0.25 s"),
    "poses that jitter": Fault(
        Drive(odometry_hz=400, motion=jittering), "wrong", "odometry in 'map' jitters by 2.0 cm from pose to pose"),
    "poses too rarely": Fault(Drive(odometry_hz=1), "wrong", "poses were up to 1.00 s apart"),
    "poses slower than scans": Fault(Drive(odometry_hz=5), "note", "odometry at 5.0 Hz is slower than clouds"),
    "no odometry": Fault(Drive(odometry=False), "wrong", "no odometry: its clouds can't be placed"),
    "an unknown sensor": Fault(
        Drive(cloud_frame="os.lidar"), "wrong", "clouds in frame 'os.lidar' are refused", {"sensors": {}}),
    "a sensor with a slash": Fault(
        Drive(cloud_frame="/lidar"), "wrong", "clouds in frame '/lidar' are refused"),
    "no-returns moved off zero": Fault(
        Drive(points=ROUND_POSES), "note", "1,000 of 1,400 points of a cloud in 'lidar' are equal, (0.05, 0, 0)"),
    "nothing came back": Fault(Drive(points=np.zeros((50, 3))), "wrong", "all points in clouds in 'lidar' are NaN or"),
    "no points": Fault(Drive(points=np.zeros((0, 3))), "wrong", "clouds in 'lidar' have no points"),
    "millimetres": Fault(Drive(points=ground() * 1000.0), "wrong", "points in clouds in 'lidar' are 3,"),
    "all too near": Fault(
        Drive(points=ground() * 0.02), "wrong", "points in clouds in 'lidar' are 0.07 m away (median)"),
    "small cells and far points": Fault(
        Drive(points=FAR, covariance=lambda t: EXACT), "wrong", "a cloud in 'lidar' reaches 254 m and touches 8,4",
        {"map": {"cell_size": 0.02}}),
    "points without times": Fault(
        Drive(time_field="intensity"), "note", "clouds in 'lidar' have no per-point times: none of the fields t, time, "
        "timestamp, offset_time, time_stamp, ts, but intensity"),
    "points of one time": Fault(
        Drive(point_times=lambda _, s: np.zeros(len(s), np.uint32)), "note",
        "clouds in 'lidar' have no per-point times: t is the same for all points"),
    "times from 0 to 1": Fault(
        Drive(point_times=lambda _, s: (s / 0.0999).astype(np.float32)), "wrong",
        "it is unclear how the times of points in 'lidar' are meant: t (float32) from 0 to 1"),
    "times from 0 to 1 taken for seconds": Fault(
        Drive(point_times=lambda _, s: (s / 0.0999).astype(np.float32)), "wrong",
        "points in 'lidar' have times: t (float32) in s from the sweep's start, over 1.0000 s, but clouds are 0.1 s",
        {"sensors": {"lidar": {**LIDAR, "time_field": "t", "time_unit": "s", "time_origin": "start"}}}),
    "times in a unit that is not the configured one": Fault(
        Drive(point_times=lambda _, s: np.rint(s * 1e6).astype(np.uint32)), "wrong",
        "times of points in 'lidar' are read as t (uint32) in ms from the sweep's start, which they are not",
        {"sensors": {"lidar": {**LIDAR, "time_field": "t", "time_unit": "ms", "time_origin": "start"}}}),
    "times in a field that is not there": Fault(
        Drive(), "wrong", "it is unclear how the times of points in 'lidar' are meant: no field time, but",
        {"sensors": {"lidar": {**LIDAR, "time_field": "time"}}}),
    "times that overflow": Fault(
        Drive(point_times=overflowing), "note", "20 % of the points in 'lidar' have no valid time"),
}  # fmt: skip

TOGETHER = {
    "a sensor with a slash": ["no cloud of sensor lidar"],
    "millimetres": ["points beyond", "a cloud in"],
    "poses too rarely": ["odometry at 1.0 Hz is slower", "28 of 70 clouds in 'lidar' had no pose"],
    "times from 0 to 1 taken for seconds": ["clouds in 'lidar' come", "70 of 70 clouds in 'lidar' had no pose"],
    "poses that come late": ["clouds in 'lidar' come 0.68 s sooner than poses of the same stamp"],
}
"""Faults that are seen in more than one way."""
