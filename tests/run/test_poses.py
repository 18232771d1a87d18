"""Numbers and stamps at the ends of what messages may hold: they are refused or decided, and never raise."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from service_tools import LEVEL, SECOND, T0

from roughmap_schemas import PoseReason, decode_odometry, decode_transform, encode_odometry, encode_transform
from roughmap_service.run.poses import Pose, PoseBuffer, too_far_apart, too_fast, trajectory

LARGEST = 1.7e308
"""Twice that is no float64 number."""

LAST_NS = 2**32 * SECOND - 1
"""The last stamp that there is."""

EIGHTH = (0.0, 0.0, math.sin(math.pi / 8), math.cos(math.pi / 8))


def heard(
    buffer: PoseBuffer, number: int, stamp_ns: int, x: float = 0.0, covariance: np.ndarray | None = None
) -> PoseReason | None:
    """An odometry in the frame "odom", as it comes from the network; why it was not taken."""
    payload = encode_odometry(stamp_ns, "odom", (x, 0.0, 0.0), LEVEL, covariance)
    return buffer.add(decode_odometry(payload, max_message=1 << 16), number)[0]


def moved(
    buffer: PoseBuffer, number: int, stamp_ns: int, x: float = 0.0, rotation: tuple[float, float, float, float] = LEVEL
) -> None:
    """A transform of the frame "odom"."""
    payload = encode_transform(stamp_ns, "map", "odom", (x, 0.0, 0.0), rotation)
    assert buffer.add_transform(decode_transform(payload, max_message=1 << 16), number) is None


@pytest.fixture
def buffer() -> PoseBuffer:
    return PoseBuffer("map", 10 * SECOND, jump_m=0.15, jump_rad=0.03)


def test_a_position_that_overflows_lies_in_no_frame(buffer: PoseBuffer) -> None:
    moved(buffer, 1, T0, LARGEST)
    assert heard(buffer, 2, T0, LARGEST) is PoseReason.POSE_FRAME
    assert heard(buffer, 3, T0, -LARGEST) is None
    assert trajectory(buffer.poses, np.eye(6)).position.tolist() == [[0.0, 0.0, 0.0]]


def test_a_covariance_that_overflows_is_bad(buffer: PoseBuffer) -> None:
    """All its numbers are finite; in the map's axes they add up."""
    moved(buffer, 1, T0, rotation=EIGHTH)
    assert heard(buffer, 2, T0, covariance=np.full((6, 6), LARGEST)) is PoseReason.BAD_COVARIANCE
    assert buffer.poses == []
    assert heard(buffer, 3, T0, covariance=np.eye(6) * LARGEST) is None
    assert np.isfinite(trajectory(buffer.poses, np.eye(6)).covariance).all()


def test_jumps_over_distances_beyond_all_numbers(buffer: PoseBuffer) -> None:
    moved(buffer, 1, T0, LARGEST)
    moved(buffer, 2, T0 + 1, -LARGEST)
    moved(buffer, 3, T0 + 2, -LARGEST, tuple(Rotation.from_rotvec([0.0, 0.0, 0.029]).as_quat()))
    assert buffer.jumps == 1


def test_after_a_clock_set_back_new_transforms_are_kept(buffer: PoseBuffer) -> None:
    """By stamp they would always be the oldest, and the robot without a frame for as long as it drives."""
    buffer.max_transforms = 4
    for number in range(1, 5):
        moved(buffer, number, T0 + 100 * SECOND + number)
    for number in range(5, 12):
        moved(buffer, number, T0 + number)
        assert heard(buffer, 100 + number, T0 + number) is None
    assert [pose.transform for pose in buffer.poses] == [5, 6, 7, 8, 9, 10, 11]


def pose(stamp_ns: int, x: float = 0.0, yaw: float = 0.0) -> Pose:
    return Pose(stamp_ns, (x, 0.0, 0.0), (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)), None, 1, 0)


@pytest.mark.parametrize("apart", [1, 7, SECOND // 100, SECOND, 10**6 * SECOND])
def test_the_largest_speed_over_any_time(apart: int) -> None:
    """1e-12 of it is a thousand times what rounding can do."""
    row = [pose(T0), pose(T0 + apart, 30.0 * apart * 1e-9)]
    assert not too_fast(row, 30.0 * (1 + 1e-12), 20.0)
    assert too_fast(row, 30.0 * (1 - 1e-12), 20.0)


@pytest.mark.parametrize(("first", "last"), [(0, LAST_NS), (LAST_NS - 1, LAST_NS), (T0, T0 + 1)])
def test_places_as_far_apart_as_can_be(first: int, last: int) -> None:
    assert too_fast([pose(first, -LARGEST), pose(last, LARGEST)], 30.0, 20.0)
    assert not too_fast([pose(first, LARGEST, 1.0), pose(last, LARGEST, 1.0)], 1e-9, 1e-9)
    # The far corners of a map of 2^31 cells, a nanosecond apart, and that is the largest speed of all numbers.
    assert not too_fast([pose(first, -1e9), pose(last, 1e9)], LARGEST, 20.0)


@pytest.mark.parametrize(("first", "last"), [(0, LAST_NS), (LAST_NS - 1, LAST_NS), (T0, T0 + 1)])
def test_gaps_of_any_length_count_to_the_nanosecond(first: int, last: int) -> None:
    row = [pose(first), pose(last)]
    assert too_far_apart(row, last - first - 1)
    assert not too_far_apart(row, last - first)
    assert not too_far_apart(row, math.inf)
    assert not too_far_apart(row[:1], 0.0)
