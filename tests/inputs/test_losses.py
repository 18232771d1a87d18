"""When a stream counts as lost: against the definition, written out over all that ever came."""

import math
from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import examples

from roughmap_service.inputs.losses import FEWEST, ROW, SHARE, WINDOW, Cause, Losses, Outcome

LATE, GAP = Cause("cloud", "late"), Cause("cloud", "pose_gap")


def fed(causes: list[Cause | None], period: float, losses: Losses | None = None, start: float = 0.0) -> Losses:
    losses = losses or Losses()
    for number, cause in enumerate(causes):
        losses.add(Outcome(start + number * period, cause))
    return losses


def by_definition(history: list[Outcome]) -> Cause | None:
    """The state after all these, none of which ended a silence: looked up from the beginning, step by step."""
    lost, restored_at = None, 0
    for end in range(1, len(history) + 1):
        now, last = history[end - 1].at, [outcome.cause for outcome in history[:end][-ROW:]]
        window = [o for o in history[restored_at:end] if int(o.at) >= int(now) - WINDOW]
        bad = sum(o.cause is not None for o in window)
        covered = bool(window) and now - window[0].at >= WINDOW
        most = Counter(cause for cause in last if cause is not None).most_common(1)
        if lost is not None and len(last) == ROW and lost not in last and 2 * (ROW - last.count(None)) < ROW:
            restored_at, lost = end, None
        elif most and len(last) == ROW and len(set(last)) == 1:
            lost = last[0]
        elif most and ((lost is None and covered and len(window) >= FEWEST and bad >= SHARE * len(window)) or (
            lost is not None and lost not in last
        )):  # fmt: skip
            lost = most[0][0]
    return lost


RUNS = st.lists(
    st.tuples(st.sampled_from([None, None, LATE, GAP]), st.integers(1, 15), st.sampled_from([0.02, 0.1, 0.5, 1.0])),
    min_size=1, max_size=12,
)  # fmt: skip
"""Runs of messages that end the same way, at a rate."""


@given(RUNS, st.lists(st.booleans(), min_size=180, max_size=180))
@examples(300)
def test_a_stream_is_lost_exactly_when_the_definition_says(
    runs: list[tuple[Cause | None, int, float]], odd: list[bool]
) -> None:
    losses, history, now = Losses(), [], 0.25
    for cause, number, period in runs:
        for _ in range(number):
            now += period
            flipped = odd[len(history)] and len(history) % 11 == 0
            history.append(Outcome(now, GAP if flipped else cause))
            losses.add(history[-1])
            assert losses.lost == by_definition(history)


def test_ten_in_a_row_are_lost_and_nine_are_not() -> None:
    assert fed([LATE] * 9, 0.1).lost is None
    assert fed([LATE] * 10, 0.1).lost == LATE
    assert fed([None, *[LATE] * 10], 0.1).lost == LATE


def test_two_ways_in_turn_are_lost_once_they_last_five_seconds() -> None:
    assert fed([LATE, GAP, GAP] * 17, 0.1).lost in (LATE, GAP)
    assert fed([LATE, GAP] * 24, 0.1).lost is None


@pytest.mark.parametrize(("good_in", "lost"), [(10, True), (8, False)])
def test_nine_of_ten_are_lost_and_seven_of_eight_are_not(good_in: int, lost: bool) -> None:
    row: list[Cause | None] = [None if n % good_in == 0 else (LATE, GAP)[n % 2] for n in range(1, 400)]
    assert (fed(row, 0.05).lost is not None) == lost


def test_a_slow_sensor_is_lost_within_ten_seconds() -> None:
    assert fed([LATE] * 6, 1.0).lost == LATE


def test_it_works_again_after_ten_good_ones_and_not_after_nine() -> None:
    losses = fed([LATE] * 60, 0.1)
    assert fed([None] * 9, 0.1, losses, 6.0).lost == LATE
    assert fed([None], 0.1, losses, 6.9).lost is None
    assert fed([LATE], 0.1, losses, 7.0).lost is None, "what was before the ten no longer counts"


def test_another_cause_takes_the_place_of_the_first() -> None:
    losses = fed([LATE] * 20, 0.1)
    assert fed([GAP] * 5, 0.1, losses, 2.0).lost == LATE
    assert fed([GAP] * 5, 0.1, losses, 2.5).lost == GAP


def test_one_other_loss_among_good_messages_is_no_new_cause() -> None:
    losses = fed([LATE] * 60, 0.1)
    assert fed([None, GAP, *[None] * 7], 0.1, losses, 6.0).lost == LATE
    assert fed([None], 0.1, losses, 6.9).lost is None


def test_after_a_silence_it_begins_anew_and_a_slow_one_may_pause_longer() -> None:
    losses = fed([LATE] * 10, 0.1)
    assert not losses.silent(60.0)
    assert losses.silent(61.0)
    losses.add(Outcome(61.0, LATE))
    assert (losses.lost, len(losses.last)) == (None, 1)
    scanner = fed([LATE] * 10, 100.0)
    assert scanner.lost == LATE
    assert not scanner.silent(1100.0)
    assert fed([LATE], 1.0).silent(math.inf)
