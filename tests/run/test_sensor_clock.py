"""A sensor's clock against its robot's: what falls back, stands still or leaps alone, and what only looks like it."""

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import examples
from robot_walks import Drive, play
from service_tools import LEVEL, PRECISE, config

from roughmap_schemas import CloudReason, Odometry
from roughmap_service.run.odometry_clock import BACK_FENCE_NS, OdometryClock, Verdict
from roughmap_service.run.robot import Robot
from roughmap_service.run.sensor_clock import LIMIT_NS, LONG_ROW, SETTLED, Doubt, SensorClock
from roughmap_service.run.settings import Settings

NS = 10**9
START = 1000.0
"""Stamp of the first message, in s."""

Clock = Callable[[float], float]
"""From the true time in s to a stamp or an arrival in s."""


def ns(t: float) -> int:
    return round(t * NS)


def true(t: float) -> float:
    return t


def leaps(at: float, by: float) -> Clock:
    """A clock that leaps once."""
    return lambda t: t + (by if t >= at else 0.0)


@dataclass
class Heard:
    """A sensor at 10 Hz beside odometry at 20 Hz; clouds without a doubt are integrated."""

    clock: OdometryClock = field(default_factory=OdometryClock)
    sensor: SensorClock = field(default_factory=SensorClock)
    doubts: dict[float, Doubt | None] = field(default_factory=dict)
    number: int = 0

    def odometry(self, stamp: float, arrival: float) -> None:
        self.number += 1
        self.clock.take(ns(START + stamp), 0)
        self.sensor.odometry(ns(START + stamp), ns(arrival))

    def cloud(self, stamp: float, arrival: float) -> Doubt | None:
        self.number += 1
        doubt = self.sensor.cloud(self.number, ns(START + stamp), ns(arrival), self.clock)
        if doubt is None:
            self.sensor.count_integrated()
        return doubt

    def play(
        self, seconds: float, *, first: float = 0.0, scans: Clock = true, late: Clock = lambda _: 0.1,
        speed: float = 1.0,
    ) -> "Heard":  # fmt: skip
        """Clouds with the stamps of the clock ``scans``, ``late`` by so much; all arrive ``speed`` times as fast."""
        begin, end = round(first * 20), round((first + seconds) * 20)
        rows = [(k / 20 + 0.01, 0, k / 20) for k in range(begin, end)]
        rows += [(k / 20 + 0.003 + late(k / 20), 1, k / 20 + 0.003) for k in range(begin, end, 2)]
        for arrival, kind, t in sorted(rows):
            if kind:
                self.doubts[t] = self.cloud(scans(t), arrival / speed)
            else:
                self.odometry(t, arrival / speed)
        return self

    def since(self, t: float) -> list[Doubt | None]:
        return [doubt for at, doubt in self.doubts.items() if at >= t]

    @property
    def offset(self) -> float:
        return self.sensor.offset_ns / NS


OFFSET = Doubt(CloudReason.CLOCK_OFFSET)


@pytest.mark.parametrize("late", [0.0, 0.1, 0.45, 3.0])
def test_a_clock_that_agrees_is_in_no_doubt(late: float) -> None:
    heard = Heard().play(12.0, late=lambda _: late)
    assert set(heard.doubts.values()) == {None}
    assert heard.offset == 0.0
    assert heard.sensor.usual_ns == pytest.approx(ns(late - 0.01), abs=2), "the usual way is that of the first windows"


@pytest.mark.parametrize("by", [-0.55, -0.8, -4.0, -300.0])
def test_one_that_falls_back_alone_is_refused(by: float) -> None:
    """The first cloud waits, as the robot's clock may follow; once it took poses without, the sensor's is off."""
    heard = Heard().play(8.0, scans=leaps(5.0, by))
    first, *others = heard.since(5.0)
    assert first is not None
    assert (first.reason, first.far) == (None, True)
    refused = others.index(OFFSET)
    assert refused <= 2
    assert all(doubt is not None and doubt.far for doubt in others[:refused])
    assert set(others[refused:]) == {OFFSET}
    assert heard.sensor.differs
    assert heard.offset == pytest.approx(by, abs=0.25), "as far as two clouds' distance and jitter tell"


def test_one_that_falls_back_by_less_is_not_refused() -> None:
    """Of its clouds the first alone waits; the offset is known."""
    heard = Heard().play(8.0, scans=leaps(5.0, -0.45))
    first, *others = heard.since(5.0)
    assert first is not None
    assert (first.reason, first.far) == (None, False)
    assert set(others) == {None}
    assert not heard.sensor.differs
    assert heard.offset == pytest.approx(-0.45, abs=0.15)


