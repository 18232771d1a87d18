"""Which odometry is believed: by the stamps of what came before, and by what comes after."""

import json

import pytest
from odometry_heard import TENTH, Heard

from roughmap_schemas import PoseReason
from roughmap_service.run.odometry_clock import (
    BACK_FENCE_NS,
    BELIEVED_LATER,
    BREAK_FENCE_NS,
    FROZEN,
    MAX_HELD,
    OdometryClock,
    Verdict,
)

TAKE, REPEAT, HOLD, FORWARD, BACK, BREAK = Verdict
START = 1000
"""Tenths of a second: the first stamp of most rows."""

STEADY = list(range(START, START + 20))


def test_the_first_is_believed_whatever_its_stamp() -> None:
    for t in (1, START, 2**31):
        heard = Heard()
        assert heard.add(t).settled == [None]


@pytest.mark.parametrize(
    ("after", "verdicts"),
    [
        # Ahead by up to three usual steps, which are a tenth here. The usual one is the second longest of the last.
        ([20], [TAKE]),
        ([22], [TAKE]),
        ([22.01], [HOLD]),
        ([20.5, 20.55, 20.57], [TAKE] * 3),
        ([21, 24.01], [TAKE, HOLD]),
        ([21, 23, 28], [TAKE] * 3),
        ([21, 23, 28.01], [TAKE, TAKE, HOLD]),  # never longer than the longest gap of poses
        # The newest stamp again.
        ([19, 19, 20], [REPEAT, REPEAT, TAKE]),
        # A clock that leapt forward takes three with rising stamps.
        ([100, 101, 102], [HOLD, HOLD, FORWARD]),
        ([100, 101, 102, 103], [HOLD, HOLD, FORWARD, TAKE]),
        ([100, 100, 101, 102], [HOLD, HOLD, HOLD, FORWARD]),
        ([102, 101, 100], [HOLD, HOLD, HOLD]),
        ([100, 105, 110], [HOLD, HOLD, FORWARD]),
        ([100, 105.01, 110], [HOLD] * 3),  # farther apart than the longest gap it takes ten
        ([100 + 10 * k for k in range(10)], [HOLD] * 9 + [FORWARD]),
        ([100 + 100 * k for k in range(10)], [HOLD] * 9 + [FORWARD]),
        ([100 + 100.01 * k for k in range(12)], [HOLD] * 12),  # steps longer than the pose history are no row
        # One wild stamp costs itself alone, ahead or behind.
        ([36000, 20, 21], [HOLD, TAKE, TAKE]),
        ([36000, 20, 36000, 21, 36000, 22], [HOLD, TAKE] * 3),
        ([36000, 20, 36001, 21, 36002, 22], [HOLD, TAKE] * 3),
        ([5, 20, 21], [HOLD, TAKE, TAKE]),
        # Two that were swapped on their way.
        ([21, 20, 22, 23], [TAKE, HOLD, BREAK, TAKE]),
        # A clock that went back by much takes three.
        ([5, 6, 7], [HOLD, HOLD, BACK]),
        ([5, 6, 7, 8, 9], [HOLD, HOLD, BACK, TAKE, TAKE]),
        ([5, 5, 6, 7], [HOLD, HOLD, HOLD, BACK]),
        ([7, 6, 5], [HOLD, HOLD, HOLD]),
        ([-500, -499, -498], [HOLD, HOLD, BACK]),
        ([-900 + 10 * k for k in range(10)], [HOLD] * 9 + [BACK]),
        # By less than it takes to notice: rising from below, it passes the newest.
        ([18, 19, 20], [HOLD, REPEAT, BREAK]),
        ([18.5, 19.5], [HOLD, BREAK]),
        ([17.5, 18.5, 19.5], [HOLD, HOLD, BREAK]),
        ([17.0, 20], [HOLD, BREAK]),
        ([16.9, 20], [HOLD, TAKE]),  # from there no step leads to 20: a wild one
        # While one ahead is held, one behind does not count for it.
        ([100, 5, 101, 6, 102, 7], [HOLD] * 6),
    ],
)  # fmt: skip
def test_every_verdict(after: list[float], verdicts: list[Verdict]) -> None:
    """Behind twenty poses a tenth of a second apart; 0 is the first of them."""
    heard = Heard(STEADY)
    assert heard.all([START + t for t in after]) == verdicts


