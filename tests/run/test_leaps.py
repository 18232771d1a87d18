"""Leaps of poses: what no motion explains, at any rate of odometry and any speed of a vehicle."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from properties import examples
from service_tools import LEVEL, PRECISE, SECOND, T0, config

from roughmap_schemas import Odometry
from roughmap_service.run.leaps import LOOKED_AT, MAX_TURN_ACCELERATION, MAX_TURN_LEAP, find_leap, motion_before
from roughmap_service.run.poses import Pose
from roughmap_service.run.robot import Robot
from roughmap_service.run.settings import Settings

MAX_LEAP, MAX_ACCELERATION, MAX_SPEED = 0.3, 20.0, 30.0
"""The settings' defaults: m, m/s^2, m/s."""

Row = Sequence[tuple[float, float]]
"""Times in s and places along x in m."""


def heard(row: Row, yaws: Sequence[float] | None = None) -> Robot:
    """A robot that was told these poses."""
    robot = Robot(Settings(config()), "rover")
    for number, (t, x) in enumerate(row, 1):
        yaw = 0.0 if yaws is None else yaws[number - 1]
        rotation = (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
        message = Odometry(T0 + round(t * SECOND), "map", "base", (x, 0.0, 0.0), rotation, PRECISE)
        robot.take_odometry(message, number, message.stamp_ns)
    return robot


def leaps(row: Row, yaws: Sequence[float] | None = None) -> list[int]:
    """Which of the poses leapt, counted from 0. All are taken."""
    poses = heard(row, yaws).buffer.poses
    assert len(poses) == len(row)
    return [k for k, pose in enumerate(poses) if pose.leapt]


def steady(speed: float, hz: float = 20.0, seconds: float = 2.0, first: float = 0.0) -> list[tuple[float, float]]:
    return [(first + k / hz, speed * k / hz) for k in range(round(seconds * hz))]


def test_a_burst_is_no_leap() -> None:
    """7 cm in 1 ms: two poses of one moment by the robot's noise, or by a queue that stamps as it sends."""
    row = [*steady(0.0), (1.951, 0.07), (1.952, 0.0), (2.0, 0.05)]
    assert leaps(row) == []


def test_bursts_all_the_way_are_no_leaps() -> None:
    """Poses come in fours, 1 ms apart, at 1 m/s and 10 Hz: stamped as they were sent."""
    row = [(0.1 * k + 0.001 * n, 0.1 * k + 0.025 * n) for k in range(30) for n in range(4)]
    assert leaps(row) == []


def test_a_relocalisation_from_standing_is_a_leap() -> None:
    """2.5 m in 0.1 s are 25 m/s, which is less than the largest speed; but the robot stood."""
    row = [*steady(0.0, hz=10.0), *((2.0 + 0.1 * k, 2.5) for k in range(10))]
    assert leaps(row) == [20]


def test_a_restart_at_the_origin_is_a_leap() -> None:
    """A localisation that begins anew, while the robot drives on."""
    row = [*steady(1.5), *((2.0 + 0.05 * k, 0.075 * k) for k in range(20))]
    assert leaps(row) == [40]


def test_a_restart_after_a_gap_is_a_leap() -> None:
    row = [*steady(1.5), *((2.4 + 0.05 * k, 50.0 + 0.075 * k) for k in range(20))]
    poses = heard(row).buffer.poses
    assert [round((p.stamp_ns - T0) / SECOND, 2) for p in poses if p.leapt] == [2.4]


@pytest.mark.parametrize("hz", [5.0, 10.0, 50.0, 100.0, 400.0])
def test_noise_of_5_cm_is_no_leap(hz: float) -> None:
    """The velocity is that of 0.1 s and more, so noise does not make a speed of it, whatever the rate."""
    noise = np.random.default_rng(round(hz)).uniform(-0.05, 0.05, round(2 * hz))
    row = [(t, x + d) for (t, x), d in zip(steady(1.0, hz), noise, strict=True)]
    assert leaps(row) == []


@pytest.mark.parametrize("hz", [10.0, 100.0])
@pytest.mark.parametrize("speed", [10.0, 25.0, -25.0, 29.0])
def test_a_fast_vehicle_s_start_is_no_leap(speed: float, hz: float) -> None:
    """At first there is no velocity to go by."""
    assert leaps(steady(speed, hz)) == []


def test_faster_than_the_largest_speed_is_a_leap_from_the_start() -> None:
    assert leaps([(0.0, 0.0), (0.1, 3.1)]) == [1]
    assert leaps([(0.0, 0.0), (0.1, 2.9)]) == []
    assert leaps([(0.0, 0.0), (0.001, 0.29)]) == [], "too short a way to tell a speed from"


def test_faster_than_the_largest_speed_is_a_leap_again_and_again() -> None:
    row = steady(40.0, hz=10.0, seconds=1.0)
    assert leaps(row) == list(range(1, 10))


@pytest.mark.parametrize("hz", [10.0, 50.0])
def test_braking_and_starting_as_hard_as_may_be_is_no_leap(hz: float) -> None:
    """20 m/s^2 is twice what tyres can do. The velocity is half of 0.1 s old: on top of the limits' square that is
    acceleration x 0.05 s x dt, which `max_leap` has room for."""
    times = np.arange(0.0, 4.0, 1.0 / hz)
    speeds = np.interp(times, [0.0, 1.0, 2.0, 3.0, 4.0], [0.0, 20.0, 20.0, 0.0, 0.0])
    places = np.concatenate([[0.0], np.cumsum(speeds)[:-1] / hz])
    assert leaps(list(zip(times, places, strict=True))) == []


def test_what_comes_after_a_leap_is_judged_by_what_was_before_it() -> None:
    """Until there is 0.1 s of motion since: a second leap right behind the first is one, too."""
    row = [*steady(1.0), (2.0, 7.0), (2.05, 7.05), (2.1, 12.0), (2.15, 12.05), (2.2, 12.1), (2.25, 12.15)]
    assert leaps(row) == [40, 42]


def test_one_wild_pose_is_two_leaps() -> None:
    row = [*steady(1.0), (2.0, 7.0), (2.05, 2.05), (2.1, 2.1)]
    assert leaps(row) == [40, 41]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_turns_leap_too(sign: float) -> None:
    """From standing in 0.1 s: 0.3 rad and 50 rad/s^2 are 0.55 rad."""
    row = [(0.1 * k, 0.0) for k in range(10)]
    assert leaps(row, [0.0] * 5 + [sign * 0.54] * 5) == []
    assert leaps(row, [0.0] * 5 + [sign * 0.56] * 5) == [5]


def test_a_steady_turn_is_no_leap() -> None:
    """Through more than whole turns, and where the quaternion changes its sign."""
    row = [(0.1 * k, 0.0) for k in range(60)]
    assert leaps(row, [0.9 * k for k in range(60)]) == []


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_quaternion_and_its_negative_are_one_rotation(sign: float) -> None:
    turned = tuple(sign * v for v in LEVEL)
    poses = [Pose(T0 + k * SECOND // 10, (0.0, 0.0, 0.0), LEVEL, None, k, 0) for k in range(5)]
    poses.append(Pose(T0 + SECOND // 2, (0.0, 0.0, 0.0), turned, None, 5, 0))  # type: ignore[arg-type]
    assert find_leap(poses, 5, MAX_LEAP, MAX_ACCELERATION, MAX_SPEED) is None


def test_a_leap_tells_its_figures() -> None:
    row = [*steady(2.0, hz=10.0), (2.0, 9.0)]
    poses = heard(row).buffer.poses
    leap = find_leap(poses, 20, MAX_LEAP, MAX_ACCELERATION, MAX_SPEED)
    assert leap is not None
    assert leap.metres == pytest.approx(5.0), "from where the motion led, which is 4.0"
    assert leap.seconds == pytest.approx(0.1)


def test_the_motion_is_that_of_a_tenth_of_a_second_without_a_leap() -> None:
    poses = heard([*steady(1.0), (2.0, 7.0), (2.05, 7.2)]).buffer.poses
    motion = motion_before(poses, 42)
    assert motion is not None
    assert motion.velocity == pytest.approx((1.0, 0.0, 0.0)), "that before the leap"
    assert motion_before(poses, 2) is None, "0.05 s are too short"
    assert motion_before(poses, 0) is None
    motion = motion_before(poses, 3)
    assert motion is not None
    assert motion.velocity == pytest.approx((1.0, 0.0, 0.0))


def test_an_insertion_judges_itself_and_its_follower() -> None:
    """Of two sources, one is late: a pose between two others may show that both steps are leaps, or that none is."""
    row = [*steady(0.0), (2.0, 5.0)]
    robot = heard(row)
    robot.clock.two_sources = True
    message = Odometry(T0 + round(1.975 * SECOND), "map", "base", (5.0, 0.0, 0.0), LEVEL, PRECISE)
    robot.take_odometry(message, 50, message.stamp_ns)
    after = Odometry(T0 + round(2.05 * SECOND), "map", "base", (5.0, 0.0, 0.0), LEVEL, PRECISE)
    robot.take_odometry(after, 51, after.stamp_ns)
    assert [(p.input, p.leapt) for p in robot.buffer.poses][-4:] == [
        (40, False), (50, True), (41, False), (51, False)]  # fmt: skip


walks = st.tuples(
    st.lists(st.floats(-8.0, 8.0), min_size=2, max_size=12),  # accelerations in m/s^2, each for half a second
    st.floats(-15.0, 15.0),  # the first speed
    st.floats(5.0, 200.0),  # Hz
    st.floats(0.0, 0.02),  # noise in m
    st.integers(0, 2**32 - 1),
)


def walk(accelerations: Sequence[float], speed: float, hz: float, noise: float, seed: int) -> list[tuple[float, float]]:
    """A way of bounded acceleration, and speeds below the largest."""
    fine = np.arange(0.0, 0.5 * len(accelerations), 1e-3)
    a = np.asarray(accelerations)[np.minimum((fine / 0.5).astype(int), len(accelerations) - 1)]
    v = speed + np.concatenate([[0.0], np.cumsum(a[:-1]) * 1e-3])
    assume(np.abs(v).max() < MAX_SPEED - 3.0)  # noise and the step over which it is taken
    x = np.concatenate([[0.0], np.cumsum(v[:-1]) * 1e-3])
    times = np.arange(0.0, fine[-1], 1.0 / hz)
    places = np.interp(times, fine, x) + np.random.default_rng(seed).uniform(-noise, noise, len(times))
    return list(zip(times.tolist(), places.tolist(), strict=True))


@examples(150)
@given(walks)
def test_a_motion_of_bounded_acceleration_never_leaps(given_walk: tuple) -> None:
    """8 m/s^2 is full braking. Noise of 2 cm a pose is up to 4 cm a step, and 4 cm a tenth of a second of velocity."""
    assert leaps(walk(*given_walk)) == []


@examples(150)
@given(walks, st.floats(0.0, 1.0), st.floats(1.0, 1000.0), st.sampled_from([-1.0, 1.0]))
def test_an_offset_beyond_the_bound_always_leaps(given_walk: tuple, where: float, more: float, sign: float) -> None:
    """From one pose on all are moved, by as much more than the bound as the motion itself may differ from steady."""
    row = walk(*given_walk)
    at = 1 + round(where * (len(row) - 2))
    assume(row[at][0] >= 0.25)  # there are 0.1 s of motion before
    hz, noise = given_walk[2:4]
    period = 1.0 / hz
    bound = MAX_LEAP + MAX_ACCELERATION * period**2 / 2.0
    span = max(0.1, period)  # over which the velocity is taken, and up to a period more
    unsteady = 8.0 * period * (span + 2 * period) + 2 * noise * (1.0 + period / 0.1)
    offset = sign * (bound + unsteady) * 1.001 * more
    moved = [(t, x + (offset if k >= at else 0.0)) for k, (t, x) in enumerate(row)]
    assert at in leaps(moved)


@examples(50)
@given(st.floats(5.0, 200.0), st.floats(-3.0, 3.0), st.floats(0.001, 2.0), st.sampled_from([-1.0, 1.0]))
def test_a_turn_beyond_the_bound_always_leaps(hz: float, rate: float, more: float, sign: float) -> None:
    """Up to where the shorter way is the other one."""
    times = np.arange(0.0, 2.0, 1.0 / hz)
    bound = MAX_TURN_LEAP + MAX_TURN_ACCELERATION / hz**2 / 2.0
    assume(bound + more + abs(rate) / hz < math.pi)
    at = len(times) // 2
    yaws = [rate * t + (sign * (bound + more) if k >= at else 0.0) for k, t in enumerate(times)]
    row = [(float(t), 0.0) for t in times]
    assert leaps(row, yaws) == [at]
    assert leaps(row, [rate * t for t in times]) == []


def test_where_each_pose_leaps_not_all_are_looked_at() -> None:
    """Two sources at 1 kHz each, 1 m apart: a message must not cost a walk over all poses."""
    looked: list[int] = []

    class Looked(list[Pose]):
        def __getitem__(self, at: Any) -> Any:
            looked.append(at)
            return super().__getitem__(at)

    robot = heard([(0.0005 * k, float(k % 2)) for k in range(3000)])
    poses = Looked(robot.buffer.poses)
    assert sum(pose.leapt for pose in poses) > 2900
    assert motion_before(poses, len(poses) - 1) is None
    assert min(looked) >= len(poses) - 2 - LOOKED_AT
    assert len(looked) < 10 * LOOKED_AT