@pytest.mark.parametrize("by", [-0.3, -0.15])
def test_one_that_falls_back_by_little_is_jitter(by: float) -> None:
    """Its stamps soon pass those before."""
    heard = Heard().play(8.0, scans=leaps(5.0, by))
    first, *others = heard.since(5.0)
    assert first is not None
    assert (first.reason, first.far) == (None, False)
    assert set(others) == {None}
    assert heard.offset == 0.0


def test_one_that_fell_back_and_agrees_again() -> None:
    """Someone set it: by its arrivals, within two windows."""
    heard = Heard().play(20.0, scans=lambda t: t - (3.0 if 8.0 <= t < 12.0 else 0.0))
    assert OFFSET in heard.since(8.0)
    assert set(heard.since(17.0)) == {None}
    assert heard.offset == 0.0


def test_while_odometry_is_in_doubt_nothing_shows_a_sensor_s_clock() -> None:
    """Both may have gone back, and the robot's is not believed yet. Without any odometry, ten in a row do."""
    heard = Heard().play(5.0)
    heard.clock.doubted = heard.number
    found = [heard.cloud(1.0 + 0.1 * k, 5.1 + 0.1 * k) for k in range(LONG_ROW)]
    assert [one is not None and one.far for one in found[:-1]] == [True] * (LONG_ROW - 1)
    assert found[-1] == OFFSET


@pytest.mark.parametrize("by", [3600.0, 3.0, -3.0, -3600.0])
def test_wild_stamps_cost_themselves_alone(by: float) -> None:
    """One in ten: those ahead find no poses, those behind are refused; others at most wait for three poses."""
    wild = {k / 10 + 0.003 for k in range(20, 80, 10)}
    heard = Heard().play(10.0, scans=lambda t: t + (by if round(t, 3) in {round(w, 3) for w in wild} else 0.0))
    assert heard.offset == 0.0
    for t, doubt in heard.doubts.items():
        if round(t, 3) not in {round(w, 3) for w in wild}:
            assert doubt is None or (doubt.reason, doubt.far) == (None, False)
        elif by < 0.0:
            assert doubt is not None
            assert doubt.far


def test_a_clock_that_stands_still_is_refused() -> None:
    """From the third cloud of one stamp on, while poses go on; until it moves again."""
    heard = Heard().play(8.0, scans=lambda t: 4.003 if 4.0 <= t < 6.0 else t)
    still = [doubt for t, doubt in heard.doubts.items() if 4.0 <= t < 6.0]
    allowed = still.index(OFFSET)
    assert 2 <= allowed <= 4
    assert set(still[allowed:]) == {OFFSET}
    assert set(heard.since(6.0)) == {None}


def test_two_clouds_of_one_stamp_are_no_sign() -> None:
    """A driver may send a sweep in two halves, long after each other."""
    heard = Heard().play(3.0)
    assert heard.cloud(3.0, 3.1) is None
    heard.odometry(3.4, 3.41)
    assert heard.cloud(3.0, 3.5) is None
    assert heard.cloud(3.0, 3.6) == OFFSET


def test_one_stamp_without_poses_is_one_moment() -> None:
    """Four lidars' clouds under one frame, or a rotating one's slices, stamped alike; no pose came between."""
    heard = Heard().play(3.0)
    assert [heard.cloud(3.0, 3.1 + 0.01 * k) for k in range(6)] == [None] * 6


@pytest.mark.parametrize("by", [0.7, 3.0, 100.0])
def test_one_that_leaps_ahead_is_refused_by_its_arrivals(by: float) -> None:
    """Its clouds come before odometry of their time could: two windows show it."""
    heard = Heard().play(20.0, scans=leaps(10.0, by))
    refused = [t for t, doubt in heard.doubts.items() if doubt == OFFSET]
    assert refused
    assert 12.0 < min(refused) < 18.0
    assert heard.offset == pytest.approx(by, abs=0.05)
    assert set(heard.since(min(refused))) == {OFFSET}


def test_one_that_leaps_ahead_by_less_is_not_refused() -> None:
    heard = Heard().play(20.0, scans=leaps(10.0, 0.4))
    assert set(heard.doubts.values()) == {None}
    assert heard.offset == pytest.approx(0.4, abs=0.05)


def test_a_rise_of_latency_is_no_sign() -> None:
    """A later cloud took longer; its stamp is as good as before."""
    heard = Heard().play(20.0, late=lambda t: 0.1 if t < 8.0 else 2.0)
    assert set(heard.doubts.values()) == {None}
    assert heard.offset == 0.0