def test_before_any_step_is_known_a_pose_may_be_as_late_as_the_longest_gap() -> None:
    assert Heard([START]).add(START + 5).verdict is TAKE
    assert Heard([START]).add(START + 5.01).verdict is HOLD


def test_a_step_beyond_the_longest_gap_is_at_most_half_as_long_again_as_the_usual_one() -> None:
    """Usual steps are those seen: 0.4 s, so 0.6 s, though the longest gap is 0.5 s."""
    heard = Heard([START, START + 4, START + 8])
    assert heard.add(START + 14).verdict is TAKE
    heard = Heard([START, START + 4, START + 8])
    assert heard.add(START + 14.01).verdict is HOLD


def test_a_lost_message_does_not_count_as_usual() -> None:
    """The longest step may be one over a message that was lost; two of them in eight are no chance."""
    heard = Heard([*STEADY, START + 22, START + 23])
    assert heard.robot.judge(round((START + 26.01) * TENTH)) is HOLD
    assert heard.all([START + 26, START + 30]) == [TAKE, TAKE]


def test_the_last_eight_steps_count() -> None:
    row = [START, START + 3, START + 6]
    for _ in range(6):
        row.append(row[-1] + 1)
    assert Heard(row).add(row[-1] + 5).verdict is TAKE, "two of the last eight are 0.3 s long"
    row.append(row[-1] + 1)
    assert Heard(row).add(row[-1] + 3).verdict is TAKE
    assert Heard(row).add(row[-1] + 3.01).verdict is HOLD


def test_judging_changes_nothing() -> None:
    heard = Heard([*STEADY, START + 100, START + 101])
    before = json.dumps(heard.robot.to_state())
    verdicts = [heard.robot.judge((START + t) * TENTH) for t in (5, 19, 20, 102, 9000)]
    assert verdicts == [HOLD, REPEAT, TAKE, FORWARD, HOLD]
    assert json.dumps(heard.robot.to_state()) == before


@pytest.mark.parametrize(
    ("after", "settled"),
    [
        ([100, 101, 102], [[], [], [None, None, None]]),
        ([100, 99, 101, 102], [[], [], [], [PoseReason.AHEAD, None, None, None]]),
        ([36000, 20], [[], [PoseReason.AHEAD, None]]),
        ([5, 20], [[], [PoseReason.OUT_OF_ORDER, None]]),
        ([5, 100, 6, 20], [[], [], [], [PoseReason.OUT_OF_ORDER, PoseReason.AHEAD, PoseReason.OUT_OF_ORDER, None]]),
        ([-100, 20], [[], [PoseReason.STALE, None]]),
        ([5, 6, 7], [[], [], [None, None, None]]),
        ([9, 5, 6, 7], [[], [], [], [PoseReason.OUT_OF_ORDER, None, None, None]]),
        ([18.5, 19.5], [[], [PoseReason.OUT_OF_ORDER, None]]),
        ([19], [[PoseReason.DUPLICATE]]),
    ],
)
def test_what_becomes_of_each(after: list[float], settled: list[list[PoseReason | None]]) -> None:
    """Of those that were held the oldest first, the new one last; poses of 0.1 s, so the history reaches to -81."""
    heard = Heard(STEADY)
    assert [list(heard.add(START + t).settled) for t in after] == settled


def test_forward_keeps_the_poses_before() -> None:
    """Clouds from before still find them; between there is a gap."""
    heard = Heard(STEADY)
    heard.all([START + t for t in (100, 101, 102)])
    assert heard.inputs_of_poses == list(range(1, 24))[-len(heard.poses) :]
    assert heard.poses[-4:] == [(START + t) * TENTH for t in (19, 100, 101, 102)]


def test_steps_that_are_always_longer_than_the_gap_of_poses_are_usual() -> None:
    """As of a recording with a pose a scan: none is held, so the last is not lost either."""
    steps = [4.9994, 4.9998, 5.0026, 5.0008, 4.9994, 5.0039, 5.0007, 4.9966, 5.0020]
    heard = Heard([START])
    at = float(START)
    for step in steps:
        at += step
        assert heard.add(at).verdict is TAKE


