"""A robot's poses: which are taken, how long they are kept, and which of them hold over a span of time."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from service_tools import LEVEL, PRECISE

from roughmap_schemas import Odometry, PoseReason
from roughmap_service.run.poses import STALE_ROW, PoseBuffer, too_far_apart, too_fast

HISTORY = 1000
BEGIN = 10_000


def buffer() -> PoseBuffer:
    return PoseBuffer("map", HISTORY, jump_m=0.15, jump_rad=0.03)


def pose(stamp: int, x: float = 0.0, frame: str = "map", *, fault: bool = False) -> Odometry:
    return Odometry(stamp, frame, "base", (x, 0.0, 0.0), LEVEL, None if fault else PRECISE, fault)


def filled(*stamps: int) -> PoseBuffer:
    """A buffer that was told poses of these stamps, numbered from 1."""
    b = buffer()
    for number, stamp in enumerate(stamps, 1):
        assert b.add(pose(stamp), number) == (None, False)
    return b


def stamps(b: PoseBuffer) -> list[int]:
    return [p.stamp_ns for p in b.poses]


def test_poses_that_come_out_of_order_lie_in_order() -> None:
    b = filled(BEGIN, BEGIN + 20, BEGIN + 10)
    assert [(p.stamp_ns, p.input) for p in b.poses] == [(BEGIN, 1), (BEGIN + 10, 3), (BEGIN + 20, 2)]


def test_of_two_poses_of_one_stamp_the_first_wins() -> None:
    b = buffer()
    b.add(pose(BEGIN, 1.0), 1)
    assert b.add(pose(BEGIN, 2.0), 2) == (PoseReason.DUPLICATE, False)
    assert [(p.input, p.position[0]) for p in b.poses] == [(1, 1.0)]


def test_a_pose_in_an_unknown_frame() -> None:
    b = buffer()
    assert b.add(pose(BEGIN, frame="odom"), 1) == (PoseReason.POSE_FRAME, False)
    assert b.poses == []


def test_a_pose_whose_covariance_is_none() -> None:
    b = buffer()
    assert b.add(pose(BEGIN, fault=True), 1) == (PoseReason.BAD_COVARIANCE, False)
    assert b.poses == []


@pytest.mark.parametrize(("age", "reason"), [(HISTORY, None), (HISTORY + 1, PoseReason.STALE)])
def test_older_than_the_buffer_is_stale(age: int, reason: PoseReason | None) -> None:
    b = filled(BEGIN)
    assert b.add(pose(BEGIN - age), 2) == (reason, False)


def test_ten_stale_ones_that_rise_are_a_reset_clock() -> None:
    b = filled(BEGIN, BEGIN + 1)
    for n in range(STALE_ROW - 1):
        assert b.add(pose(n), 10 + n) == (PoseReason.STALE, False)
    assert b.add(pose(STALE_ROW), 30) == (None, True)
    assert stamps(b) == [STALE_ROW]
    assert b.add(pose(STALE_ROW - 1), 31) == (None, False), "the new clock's buffer has its own horizon"


@pytest.mark.parametrize(
    "between", [pose(BEGIN + 2), pose(BEGIN), pose(0)], ids=["a good one", "a duplicate", "one that does not rise"]
)
def test_the_row_of_stale_ones_begins_again(between: Odometry) -> None:
    b = filled(BEGIN, BEGIN + 1)
    for n in range(1, STALE_ROW):
        assert b.add(pose(n), 10 + n)[0] is PoseReason.STALE
    b.add(between, 50)
    counted = 1 if between.stamp_ns == 0 else 0  # one that does not rise is itself the first of the next row
    for n in range(STALE_ROW - 1 - counted):
        assert b.add(pose(100 + n), 60 + n) == (PoseReason.STALE, False)
    assert b.add(pose(200), 80) == (None, True)


def test_what_is_stale_is_forgotten_but_one_before_the_horizon() -> None:
    b = filled(BEGIN, BEGIN + 300, BEGIN + 700, BEGIN + 1400)
    assert stamps(b) == [BEGIN + 300, BEGIN + 700, BEGIN + 1400], "a time right after the horizon has its bracket"
    assert b.horizon_ns == BEGIN + 400
    assert b.covers(BEGIN + 400, BEGIN + 1400)


def test_the_horizon_never_goes_back() -> None:
    """A shorter history, then a longer one, as over restarts: what was forgotten does not count as kept."""
    b = filled(BEGIN, BEGIN + 2000)
    b.history_ns = 5000
    assert b.add(pose(BEGIN + 2001), 3) == (None, False)
    assert b.horizon_ns == BEGIN + 1000
    assert b.add(pose(BEGIN + 999), 4)[0] is PoseReason.STALE


def test_no_flood_of_poses_within_the_history() -> None:
    b = buffer()
    b.max_poses = 5
    for number in range(8):
        assert b.add(pose(BEGIN + number), number + 1) == (None, False)
    assert stamps(b) == list(range(BEGIN + 3, BEGIN + 8))
    assert b.add(pose(BEGIN + 2), 9)[0] is PoseReason.STALE, "what was dropped is not taken again"


@pytest.mark.parametrize(
    ("first", "last", "covered", "window"),
    [
        (10, 20, True, [10, 20]),
        (10, 10, True, [10]),
        (11, 19, True, [10, 20]),
        (10, 21, True, [10, 20, 30]),
        (15, 30, True, [10, 20, 30]),
        (20, 20, True, [20]),
        (9, 20, False, None),
        (20, 31, False, None),
    ],
)
def test_a_span_and_the_poses_around_it(first: int, last: int, covered: bool, window: list[int] | None) -> None:
    """An exact stamp needs no second pose."""
    b = filled(10, 20, 30)
    assert b.covers(first, last) is covered
    if window is not None:
        assert [p.stamp_ns for p in b.window(first, last)] == window


def test_an_empty_buffer_covers_nothing() -> None:
    assert not buffer().covers(0, 0)


def test_poses_by_name() -> None:
    b = filled(10, 20, 30)
    assert [p.stamp_ns for p in b.named([(1, 0), (3, 0)])] == [10, 30]
    assert b.named([]) == []
    for unknown in [(4, 0), (1, 7)]:
        with pytest.raises(KeyError):
            b.named([(1, 0), unknown])


def test_gaps_and_speeds_at_their_limits() -> None:
    b = buffer()
    b.add(pose(BEGIN, 0.0), 1)
    b.add(pose(BEGIN + 100, 3e-6), 2)
    assert not too_far_apart(b.poses, 100.0)
    assert too_far_apart(b.poses, 99.0)
    assert not too_far_apart(b.poses, float("inf"))
    assert not too_fast(b.poses, max_speed=31.0, max_turn=0.0), "3 micrometres in 100 ns are 30 m/s"
    assert too_fast(b.poses, max_speed=29.0, max_turn=0.0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_turns_go_the_shorter_way(sign: float) -> None:
    """A quaternion and its negative are one rotation; 0.1 rad in 0.1 s is 1 rad/s."""
    b = buffer()
    turned = tuple(sign * v for v in (0.0, 0.0, np.sin(0.05), np.cos(0.05)))
    b.add(pose(BEGIN), 1)
    b.add(Odometry(BEGIN + 10**8, "map", "base", (0.0, 0.0, 0.0), turned, None), 2)  # type: ignore[arg-type]
    assert too_fast(b.poses, 1.0, 0.999)
    assert not too_fast(b.poses, 1.0, 1.001)


@given(st.lists(st.tuples(st.integers(0, 5000), st.booleans()), max_size=60))
def test_any_row_of_stamps(row: list[tuple[int, bool]]) -> None:
    """Whatever comes: poses rise, no two of one stamp, at most one before the horizon, and counts add up."""
    b = buffer()
    for number, (stamp, fault) in enumerate(row, 1):
        before = stamps(b)
        reason, was_reset = b.add(pose(stamp, fault=fault), number)
        after = stamps(b)
        assert after == sorted(set(after))
        assert sum(s < b.horizon_ns for s in after) <= 1
        assert (reason is None) == (number in [p.input for p in b.poses])
        if reason is not None:
            assert after == before
            assert not was_reset
        if was_reset:
            assert after == [stamp]