def test_a_queue_that_drains_is_no_sign() -> None:
    """Clouds that took 2 s at first, and none later, come sooner than they used to; but never before the odometry."""
    heard = Heard().play(20.0, late=lambda t: max(2.0 - max(t - 8.0, 0.0), 0.05))
    assert heard.sensor.usual_ns == pytest.approx(ns(1.99), abs=2)
    assert set(heard.doubts.values()) == {None}
    assert heard.offset == 0.0


@pytest.mark.parametrize("speed", [0.2, 0.5, 2.0, 10.0, 1e6])
def test_a_recording_at_another_speed_says_nothing(speed: float) -> None:
    """Its arrivals are not those of the robot; nor does a leap ahead within it say anything."""
    heard = Heard().play(40.0, speed=speed)
    assert set(heard.doubts.values()) == {None}
    assert heard.sensor.usual_ns is None
    heard = Heard().play(40.0, speed=speed, scans=leaps(20.0, 3.0))
    assert heard.offset == 0.0


def test_a_recording_that_is_paused_says_nothing() -> None:
    heard = Heard().play(10.0)
    usual = heard.sensor.usual_ns
    for k in range(200):  # goes on an hour later, as if nothing had been
        t = 10.0 + 0.1 * k
        heard.odometry(t, t + 3600.01)
        assert heard.cloud(t + 0.003, t + 3600.1) is None
    assert usual is not None
    assert heard.offset == 0.0


def test_nothing_is_usual_before_ten_clouds_are_in_the_map() -> None:
    heard = Heard()
    heard.sensor.integrated = -100
    heard.play(10.0)
    assert heard.sensor.usual_ns is None
    heard.sensor.integrated = SETTLED
    heard.play(10.0, first=10.0)
    assert heard.sensor.usual_ns is not None


class TestWithTheRobot:
    """The robot's clock goes back, and its sensors' before, with or after it."""

    def heard(self) -> tuple[Robot, SensorClock]:
        robot = Robot(Settings(config()), "rover")
        sensor = robot.sensors["lidar"] = SensorClock()
        for k in range(40):
            self.odometry(robot, 2 * k + 1, 0.1 * k)
            assert sensor.cloud(2 * k + 2, ns(START + 0.1 * k), 0, robot.clock) is None
        return robot, sensor

    def odometry(self, robot: Robot, number: int, t: float) -> Verdict:
        message = Odometry(ns(START + t), "map", "base", (0.0, 0.0, 0.0), LEVEL, PRECISE)
        return robot.take_odometry(message, number, 0).verdict

    def back(self, robot: Robot, number: int, t: float) -> None:
        verdicts = [self.odometry(robot, number + k, t + 0.1 * k) for k in range(3)]
        assert verdicts == [Verdict.HOLD, Verdict.HOLD, Verdict.BACK]

    def test_a_sensor_that_fell_since_is_of_the_new_time(self) -> None:
        robot, sensor = self.heard()
        assert self.odometry(robot, 90, 1.0) is Verdict.HOLD
        doubt = sensor.cloud(91, ns(START + 1.0), 0, robot.clock)
        assert doubt is not None, "alone it would be off"
        assert self.odometry(robot, 92, 1.1) is Verdict.HOLD
        assert self.odometry(robot, 93, 1.2) is Verdict.BACK
        assert not sensor.fenced
        assert sensor.cloud(94, ns(START + 1.1), 0, robot.clock) is None
        assert sensor.offset_ns == 0

    def test_one_that_fell_before_the_last_pose_is_not(self) -> None:
        """A pose went on after it: it fell alone."""
        robot, sensor = self.heard()
        sensor.cloud(90, ns(START + 1.0), 0, robot.clock)
        self.odometry(robot, 91, 4.0)
        self.back(robot, 92, 1.0)
        assert sensor.fenced
        assert sensor.cloud(95, ns(START + 1.1), 0, robot.clock) == Doubt(CloudReason.CLOCK_RESET)

    def test_one_that_has_not_fallen_waits_for_it(self) -> None:
        """Clouds on their way are of the clock before; the first that falls is of the new one."""
        robot, sensor = self.heard()
        self.back(robot, 91, 1.0)
        for k in range(3):
            doubt = sensor.cloud(100 + k, ns(START + 4.0 + 0.1 * k), 0, robot.clock)
            assert doubt == Doubt(CloudReason.CLOCK_RESET)
        assert sensor.cloud(110, ns(START + 1.3), 0, robot.clock) is None
        assert not sensor.fenced

    def test_one_that_never_falls_is_believed_once_the_poses_went_on(self) -> None:
        """Its clock may have gone back before it was first heard: for ever refused it would be lost."""
        robot, sensor = self.heard()
        self.back(robot, 91, 1.0)
        assert robot.clock.fence_ns == ns(START + 1.0) + BACK_FENCE_NS
        assert sensor.cloud(100, ns(START + 4.0), 0, robot.clock) == Doubt(CloudReason.CLOCK_RESET)
        for k in range(8):
            self.odometry(robot, 101 + k, 1.3 + 0.1 * k)
        assert sensor.cloud(110, ns(START + 4.1), 0, robot.clock) is None

    def test_a_sensor_that_is_first_heard_later_is_of_the_new_time(self) -> None:
        robot, _ = self.heard()
        self.back(robot, 91, 1.0)
        assert SensorClock().cloud(100, ns(START + 1.1), 0, robot.clock) is None