def test_back_begins_anew_with_the_three() -> None:
    heard = Heard(STEADY)
    heard.all([START + t for t in (5, 6)])
    taken = heard.add(START + 7)
    assert taken.ended_from == 21, "clouds since the first of the three may be of the clock before"
    assert heard.inputs_of_poses == [21, 22, 23]
    clock = heard.robot.clock
    assert (clock.begun, clock.taken, clock.newest_ns) == (21, 3, (START + 7) * TENTH)
    assert clock.fence_ns == (START + 5) * TENTH + BACK_FENCE_NS
    assert heard.robot.buffer.horizon_ns < (START + 5) * TENTH


@pytest.mark.parametrize("first", [[START + 36000], [START + 36000, START + 36001]])
def test_what_came_first_may_be_wild(first: list[int]) -> None:
    """Then no clock went back, and no cloud ends for it."""
    heard = Heard(first)
    taken = [heard.add(START + k) for k in range(3)]
    assert [one.verdict for one in taken] == [HOLD, HOLD, BACK]
    assert taken[-1].ended_from == 0
    assert heard.poses == [(START + k) * TENTH for k in range(3)]
    assert heard.robot.clock.begun == 0


def test_a_break_begins_anew_with_the_last() -> None:
    heard = Heard(STEADY)
    heard.add(START + 18.5)
    taken = heard.add(START + 19.5)
    assert (taken.verdict, taken.ended_from) == (BREAK, 21)
    assert heard.inputs_of_poses == [22]
    assert heard.robot.clock.fence_ns == round((START + 19.5) * TENTH) + BREAK_FENCE_NS


def test_ten_repeats_in_a_row_are_frozen() -> None:
    heard = Heard(STEADY)
    reasons = [heard.add(START + 19).settled[0] for _ in range(FROZEN + 3)]
    assert reasons == [PoseReason.DUPLICATE] * (FROZEN - 1) + [PoseReason.FROZEN] * 4
    assert heard.add(START + 20).settled == [None]
    assert heard.add(START + 20).settled == [PoseReason.DUPLICATE], "a new row"


def test_a_repeat_does_not_end_the_doubt_in_what_is_held() -> None:
    heard = Heard(STEADY)
    assert heard.all([START + t for t in (5, 19, 6, 19, 7)]) == [HOLD, REPEAT, HOLD, REPEAT, BACK]
    assert heard.robot.clock.newest_ns == (START + 7) * TENTH


def test_held_ones_are_bounded() -> None:
    """Falling stamps lead nowhere: the oldest of them are given up."""
    heard = Heard(STEADY)
    for k in range(MAX_HELD):
        assert heard.add(START + 10 - 0.1 * k).settled == []
    assert heard.add(START + 10 - 0.1 * MAX_HELD).settled == [PoseReason.OUT_OF_ORDER]
    assert len(heard.robot.clock.held) == MAX_HELD
    assert heard.robot.clock.doubted == 21, "the doubt is older than what is still held"


def test_a_message_without_a_pose_counts_like_any_other() -> None:
    heard = Heard()
    assert [heard.add(START + t, "nowhere").settled for t in range(3)] == [[PoseReason.POSE_FRAME]] * 3
    taken = [heard.add(START + t, frame) for t, frame in ((100, "map"), (101, "nowhere"), (102, "map"))]
    assert taken[-1].settled == [None, PoseReason.POSE_FRAME, None]
    assert heard.inputs_of_poses == [4, 6]


