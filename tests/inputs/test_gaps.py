"""Which messages were lost on the way: several publishers on one key, restarts, losses."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import examples

from roughmap_schemas.kinds import Kind
from roughmap_service.inputs.gaps import MAX_GAP, WAIT, Gaps

KEY = "robots/r1/points"


def lost(numbers: list[int]) -> int:
    gaps = Gaps()
    return sum(gaps.numbered("r1", Kind.POINTS, number) for number in numbers)


def lost_of_kinds(messages: list[tuple[Kind, int]]) -> int:
    gaps = Gaps()
    return sum(gaps.numbered("r1", kind, number) for kind, number in messages)


@pytest.mark.parametrize(
    ("numbers", "expected"),
    [
        ([*range(20)], 0),
        ([*range(1000, 1003), *range(20)], 0),  # a restart
        ([*range(20), *range(20), *range(20)], 0),
        ([*range(9), *range(9), 10], 1),
        ([*range(10), *range(13, 16)], 3),  # one publisher for long: known at once
        ([3, 4, 7], 0),  # another's number, perhaps
        ([3, 4, 7, *range(8, 8 + WAIT)], 2),
        ([*range(0, 60, 3)], 2 * (19 - WAIT)),  # the last ones are not known yet
        ([n for k in range(20) for n in (500 + k, k)], 0),
        ([n for k in range(20) for n in (k, 500 + k)], 0),
        ([n for k in range(20) for n in (k, k)], 0),
        ([n for k in range(20) for n in (k, k + 3)], 0),
        ([n for k in range(20) for n in (k, k + 1) if n != 7], 2),  # one of each
        ([n for k in range(30) for n in (k, 500 + k) if n != 507], 1),
        ([n for k in range(30) for n in (k, 500 + k) if n not in (7, 8, 9, 510)], 4),
        ([0, 2**64 - 1, 5, 2**63, 2**63 + MAX_GAP + 1, *range(6, 6 + WAIT)], 4),
    ],
)
def test_what_is_lost(numbers: list[int], expected: int) -> None:
    assert lost(numbers) == expected


@examples(300)
@given(
    st.lists(st.integers(0, 2**40), min_size=1, max_size=3, unique=True),
    st.lists(st.integers(0, 2), max_size=80),
    st.lists(st.tuples(st.integers(0, 79), st.integers(0, 2)), max_size=3),
)
def test_where_nothing_is_lost_nothing_is_counted(
    starts: list[int], turns: list[int], restarts: list[tuple[int, int]]
) -> None:
    """Up to three publishers in any order, none silent for long, each with a count of its own; some restart."""
    nexts = list(starts)
    order = [*range(len(starts)), *(turn % len(starts) for turn in turns)]
    told, silent = [], dict.fromkeys(range(len(starts)), 0)
    for at, turn in enumerate(order):
        late = max(silent, key=lambda who: silent[who])
        who = late if silent[late] >= WAIT - 2 else turn
        silent = {other: 0 if other == who else n + 1 for other, n in silent.items()}
        for when, restarted in restarts:
            if when == at and restarted % len(starts) == who and at > 3 * WAIT:
                nexts[who] = 0
        told.append(nexts[who])
        nexts[who] += 1
    assert lost(told) == 0


@examples(300)
@given(st.integers(0, 2**40), st.lists(st.booleans(), max_size=100), st.integers(0, 5))
def test_of_one_publisher_every_loss_is_counted(start: int, arrives: list[bool], first: int) -> None:
    """Once enough came after it."""
    sent = [True, *arrives, *[True] * (WAIT + 1)]
    numbers = [start + k for k, came in enumerate(sent) if came]
    assert lost(numbers) == len(sent) - len(numbers)


@examples(200)
@given(st.lists(st.sampled_from([(True, True), (True, True), (True, False), (False, True)]), max_size=60), st.data())
def test_of_two_publishers_that_take_turns(arrives: list[tuple[bool, bool]], data: st.DataObject) -> None:
    """Their counts far apart: every loss of either is counted."""
    quiet = (True, True)  # neither loses more than three messages in a row
    sent = [quiet] * 3 + [quiet if k % 4 == 3 else came for k, came in enumerate(arrives)] + [quiet] * 2 * WAIT
    apart = data.draw(st.integers(1000, 2**30))
    numbers = [n for k, came in enumerate(sent) for n, here in zip((k, apart + k), came, strict=True) if here]
    assert lost(numbers) == 2 * len(sent) - len(numbers)


SCANS, POSES = Kind.POINTS, Kind.ODOMETRY


@pytest.mark.parametrize("rate", [1, 5, 50])
@pytest.mark.parametrize(("scans", "poses"), [(0, 0), (7, 500), (500, 7), (500, 500), (0, 1), (1, 0)])
def test_a_count_for_each_kind(rate: int, scans: int, poses: int) -> None:
    """Many poses to a cloud: nothing is lost but the two clouds and two poses that are left out."""
    messages = []
    for k in range(60):
        messages.append((SCANS, scans + k))
        messages += [(POSES, poses + rate * k + n) for n in range(rate)]
    assert lost_of_kinds(messages) == 0
    gone = [(SCANS, scans + 20), (SCANS, scans + 21), (POSES, poses + rate * 30), (POSES, poses + rate * 31)]
    found = lost_of_kinds([message for message in messages if message not in gone])
    assert 2 <= found <= 4, "one kind's number may pass for the other's"


@examples(200)
@given(
    st.integers(0, 2**40),
    st.lists(st.tuples(st.sampled_from(Kind), st.booleans()), max_size=100),
    st.lists(st.sampled_from(Kind), min_size=8 * WAIT, max_size=8 * WAIT),
)
def test_one_count_for_all_kinds(start: int, sent: list[tuple[Kind, bool]], rest: list[Kind]) -> None:
    whole = [(kind, start + n) for n, kind in enumerate([*(kind for kind, _ in sent), *rest])]
    assert lost_of_kinds(whole) == 0
    came = [*(here for _, here in sent), *[True] * len(rest)]
    some = [message for message, here in zip(whole, came, strict=True) if here]
    assert lost_of_kinds(some) <= len(whole) - len(some)


def test_where_zenoh_names_the_publisher() -> None:
    gaps = Gaps()
    sent = [("a", 5), ("b", 0), ("a", 6), ("b", 3), ("a", 8), ("a", 0), ("a", 1), ("a", 2**32 - 1), ("a", 0)]
    assert [gaps.sourced(KEY, *one) for one in sent] == [0, 0, 0, 2, 1, 0, 0, 2**32 - 3, 0]
    assert gaps.sourced("robots/r2/points", "a", 7) == 0, "on another key it is another one"
    assert gaps.numbered("r1", Kind.POINTS, 7) == 0


def test_who_was_silent_longest_is_forgotten() -> None:
    """Names come from outside, so there is a limit on them."""
    gaps = Gaps(max_publishers=2)
    for robot, number, expected in (("a", 0, 0), ("b", 0, 0), ("a", 2, 1), ("c", 0, 0), ("b", 2, 0), ("c", 2, 1)):
        assert gaps.sourced(robot, "", number) == expected, (robot, number)
    for number in range(WAIT):
        for robot in ("a", "b"):
            gaps.numbered(robot, Kind.POINTS, number)
    assert gaps.numbered("b", Kind.POINTS, WAIT + 1) == 1
    assert gaps.numbered("c", Kind.POINTS, 0) == 0
    assert gaps.numbered("a", Kind.POINTS, WAIT + 1) == 0
