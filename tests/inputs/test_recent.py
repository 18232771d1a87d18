"""What happened lately: counted, listed for a minute, and bounded."""

from collections.abc import Callable

from hypothesis import given
from hypothesis import strategies as st

from roughmap_service.inputs.recent import LISTED, MAX_LISTED, Recent


def say(text: str) -> Callable[[], str]:
    return lambda: text


def test_what_happened_last_comes_first_and_subjects_come_once() -> None:
    now = 0.0
    recent = Recent(lambda: now)
    assert recent.add("robot a", "leap", say("robot a: leapt")) == "robot a: leapt"
    now = 2.0
    recent.add("robot b", "gap", say("robot b: 3 poses lost"))
    now = 5.0
    recent.add("robot a", "clock", say("robot a: its clock was set"))
    assert recent.add("robot b", "gap", say("robot b: 4 poses lost")) is None
    assert recent.add("robot b", "gap", say("never asked for")) is None
    now = 6.0
    assert list(recent.told().items()) == [
        ("robot b", "robot b: 4 poses lost (3 times, last 1 s ago)"),
        ("robot a", "robot a: its clock was set (1 s ago); leapt (6 s ago)"),
    ]


@given(
    st.lists(st.tuples(st.integers(0, 50), st.integers(0, 3), st.floats(0.0, 40.0)), max_size=200),
    st.floats(0.0, 2 * LISTED),
)
def test_it_lists_the_newest_of_the_last_minute(happened: list[tuple[int, int, float]], later: float) -> None:
    now = 0.0
    recent = Recent(lambda: now)
    last: dict[tuple[str, str], float] = {}
    for robot, name, step in happened:
        now += step
        one = f"robot {robot}", f"event {name}"
        last.pop(one, None)
        last[one] = now
        recent.add(*one, say(f"{one[0]}: {one[1]}"))
    now += later
    newest = list(last)[-MAX_LISTED:]
    expected = {one for one in newest if now - last[one] <= LISTED}
    told = recent.told()
    found = {
        (subject, part.split(" (")[0].removeprefix(f"{subject}: "))
        for subject, text in told.items()
        for part in text.split("; ")
    }
    assert found == expected