class TestTwoSources:
    """Odometry of two sources, one of them late: stamps go back by a little, again and again."""

    def mixed(self, pairs: int) -> list[float]:
        """Two sources in turn, 10 Hz each, the second 0.17 s late."""
        return [START + 20 + t for k in range(1, pairs) for t in (k, k - 1.7)]

    def test_three_breaks_within_the_history_show_them(self) -> None:
        heard = Heard(STEADY)
        shown = []
        for t in self.mixed(10):
            heard.add(t)
            shown.append(heard.robot.clock.two_sources)
        assert shown == sorted(shown), "not, then ever"
        assert shown[-1]
        assert not shown[3]

    @pytest.mark.parametrize("late", [3.7, 8.3, 40.0])
    def test_one_that_is_so_late_that_its_stamps_never_go_on_shows_them_too(self, late: float) -> None:
        """Each of its poses is dropped, until it is known as a source: then they are sorted in."""
        heard = Heard(STEADY)
        for k in range(1, 40):
            heard.all([START + 20 + k, START + 20 + k - late])
        assert heard.robot.clock.two_sources

    def test_one_source_again(self) -> None:
        heard = Heard(STEADY)
        for t in self.mixed(10):
            heard.add(t)
        heard.all([START + 29 + k for k in range(1, 40)])
        assert not heard.robot.clock.two_sources

    def test_one_wild_stamp_in_eight_does_not(self) -> None:
        heard = Heard(STEADY)
        for k in range(1, 200):
            heard.add(START + 20 + k - (0 if k % 8 else 8.3))
        assert not heard.robot.clock.two_sources

    def test_three_breaks_far_apart_do_not(self) -> None:
        heard = Heard(STEADY)
        first = START + 20
        for _ in range(3):
            heard.all([first - 1.7, first - 0.7, *range(first, first + 110)])
            first += 110
        assert not heard.robot.clock.two_sources

    def test_then_poses_are_sorted_by_stamp(self) -> None:
        heard = Heard(STEADY)
        for t in self.mixed(30):
            heard.add(t)
        assert heard.robot.clock.two_sources
        later = [round(t * TENTH) for t in sorted(self.mixed(30)) if START + 32 < t < START + 45]
        kept = [p for p in heard.poses if (START + 32) * TENTH < p < (START + 45) * TENTH]
        assert kept == later, "none is lost"

    def test_a_clock_that_goes_back_takes_ten(self) -> None:
        heard = Heard(STEADY)
        for t in self.mixed(30):
            heard.add(t)
        verdicts = [heard.add(t - 30).verdict for t in self.mixed(12)]
        assert verdicts[: BELIEVED_LATER - 1] == [HOLD] * (BELIEVED_LATER - 1)
        assert verdicts[BELIEVED_LATER - 1] is BACK
        assert heard.poses == sorted(heard.poses)


@pytest.mark.parametrize("bag", [[0, 1, 2, 3], list(range(150)), [0], [0, 4, 8]], ids=["short", "long", "one", "rare"])
@pytest.mark.parametrize("times", [1, 2])
def test_after_a_reset_of_the_map_any_stamp_is_believed(bag: list[int], times: int) -> None:
    """The same recording again: what was taken then is taken now, from its first message on."""
    heard = Heard([START + t for t in bag])
    kept = heard.poses
    for _ in range(times):
        heard.robot.begin_map(heard.inputs + 1)
        taken = [heard.add(START + t) for t in bag]
        assert [list(one.settled) for one in taken] == [[None]] * len(bag)
        assert heard.poses == kept


def test_a_clock_that_goes_on_after_a_reset_of_the_map_keeps_its_poses() -> None:
    heard = Heard(STEADY)
    heard.robot.begin_map(heard.inputs + 1)
    assert heard.all([START + 20, START + 21]) == [TAKE, TAKE]
    assert len(heard.poses) == 22
    assert heard.all([START + 5]) == [HOLD], "the first one ends the exception"


def test_a_reset_of_the_map_gives_up_what_was_held() -> None:
    heard = Heard([*STEADY, START + 5, START + 6])
    heard.robot.begin_map(heard.inputs + 1)
    assert (heard.robot.clock.held, heard.robot.clock.doubted) == ([], 0)
    taken = heard.add(START + 7)
    assert (taken.verdict, taken.settled, taken.ended_from) == (BACK, [None], 0)


def test_clouds_that_came_since_a_reset_of_the_map_are_of_the_new_time() -> None:
    heard = Heard(STEADY)
    heard.robot.begin_map(31)  # inputs up to 30 were taken before the reset
    heard.inputs = 40  # clouds 31 to 40 came since
    heard.add(START)
    assert heard.robot.clock.begun == 31


def test_which_clouds_a_held_message_holds_up() -> None:
    clock = OdometryClock(newest_ns=100, doubted=7)
    assert [clock.doubts(number, 50) for number in (6, 7, 8)] == [False, False, True]


def test_which_clouds_a_repeated_stamp_holds_up() -> None:
    clock = OdometryClock(newest_ns=100, repeats=1, repeated=7)
    assert [clock.doubts(number, 100) for number in (6, 8)] == [False, True]
    assert [clock.doubts(8, last) for last in (99, 100, 101)] == [False, True, True]
