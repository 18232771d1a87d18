"""What happened lately: counted, listed for a minute, told once a minute, and bounded."""

from collections import Counter
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from roughmap_service.inputs.recent import LISTED, MAX_KEPT, MAX_LISTED, MAX_OF_ROBOT, Recent
from roughmap_service.inputs.remedies import Subject

A, B = Subject("a"), Subject("b", "lidar")


def say(text: str) -> Callable[[], str]:
    return lambda: text


def test_what_happened_last_comes_first() -> None:
    now = 0.0
    recent = Recent(lambda: now)
    assert recent.add(A, "leap", say("robot a: leapt")) == "robot a: leapt"
    now = 2.0
    recent.add(B, "gap", say("3 lost"))
    now = 5.0
    recent.add(A, "clock", say("robot a: its clock was set"))
    assert recent.add(B, "gap", say("4 lost")) is None
    assert recent.add(B, "gap", say("never asked for")) is None
    now = 6.0
    assert recent.told() == [
        "4 lost (3 times, last 1 s ago)", "robot a: its clock was set (1 s ago)", "robot a: leapt (6 s ago)",
    ]  # fmt: skip
    recent.drop(A, "leap")
    assert len(recent.told()) == 2


def test_what_goes_on_is_told_once_a_minute() -> None:
    now = 0.0
    recent = Recent(lambda: now)
    told = 0
    for second in range(600):
        now = float(second)
        told += recent.add(A, "gap", say("lost")) is not None
    assert told == 600 / LISTED


def test_one_robot_leaves_room_for_the_others() -> None:
    recent = Recent(lambda: 0.0)
    recent.add(A, "leap", say("leapt"))
    for number in range(10 * MAX_KEPT):
        recent.add(Subject("b", f"frame {number}"), "late", say("late"))
    told = recent.told()
    assert len(told) == MAX_OF_ROBOT + 1 <= MAX_LISTED
    assert "leapt (0 s ago)" in told


def test_a_sentence_that_cannot_be_made_costs_nothing_else() -> None:
    recent = Recent(lambda: 0.0)
    recent.add(A, "leap", say("leapt"))

    def fails() -> str:
        raise KeyError("x")

    with pytest.raises(KeyError):
        recent.add(B, "leap", fails)
    assert recent.told() == ["leapt (0 s ago)"]


@given(
    st.lists(st.tuples(st.integers(0, 50), st.integers(0, 20), st.floats(0.0, 40.0)), max_size=200),
    st.floats(0.0, 2 * LISTED),
)
def test_it_lists_the_newest_of_the_last_minute(happened: list[tuple[int, int, float]], later: float) -> None:
    now = 0.0
    recent = Recent(lambda: now)
    last: dict[tuple[int, int], float] = {}
    for robot, name, step in happened:
        now += step
        last = {one: at for one, at in last.items() if now - at <= LISTED}
        last.pop((robot, name), None)
        if sum(one[0] == robot for one in last) >= MAX_OF_ROBOT:
            del last[next(one for one in last if one[0] == robot)]
        last[robot, name] = now
        recent.add(Subject(f"{robot}"), f"{name}", say(f"{robot} {name}"))
    now += later
    kept = [one for one in reversed(last) if now - last[one] <= LISTED]
    told = recent.told()
    shown = kept if len(kept) <= MAX_LISTED else kept[: MAX_LISTED - 1]
    assert [text.split(" (")[0] for text in told[: len(shown)]] == [f"{robot} {name}" for robot, name in shown]
    assert len(told) <= MAX_LISTED
    if len(kept) > MAX_LISTED:
        assert told[-1].startswith(f"{len(kept) - len(shown)} more events")
    assert not any(number > 1 for number in Counter(told).values())