def test_the_map_was_emptied() -> None:
    """The same recording again: its clouds begin behind the last ones, and nothing is in doubt for it."""
    robot = Robot(Settings(config()), "rover")
    heard = Heard(robot.clock, robot.sensors.setdefault("lidar", SensorClock())).play(8.0, scans=leaps(5.0, -4.0))
    assert heard.sensor.differs
    robot.begin_map(heard.number + 1)
    assert [heard.cloud(0.1 * k, 8.0 + 0.1 * k) for k in range(5)] == [None] * 5


@pytest.mark.parametrize("off", [-4.0, -0.7])
def test_an_offset_that_is_configured_is_taken_off(off: float, tmp_path: Path) -> None:
    """What a sensor was refused for, `time_offset` mends: it is compared with the offset added."""
    drive = Drive(seconds=10.0, scan_clock=lambda t: t + off)
    sensor = {"lidar": {"range_sigma": 0.01, "time_offset": -off}}
    good = play(drive.messages(), tmp_path / "good", config(sensors=sensor))
    assert good.outcomes.count("integrated") >= 98
    twice = Drive(seconds=10.0, scan_clock=lambda t: t + (off if t < 5.0 else 0.0))
    bad = play(twice.messages(), tmp_path / "bad", config(sensors=sensor))
    assert bad.outcomes.count("integrated") <= 52


messages = st.lists(
    st.tuples(
        st.booleans(),  # a cloud, or odometry
        st.sampled_from([0.0, 0.05, 0.1, 0.1, 0.1, 0.5, 2.0]),  # seconds to the next arrival
        st.sampled_from([0.0] * 8 + [-0.1, -0.3, 0.3, -0.7, 0.7, -4.0, 4.0, 3600.0]),  # how far off its stamp is
        st.booleans(),  # so it stays
    ),
    max_size=80,
)


@examples(200)
@given(messages, st.integers(0, 80))
def test_the_state_goes_through_json(row: list[tuple[bool, float, float, bool]], stored: int) -> None:
    """Restored anywhere, a clock goes on as if it had not been; figures stay bounded."""
    heard, again = Heard(), Heard()
    now, off = 0.0, 0.0
    for number, (cloud, step, by, stays) in enumerate(row):
        if number == stored:
            state = json.loads(json.dumps(heard.sensor.to_state(), allow_nan=False))
            again.sensor = SensorClock.of_state(state)
        now += step
        off += by if stays else 0.0
        stamp = now + off + (0.0 if stays else by)
        if cloud:
            doubt = heard.cloud(stamp, now)
            assert again.cloud(stamp, now) == doubt
            if doubt is not None:
                state = json.loads(json.dumps(doubt.to_state()))
                assert Doubt.of_state(state) == doubt
            if heard.sensor.differs:
                assert doubt == OFFSET
                assert abs(heard.sensor.offset_ns) > LIMIT_NS
        else:
            for one in (heard, again):
                one.odometry(now, now)
        assert again.sensor.to_state() == heard.sensor.to_state()
        assert 0 <= heard.sensor.integrated <= SETTLED


@pytest.mark.parametrize(("seconds", "shown"), [(1.0, False), (3.0, True)])
def test_a_rise_of_one_window_is_not_enough(seconds: float, shown: bool) -> None:
    """Two windows in a row must show it: one may have been a clock that was set forward and back."""
    heard, offsets = Heard().play(10.0), []
    for k in range(100, 160):
        heard.play(0.1, first=k / 10, scans=lambda t: t + (0.25 if 10.5 <= t < 10.5 + seconds else 0.0))
        offsets.append(heard.sensor.offset_ns)
    assert (max(offsets) > 0) is shown
