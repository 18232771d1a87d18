"""Numbers and stamps at the ends of what messages may hold: they are refused or decided, and never raise."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from service_tools import LEVEL, SECOND, T0, config

from roughmap_schemas import PoseReason, decode_odometry, decode_transform, encode_odometry, encode_transform
from roughmap_service.run.leaps import Leap, find_leap
from roughmap_service.run.odometry_clock import Verdict
from roughmap_service.run.poses import Pose, too_far_apart, trajectory
from roughmap_service.run.robot import OdometryTaken, Robot
from roughmap_service.run.settings import Settings

LARGEST = 1.7e308
"""Twice that is no float64 number."""

LAST_NS = 2**32 * SECOND - 1
"""The last stamp that there is."""

EIGHTH = (0.0, 0.0, math.sin(math.pi / 8), math.cos(math.pi / 8))


def heard(
    robot: Robot, number: int, stamp_ns: int, x: float = 0.0, covariance: np.ndarray | None = None
) -> OdometryTaken:
    """An odometry in the frame "odom", as it comes from the network."""
    payload = encode_odometry(stamp_ns, "odom", (x, 0.0, 0.0), LEVEL, covariance)
    return robot.take_odometry(decode_odometry(payload, max_message=1 << 16), number, stamp_ns)


def moved(
    robot: Robot, number: int, stamp_ns: int, x: float = 0.0, rotation: tuple[float, float, float, float] = LEVEL
) -> bool:
    """A transform of the frame "odom"; whether it jumped."""
    payload = encode_transform(stamp_ns, "map", "odom", (x, 0.0, 0.0), rotation)
    reason, jumped = robot.add_transform(decode_transform(payload, max_message=1 << 16), number)
    assert reason is None
    return jumped


@pytest.fixture
def robot() -> Robot:
    return Robot(Settings(config(), max_transforms=4), "rover")


def test_a_position_that_overflows_lies_in_no_frame(robot: Robot) -> None:
    moved(robot, 1, T0, LARGEST)
    assert heard(robot, 2, T0, LARGEST).settled == [PoseReason.POSE_FRAME]
    assert heard(robot, 3, T0 + 1, -LARGEST).settled == [None]
    assert trajectory(robot.buffer.poses, np.eye(6)).position.tolist() == [[0.0, 0.0, 0.0]]


def test_a_covariance_of_numbers_without_end_is_not_estimated(robot: Robot) -> None:
    """All its numbers are finite; turned into the map's axes they would add up to more than there are."""
    moved(robot, 1, T0, rotation=EIGHTH)
    for number, covariance in enumerate([np.full((6, 6), LARGEST), np.eye(6) * LARGEST], 2):
        taken = heard(robot, number, T0 + number, covariance=covariance)
        assert (taken.settled, taken.unestimated) == ([None], True)
    for pose in robot.buffer.poses:
        assert pose.covariance is not None
        # Turned by an eighth, equal variances stay what they are but for rounding.
        np.testing.assert_allclose(pose.covariance, robot.settings.pose_covariance, atol=1e-17)


def test_the_largest_sigma_of_the_configuration_is_a_covariance(robot: Robot) -> None:
    robot.use(Settings(config(input={"pose_sigma": [LARGEST] * 6}, robots={"rover": {"pose_covariance": "floor"}})))
    moved(robot, 1, T0, rotation=EIGHTH)
    assert heard(robot, 2, T0, covariance=np.eye(6)).settled == [None]
    assert np.isfinite(trajectory(robot.buffer.poses, np.eye(6)).covariance).all()


def test_a_covariance_that_overflows_is_bad_by_the_rules_of_version_1() -> None:
    """They take all finite numbers; in the map's axes these add up."""
    robot = Robot(Settings(config(), rules=1), "rover")
    moved(robot, 1, T0, rotation=EIGHTH)
    assert heard(robot, 2, T0, covariance=np.full((6, 6), LARGEST)).settled == [PoseReason.BAD_COVARIANCE]
    assert robot.buffer.poses == []
    assert heard(robot, 3, T0, covariance=np.eye(6) * LARGEST).settled == [None]
    assert np.isfinite(trajectory(robot.buffer.poses, np.eye(6)).covariance).all()


