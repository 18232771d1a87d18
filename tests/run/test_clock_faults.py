"""Robots whose clocks are wrong, against where they truly were: what is placed is in its place, and little is lost."""

from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import examples
from robot_walks import Clock, Drive, Outcome, play

ROUNDING = 1e-6
"""Metres: stamps are rounded to ns, and a robot moves 1e-8 m in one; the rest is room for the interpolation's bits."""


def run(drive: Drive, seed: int = 0) -> Outcome:
    """Return what becomes of a drive's messages."""
    with TemporaryDirectory() as folder:
        return play(drive.messages(seed), Path(folder, "log"))


def steps(*given: tuple[float, float]) -> Clock:
    """Return a clock that at each of these times leaps by so much, both in s."""
    return lambda t: t + sum(by for at, by in given if t >= at)


@pytest.mark.parametrize("hz", [10.0, 50.0])
@pytest.mark.parametrize("by", [-10.5, -5.9, -4.02, -4.0, -1.5, -0.8, -0.33, -0.29, -0.12, -0.05, 0.3, 3.0, 30.0])
def test_a_step_of_the_robots_clock(hz: float, by: float) -> None:
    """No point is further from its place than the robot moves in one odometry period, and a second of scans is lost."""
    drive = Drive(odometry_hz=hz, clock=steps((6.0, by)), seconds=14.0)
    found = run(drive)
    assert found.worst <= drive.speed / hz + ROUNDING
    assert Counter(found.outcomes)["integrated"] >= 14 * 10 - 12


@pytest.mark.parametrize("latency", [0.0, 0.35])
@pytest.mark.parametrize(("by", "hz"), [(-0.19, 10.0), (-0.11, 50.0), (-0.3, 50.0), (-0.45, 50.0)])
def test_scans_that_come_long_after_the_poses_of_a_new_time(by: float, hz: float, latency: float) -> None:
    """Scans made before a clock went back arrive after it did: poses of the new time must not place them."""
    drive = Drive(odometry_hz=hz, clock=steps((6.0, by)), scan_latency=latency)
    found = run(drive)
    assert found.worst <= drive.speed / drive.odometry_hz + ROUNDING


CLOCKS = st.lists(st.tuples(st.floats(1.0, 9.0), st.floats(-11.0, 11.0)), max_size=3).map(lambda s: steps(*s))


@examples(40)
@given(
    st.builds(
        Drive,
        seconds=st.just(11.0),
        speed=st.floats(0.1, 3.0),
        odometry_hz=st.floats(8.0, 60.0),
        scan_hz=st.floats(3.0, 20.0),
        odometry_latency=st.floats(0.0, 0.05),
        scan_latency=st.floats(0.0, 0.3),
        clock=CLOCKS,
        wild=st.sampled_from([0.0, 0.0, 0.02, 0.1]),
        wild_by=st.floats(-4000.0, 4000.0),
        wild_scans=st.sampled_from([0.0, 0.0, 0.05]),
        lost=st.sampled_from([0.0, 0.0, 0.02]),
    ),
    st.integers(1, 1 << 30),
)
def test_whatever_a_robots_clock_does(drive: Drive, seed: int) -> None:
    """Steps, wild stamps and losses together: nothing that is placed is further off than one odometry period's way.

    A lost odometry message makes that period longer, so those around the scan count.
    """
    found = run(drive, seed)
    periods = 1.0 if not drive.lost and not drive.wild else 4.0
    assert found.worst <= drive.speed * periods / drive.odometry_hz + ROUNDING


@pytest.mark.parametrize("share", [0.01, 0.125])
@pytest.mark.parametrize("by", [3600.0, -3600.0, 2.0, -2.0, 0.3, -0.3])
def test_wild_stamps_cost_themselves_alone(share: float, by: float) -> None:
    """Wild odometry costs no scan (but the last, whose poses may be it); wild scans cost those scans."""
    found = run(Drive(wild=share, wild_by=by))
    assert found.worst <= 1.0 / 20 + ROUNDING
    assert Counter(found.outcomes)["integrated"] >= 118
    drive = Drive(wild_scans=share, wild_by=by)
    found, wild = run(drive), sum(m.wild for m in drive.messages())
    assert found.worst <= 1.0 / 20 + ROUNDING
    assert Counter(found.outcomes)["integrated"] >= 120 - wild


@pytest.mark.parametrize("since", [0.0, 6.0])
def test_stamps_that_stand_still(since: float) -> None:
    """Nothing is placed at the last pose for ever: with frozen odometry nothing more, with frozen scans the first."""
    still: Clock = lambda t: min(t, since)  # noqa: E731
    for drive in (Drive(clock=still), Drive(clock=still, scan_clock=lambda t: t)):
        found = run(drive)
        assert found.worst <= 1.0 / 20 + ROUNDING
        assert Counter(found.outcomes)["integrated"] <= since * 10 + 1
    found = run(Drive(scan_clock=still))
    assert found.worst <= 0.3, "three scans, or what comes in 0.2 s, may have one stamp"
    assert Counter(found.outcomes)["clock_offset"] >= (12.0 - since) * 10 - 5


@pytest.mark.parametrize("by", [-4.0, -1.5, -0.8, 3.0])
def test_a_sensors_clock_that_leaps_alone(by: float) -> None:
    """Beyond 0.5 s its scans are refused, at once or, ahead, as long as there are no poses yet."""
    found = run(Drive(seconds=20.0, scan_clock=steps((10.0, by))))
    assert found.worst <= 1.0 / 20 + ROUNDING
    assert Counter(found.outcomes)["integrated"] == 100
    assert Counter(found.outcomes)["clock_offset"] >= 50


@pytest.mark.parametrize("by", [-0.4, -0.1, 0.1, 0.4])
def test_a_sensors_clock_that_leaps_by_little_alone(by: float) -> None:
    """It is not refused: its scans are off by its error."""
    found = run(Drive(seconds=20.0, scan_clock=steps((10.0, by))))
    assert found.worst <= abs(by) + ROUNDING
    assert Counter(found.outcomes)["integrated"] >= 190


@pytest.mark.parametrize("latency", [0.0, 0.05, 0.3, 0.45])
@pytest.mark.parametrize("rates", [(10.0, 5.0), (10.0, 20.0), (100.0, 10.0)])
def test_a_healthy_robot_loses_nothing(latency: float, rates: tuple[float, float]) -> None:
    """All scans are placed but those whose poses come after the end."""
    drive = Drive(scan_latency=latency, odometry_hz=rates[0], scan_hz=rates[1])
    found = run(drive)
    assert found.worst <= ROUNDING
    assert Counter(found.outcomes)["integrated"] >= len(found.outcomes) - 2
