"""A robot's poses by stamp: how long they are kept, and which of them hold over a span of time."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from service_tools import LEVEL

from roughmap_service.run.poses import Pose, PoseBuffer, leaps, too_far_apart

HISTORY = 1000
BEGIN = 10_000


def pose(stamp: int, number: int = 1, x: float = 0.0, *, leapt: bool = False) -> Pose:
    return Pose(stamp, (x, 0.0, 0.0), LEVEL, None, number, 0, leapt)


def filled(*stamps: int) -> PoseBuffer:
    """A buffer with poses of these stamps, numbered from 1."""
    b = PoseBuffer(HISTORY)
    for number, stamp in enumerate(stamps, 1):
        assert b.insert(pose(stamp, number)) is not None
        b.trim()
    return b


def stamps(b: PoseBuffer) -> list[int]:
    return [p.stamp_ns for p in b.poses]


def test_poses_that_come_out_of_order_lie_in_order() -> None:
    b = filled(BEGIN, BEGIN + 20, BEGIN + 10)
    assert [(p.stamp_ns, p.input) for p in b.poses] == [(BEGIN, 1), (BEGIN + 10, 3), (BEGIN + 20, 2)]


def test_an_insertion_returns_its_place() -> None:
    b = filled(10, 30)
    assert [b.insert(pose(stamp)) for stamp in (20, 40, 5)] == [1, 3, 0]


def test_of_two_poses_of_one_stamp_the_first_wins() -> None:
    b = filled(BEGIN)
    assert b.insert(pose(BEGIN, 2, 2.0)) is None
    assert [(p.input, p.position[0]) for p in b.poses] == [(1, 0.0)]


def test_what_is_stale_is_forgotten_but_one_before_the_horizon() -> None:
    b = filled(BEGIN, BEGIN + 300, BEGIN + 700, BEGIN + 1400)
    assert stamps(b) == [BEGIN + 300, BEGIN + 700, BEGIN + 1400], "a time right after the horizon has its bracket"
    assert b.horizon_ns == BEGIN + 400
    assert b.covers(BEGIN + 400, BEGIN + 1400)


def test_the_horizon_never_goes_back() -> None:
    """A shorter history, then a longer one, as over restarts: what was forgotten does not count as kept."""
    b = filled(BEGIN, BEGIN + 2000)
    b.history_ns = 5000
    b.insert(pose(BEGIN + 2001, 3))
    b.trim()
    assert b.horizon_ns == BEGIN + 1000


def test_no_flood_of_poses_within_the_history() -> None:
    b = PoseBuffer(HISTORY, max_poses=5)
    for number in range(8):
        b.insert(pose(BEGIN + number, number + 1))
        b.trim()
    assert stamps(b) == list(range(BEGIN + 3, BEGIN + 8))
    assert b.horizon_ns == BEGIN + 3, "what was dropped does not count as kept"


def test_cleared_it_begins_again_at_any_time() -> None:
    b = filled(BEGIN, BEGIN + 2000)
    b.clear()
    assert (stamps(b), b.horizon_ns) == ([], 0)


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
    assert not PoseBuffer(HISTORY).covers(0, 0)


def test_poses_by_name() -> None:
    b = filled(10, 20, 30)
    assert [p.stamp_ns for p in b.named([(1, 0), (3, 0)])] == [10, 30]
    assert b.named([]) == []
    for unknown in [(4, 0), (1, 7)]:
        with pytest.raises(KeyError):
            b.named([(1, 0), unknown])


def test_gaps_at_their_limits() -> None:
    row = [pose(BEGIN), pose(BEGIN + 100)]
    assert not too_far_apart(row, 100.0)
    assert too_far_apart(row, 99.0)
    assert not too_far_apart(row, float("inf"))


@pytest.mark.parametrize(
    ("leapt", "said"),
    [([False] * 3, False), ([True, False, False], False), ([False, True, False], True), ([False, False, True], True)],
)
def test_a_leap_to_the_first_pose_is_outside_of_the_row(leapt: list[bool], said: bool) -> None:
    assert leaps([pose(BEGIN + k, leapt=one) for k, one in enumerate(leapt)]) is said


@given(st.lists(st.integers(0, 5000), max_size=60))
def test_any_row_of_stamps(row: list[int]) -> None:
    """Whatever comes: poses rise, no two of one stamp, at most one before the horizon, which never goes back."""
    b = PoseBuffer(HISTORY, max_poses=7)
    horizon = 0
    for number, stamp in enumerate(row, 1):
        before = stamps(b)
        assert (b.insert(pose(stamp, number)) is None) == (stamp in before)
        b.trim()
        after = stamps(b)
        assert after == sorted(set(after))
        assert len(after) <= 7
        assert sum(s < b.horizon_ns for s in after) <= 1
        assert b.horizon_ns >= horizon
        horizon = b.horizon_ns