def test_jumps_over_distances_beyond_all_numbers(robot: Robot) -> None:
    assert not moved(robot, 1, T0, LARGEST)
    assert moved(robot, 2, T0 + 1, -LARGEST)
    assert not moved(robot, 3, T0 + 2, -LARGEST, tuple(Rotation.from_rotvec([0.0, 0.0, 0.029]).as_quat()))


def test_after_a_clock_set_back_new_transforms_are_kept(robot: Robot) -> None:
    """By stamp they would always be the oldest, and the robot without a frame for as long as it drives."""
    for number in range(1, 5):
        moved(robot, number, T0 + 100 * SECOND + number)
    heard(robot, 5, T0 + 100 * SECOND)
    settled = []
    for number in range(6, 14):
        moved(robot, number, T0 + number)
        settled += heard(robot, 100 + number, T0 + number).settled
    assert settled == [None] * 8
    assert [pose.transform for pose in robot.buffer.poses] == list(range(6, 14))


def pose(stamp_ns: int, x: float = 0.0, yaw: float = 0.0) -> Pose:
    return Pose(stamp_ns, (x, 0.0, 0.0), (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)), None, 1, 0)


def leap(row: list[Pose], max_leap: float, max_acceleration: float, max_speed: float) -> Leap | None:
    """The leap to the last pose of a row."""
    return find_leap(row, len(row) - 1, max_leap, max_acceleration, max_speed)


@pytest.mark.parametrize("apart", [SECOND // 100, SECOND, 10**6 * SECOND])
def test_the_largest_speed_over_any_time(apart: int) -> None:
    """1e-12 of it is a thousand times what rounding can do."""
    row = [pose(T0), pose(T0 + apart, 30.0 * apart * 1e-9)]
    assert leap(row, 0.01, 20.0, 30.0 * (1 + 1e-12)) is None
    assert leap(row, 0.01, 20.0, 30.0 * (1 - 1e-12)) is not None


@pytest.mark.parametrize("apart", [1, 7, SECOND // 1000])
def test_any_speed_over_less_than_the_largest_leap(apart: int) -> None:
    """Two poses shortly after each other differ by their noise, whatever speed that is."""
    assert leap([pose(T0), pose(T0 + apart, 0.3)], 0.3, 20.0, 30.0) is None
    assert leap([pose(T0), pose(T0 + apart, 0.3 + 1e-9)], 0.3, 20.0, 30.0) is not None


@pytest.mark.parametrize(("first", "last"), [(0, LAST_NS), (LAST_NS - 1, LAST_NS), (T0, T0 + 1)])
@pytest.mark.parametrize("before", [0, 2])
def test_places_as_far_apart_as_can_be(first: int, last: int, before: int) -> None:
    """Also where the motion before is one of no number of metres."""
    rest = [pose(first - (2 - k) * SECOND, (LARGEST, -LARGEST)[k]) for k in range(before)]
    found = leap([*rest, pose(first, -LARGEST), pose(last, LARGEST)], 0.3, 20.0, 30.0)
    assert found is not None
    still = [pose(first, LARGEST, 1.0), pose(last, LARGEST, 1.0)]
    assert leap(still, LARGEST, LARGEST, LARGEST) is None
    leap([*rest, *still], LARGEST, LARGEST, LARGEST)


@pytest.mark.parametrize("x", [LARGEST, -LARGEST])
def test_a_robot_that_leaps_beyond_all_numbers_is_heard(robot: Robot, x: float) -> None:
    """A leap's figures may be infinite; nothing raises, and what comes after it counts."""
    moved(robot, 1, 0)
    for k in range(6):
        assert heard(robot, 2 + k, T0 + k * SECOND // 10, (x, -x, 0.0)[k % 3]).verdict is Verdict.TAKE
    assert [p.leapt for p in robot.buffer.poses] == [False] + [True] * 5


@pytest.mark.parametrize(("first", "last"), [(0, LAST_NS), (LAST_NS - 1, LAST_NS), (T0, T0 + 1)])
def test_gaps_of_any_length_count_to_the_nanosecond(first: int, last: int) -> None:
    row = [pose(first), pose(last)]
    assert too_far_apart(row, last - first - 1)
    assert not too_far_apart(row, last - first)
    assert not too_far_apart(row, math.inf)
    assert not too_far_apart(row[:1], 0.0)
