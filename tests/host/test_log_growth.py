"""How fast the log grows, and how long its disk lasts: by sizes that are known, and in words."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import examples

from roughmap_service.host.log_growth import LogGrowth, growth_text, hours_to_full

MB = 10**6


class Clock:
    """A clock that is set."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


def test_the_first_10_s_say_nothing() -> None:
    clock = Clock()
    growth = LogGrowth(clock)
    told = []
    for second in range(13):
        clock.now = 1000.0 + second
        told.append(growth.per_hour(500 + second * MB))
    assert told == [None] * 10 + [3600 * MB] * 3


def test_it_counts_the_last_5_minutes() -> None:
    """A robot that sent 1 MB a second and then nothing: half of the window, and later none of it, has growth."""
    clock = Clock()
    growth = LogGrowth(clock)
    told = {}
    for second in range(1001):
        clock.now = 1000.0 + second
        told[second] = growth.per_hour(min(second, 500) * MB)
    assert told[500] == pytest.approx(3600 * MB, rel=0.01)
    assert told[650] == pytest.approx(1800 * MB, rel=0.03)
    assert told[1000] == 0


@given(st.lists(st.floats(0.01, 20.0), min_size=2, max_size=200), st.floats(0.0, 1e9))
@examples(50)
def test_a_steady_growth_is_told_however_often_it_is_asked(steps: list[float], rate: float) -> None:
    clock = Clock()
    growth = LogGrowth(clock)
    for step in steps:
        clock.now += step
        found = growth.per_hour(round(rate * clock.now))
        assert found is None or found == pytest.approx(rate * 3600.0, rel=1e-6, abs=400)


def test_asked_a_million_times_it_keeps_what_it_needs() -> None:
    clock = Clock()
    growth = LogGrowth(clock)
    for n in range(100_000):
        clock.now += 0.01
        growth.per_hour(n)
    assert len(growth._sizes) <= 62


def test_hours_to_a_full_disk() -> None:
    assert hours_to_full(2 * MB, 5 * MB, None) == 2.5
    assert hours_to_full(2 * MB, 5 * MB, 1) is None, "log.keep bounds it"
    assert hours_to_full(0, 5 * MB, None) is None
    assert hours_to_full(None, 5 * MB, None) is None
    assert hours_to_full(2 * MB, None, None) is None


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ((None, None, None), ""),
        ((0, None, None), "0 kB an hour"),
        ((19_400_000_000, 0.5, None), "19.4 GB an hour, the disk is full in 30 minutes"),
        ((19_400_000_000, 20.4, None), "19.4 GB an hour, the disk is full in 20 hours"),
        ((1_250_000, 24 * 1234.0, None), "1.2 MB an hour, the disk is full in 1,234 days"),
        ((19_400_000_000, None, 10**12), "19.4 GB an hour, bounded to 1.0 TB by log.keep"),
    ],
)
def test_it_is_said(values: tuple[int | None, float | None, int | None], text: str) -> None:
    assert growth_text(*values) == text
