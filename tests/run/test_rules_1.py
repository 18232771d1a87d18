"""The rules of version 1, for logs made under them: a pose is taken by its stamp alone, wherever it arrives."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from service_tools import LEVEL, PRECISE, config

from roughmap_schemas import Odometry, PoseReason, Transform
from roughmap_service.run.odometry_clock import Verdict
from roughmap_service.run.robot import Robot
from roughmap_service.run.rules_1 import STALE_ROW
from roughmap_service.run.settings import Settings

HISTORY = 1000
BEGIN = 10_000


def robot(**limits: int) -> Robot:
    return Robot(Settings(config(input={"pose_history": HISTORY * 1e-9}), rules=1, **limits), "rover")


def pose(stamp: int, x: float = 0.0, frame: str = "map", *, fault: bool = False) -> Odometry:
    return Odometry(stamp, frame, "base", (x, 0.0, 0.0), LEVEL, None if fault else PRECISE, fault)


def add(r: Robot, odometry: Odometry, number: int) -> PoseReason | None:
    """Take a message; return why it gives no pose. Each is settled at once."""
    assert r.judge(odometry.stamp_ns) is Verdict.TAKE
    taken = r.take_odometry(odometry, number, arrival_ns=0)
    assert (taken.verdict, taken.ended_from, taken.leap) == (Verdict.TAKE, 0, None)
    (reason,) = taken.settled
    return reason


def filled(*stamps: int) -> Robot:
    """A robot that was told poses of these stamps, numbered from 1."""
    r = robot()
    for number, stamp in enumerate(stamps, 1):
        assert add(r, pose(stamp), number) is None
    return r


def stamps(r: Robot) -> list[int]:
    return [p.stamp_ns for p in r.buffer.poses]


def test_poses_that_come_out_of_order_lie_in_order() -> None:
    r = filled(BEGIN, BEGIN + 20, BEGIN + 10)
    assert [(p.stamp_ns, p.input) for p in r.buffer.poses] == [(BEGIN, 1), (BEGIN + 10, 3), (BEGIN + 20, 2)]


def test_of_two_poses_of_one_stamp_the_first_wins() -> None:
    r = filled(BEGIN)
    assert add(r, pose(BEGIN, 2.0), 2) is PoseReason.DUPLICATE
    assert [(p.input, p.position[0]) for p in r.buffer.poses] == [(1, 0.0)]


def test_a_pose_in_an_unknown_frame() -> None:
    r = robot()
    assert add(r, pose(BEGIN, frame="odom"), 1) is PoseReason.POSE_FRAME
    assert r.buffer.poses == []


def test_a_transform_after_the_pose_does_not_hold() -> None:
    """Nor does it under the rules of version 1 where it is the only one."""
    r = robot()
    assert r.add_transform(Transform(BEGIN + 1, "map", "odom", (0.0, 0.0, 0.0), LEVEL), 1) == (None, False)
    assert add(r, pose(BEGIN, frame="odom"), 2) is PoseReason.POSE_FRAME
    assert add(r, pose(BEGIN + 1, frame="odom"), 3) is None


def test_a_pose_whose_covariance_is_none() -> None:
    r = robot()
    assert add(r, pose(BEGIN, fault=True), 1) is PoseReason.BAD_COVARIANCE
    assert r.buffer.poses == []


@pytest.mark.parametrize("variance", [1e6, 1e-6])
def test_a_covariance_is_what_the_message_says(variance: float) -> None:
    r = robot()
    assert add(r, Odometry(BEGIN, "map", "base", (0.0, 0.0, 0.0), LEVEL, PRECISE * variance), 1) is None
    (kept,) = r.buffer.poses
    assert kept.covariance is not None
    assert kept.covariance.tobytes() == (PRECISE * variance).tobytes()


def test_a_negative_variance_is_bad() -> None:
    assert add(robot(), Odometry(BEGIN, "map", "base", (0.0, 0.0, 0.0), LEVEL, -PRECISE), 1) is (
        PoseReason.BAD_COVARIANCE
    )


def test_no_leap_is_marked() -> None:
    r = filled(BEGIN, BEGIN + 1)
    assert add(r, pose(BEGIN + 2, 1e6), 3) is None
    assert [p.leapt for p in r.buffer.poses] == [False] * 3


@pytest.mark.parametrize(("age", "reason"), [(HISTORY, None), (HISTORY + 1, PoseReason.STALE)])
def test_older_than_the_history_is_stale(age: int, reason: PoseReason | None) -> None:
    assert add(filled(BEGIN), pose(BEGIN - age), 2) is reason


def test_ten_stale_ones_that_rise_are_a_reset_clock() -> None:
    r = filled(BEGIN, BEGIN + 1)
    for n in range(STALE_ROW - 1):
        assert add(r, pose(n), 10 + n) is PoseReason.STALE
    assert add(r, pose(STALE_ROW), 30) is None
    assert stamps(r) == [STALE_ROW]
    assert add(r, pose(STALE_ROW - 1), 31) is None, "the new clock's poses have their own horizon"


@pytest.mark.parametrize(
    "between", [pose(BEGIN + 2), pose(BEGIN), pose(0)], ids=["a good one", "a duplicate", "one that does not rise"]
)
def test_the_row_of_stale_ones_begins_again(between: Odometry) -> None:
    r = filled(BEGIN, BEGIN + 1)
    for n in range(1, STALE_ROW):
        assert add(r, pose(n), 10 + n) is PoseReason.STALE
    add(r, between, 50)
    counted = 1 if between.stamp_ns == 0 else 0  # one that does not rise is itself the first of the next row
    for n in range(STALE_ROW - 1 - counted):
        assert add(r, pose(100 + n), 60 + n) is PoseReason.STALE
    assert add(r, pose(200), 80) is None
    assert stamps(r) == [200]


def test_what_was_dropped_is_not_taken_again() -> None:
    r = robot(max_poses=5)
    for number in range(8):
        assert add(r, pose(BEGIN + number), number + 1) is None
    assert stamps(r) == list(range(BEGIN + 3, BEGIN + 8))
    assert add(r, pose(BEGIN + 2), 9) is PoseReason.STALE


@given(st.lists(st.tuples(st.integers(0, 5000), st.booleans()), max_size=60), st.integers(0, 60))
def test_any_row_of_stamps(row: list[tuple[int, bool]], stored: int) -> None:
    """Whatever comes: poses rise, no two of one stamp, at most one before the horizon; restored in between, it goes on
    as it was."""
    r = robot()
    for number, (stamp, fault) in enumerate(row, 1):
        if number == stored:
            state = json.loads(json.dumps(r.to_state(), allow_nan=False))
            r = robot()
            r.load_state(state)
        before = stamps(r)
        reason = add(r, pose(stamp, fault=fault), number)
        after = stamps(r)
        assert after == sorted(set(after))
        assert sum(s < r.buffer.horizon_ns for s in after) <= 1
        assert (reason is None) == (number in [p.input for p in r.buffer.poses])
        if reason is not None:
            assert after == before
        elif stamp < min(before, default=0) - HISTORY:
            assert after == [stamp], "a clock that was set back"


@given(st.lists(st.integers(0, 3000), min_size=1, max_size=40))
def test_the_state_of_a_version_without_clocks_goes_on(row: list[int]) -> None:
    """As a store of such a version holds it: no clock, no sensors, poses without leaps."""
    first = robot()
    for number, stamp in enumerate(row, 1):
        add(first, pose(stamp), number)
    state = json.loads(json.dumps(first.to_state()))
    del state["clock"], state["sensors"]
    state["poses"] = [one[:6] for one in state["poses"]]
    again = robot()
    again.load_state(state)
    assert again.to_state()["poses"] == first.to_state()["poses"]
    again.use(Settings(config(input={"pose_history": HISTORY * 1e-9})))
    newest = stamps(again)[-1]
    assert again.judge(newest) is Verdict.REPEAT
    assert again.judge(newest + 1) is Verdict.TAKE
    assert again.judge(newest - 1) is Verdict.HOLD
