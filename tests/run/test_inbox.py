"""Every rule on clouds: what the inbox decides, when, and in which order."""

import math

import numpy as np
import pytest
from service_tools import LEVEL, PRECISE, SECOND, T0, config

from roughmap_schemas import Cloud, CloudReason, Odometry
from roughmap_service.run.inbox import INTEGRATED, Arrival, Inbox, LoggedCloud, Proposal
from roughmap_service.run.robot import OdometryTaken, Robot
from roughmap_service.run.sensor_clock import Doubt
from roughmap_service.run.sensor_times import BY_CONTRACT
from roughmap_service.run.settings import Settings

SETTINGS = Settings(
    config(input={"max_wait": 2.0, "max_pose_gap": 0.5, "pose_history": 10.0, "queue_limit": 1000,
                  "max_message": 1000, "max_speed": 30.0})
)  # fmt: skip


class Desk:
    """An inbox with its robots; seconds after T0 stand for stamps."""

    def __init__(self) -> None:
        self.robots: dict[str, Robot] = {}
        self.doubts: dict[int, Doubt] = {}
        self.inbox = Inbox(SETTINGS, self.robots, self.doubts)
        self.inputs = 0

    def pose(self, t: float, x: float = 0.0, robot: str = "a", turn: float = 0.0) -> OdometryTaken:
        self.inputs += 1
        if robot not in self.robots:
            self.robots[robot] = Robot(SETTINGS, robot)
        rotation = LEVEL if turn == 0.0 else (0.0, 0.0, math.sin(turn / 2), math.cos(turn / 2))
        message = Odometry(T0 + round(t * SECOND), "map", "base", (x, 0.0, 0.0), rotation, PRECISE)
        return self.robots[robot].take_odometry(message, self.inputs, message.stamp_ns)

    def drive(self, first: float, last: float, step: float = 0.1, robot: str = "a") -> None:
        """Poses from the first to the last time; the clock may have leapt before them."""
        for k in range(round((last - first) / step) + 1):
            self.pose(first + k * step, robot=robot)

    def cloud(self, t: float, until: float | None = None, robot: str = "a", now: float = 0.0, *, size: int = 100,
              ingested: bool = False, frame: str = "lidar") -> int:  # fmt: skip
        self.inputs += 1
        first = T0 + round(t * SECOND)
        last = first if until is None else T0 + round(until * SECOND)
        held = Cloud(frame, first, np.zeros((1, 3)), None)
        self.inbox.feed(
            LoggedCloud(self.inputs, robot, held, first, last, size, Arrival(now, promised=ingested), BY_CONTRACT)
        )
        return self.inputs

    def tick(self, now: float = 0.0) -> tuple[int, str] | None:
        decision = self.inbox.tick(now)
        return None if decision is None else (decision.cloud.input, decision.outcome)

    def all(self, now: float = 0.0) -> list[tuple[int, str]]:
        return list(iter(lambda: self.tick(now), None))  # type: ignore[arg-type]


def test_decided_once_the_poses_around_it_are_in() -> None:
    desk = Desk()
    number = desk.cloud(0.1, 0.2)
    desk.pose(0.1)
    assert desk.tick() is None
    desk.pose(0.15)
    assert desk.tick() is None
    desk.pose(0.25)
    decision = desk.inbox.tick(0.0)
    assert isinstance(decision, Proposal)
    assert (decision.cloud.input, decision.outcome) == (number, INTEGRATED)
    assert decision.poses == ((2, 0), (3, 0), (4, 0))
    assert (desk.inbox.queues, desk.inbox.size) == ({}, 0)


def test_an_exact_stamp_needs_no_second_pose() -> None:
    desk = Desk()
    desk.pose(0.1)
    assert desk.all() == []
    number = desk.cloud(0.1)
    assert desk.all() == [(number, INTEGRATED)]


def test_neighbours_too_far_apart() -> None:
    desk = Desk()
    for t in (0.0, 0.5, 1.001, 1.1, 1.2):
        desk.pose(t)
    within, over, after = desk.cloud(0.2), desk.cloud(0.6), desk.cloud(1.15)
    assert desk.all() == [(within, INTEGRATED), (over, CloudReason.POSE_GAP), (after, INTEGRATED)]


@pytest.mark.parametrize(("x", "turn"), [(0.41, 0.0), (0.0, 0.56)])
def test_neighbours_that_no_motion_explains(x: float, turn: float) -> None:
    """From standing, in 0.1 s: 0.3 m and 20 m/s^2 are 0.4 m, 0.3 rad and 50 rad/s^2 are 0.55 rad."""
    desk = Desk()
    for t in (0.0, 0.1, 0.2):
        desk.pose(t)
    leap = desk.pose(0.3, x, turn=turn).leap
    assert leap is not None
    assert (leap.metres, leap.radians) == (pytest.approx(x), pytest.approx(turn))
    desk.pose(0.4, x, turn=turn)
    before, jump, after = desk.cloud(0.15), desk.cloud(0.25), desk.cloud(0.35)
    assert desk.all() == [(before, INTEGRATED), (jump, CloudReason.POSE_JUMP), (after, INTEGRATED)]


@pytest.mark.parametrize(("x", "turn"), [(0.39, 0.0), (0.0, 0.54)])
def test_neighbours_that_a_motion_explains(x: float, turn: float) -> None:
    desk = Desk()
    for t in (0.0, 0.1, 0.2):
        desk.pose(t)
    assert desk.pose(0.3, x, turn=turn).leap is None
    number = desk.cloud(0.25)
    assert desk.all() == [(number, INTEGRATED)]


def test_a_gap_is_reported_before_a_jump() -> None:
    desk = Desk()
    desk.pose(0.0)
    for t in (1.0, 1.1, 1.2):
        desk.pose(t, 1000.0)
    number, after = desk.cloud(0.5), desk.cloud(1.15)
    assert desk.all() == [(number, CloudReason.POSE_GAP), (after, INTEGRATED)]


def test_waiting_in_vain() -> None:
    """The wait is the monotonic clock's, from the cloud's arrival; poses before or after alone don't help."""
    desk = Desk()
    number = desk.cloud(0.1, now=50.0)
    desk.pose(0.0)
    assert desk.inbox.deadline() == 52.0
    assert desk.tick(51.999) is None
    assert desk.tick(52.0) == (number, CloudReason.NO_POSE)
    assert desk.inbox.deadline() is None


def test_poses_that_begin_after_it() -> None:
    desk = Desk()
    number = desk.cloud(0.1)
    desk.pose(0.2)
    assert desk.tick(1.9) is None
    assert desk.tick(2.0) == (number, CloudReason.NO_POSE)


def test_older_than_the_pose_buffer() -> None:
    desk = Desk()
    desk.drive(0.0, 20.0)
    late, edge = desk.cloud(9.999), desk.cloud(10.0)
    assert desk.all() == [(late, CloudReason.LATE), (edge, INTEGRATED)]


def test_begun_before_the_pose_buffer_is_late_whole() -> None:
    """Though the pose that stays before the horizon would cover it: whether one stays there is chance."""
    desk = Desk()
    desk.drive(0.05, 20.0, 0.05)
    desk.pose(20.01)
    number = desk.cloud(10.005, 10.06)
    assert desk.robots["a"].buffer.covers(T0 + round(10.005 * SECOND), T0 + round(10.06 * SECOND))
    assert desk.all() == [(number, CloudReason.LATE)]


def test_a_cloud_in_the_maps_frame_waits_for_no_pose() -> None:
    desk = Desk()
    number = desk.cloud(0.1, frame="map")
    assert desk.all() == [(number, INTEGRATED)]


def test_order_of_arrival_within_a_sensor() -> None:
    """One that could be decided waits behind one that can't, though it be timed out."""
    desk = Desk()
    first, second = desk.cloud(5.0, now=1.0), desk.cloud(0.05, now=0.0)
    desk.pose(0.0)
    desk.pose(0.1)
    assert desk.tick(2.5) is None
    assert desk.all(3.0) == [(first, CloudReason.NO_POSE), (second, INTEGRATED)]


def test_sensors_of_a_robot_do_not_wait_for_each_other() -> None:
    """One whose clock is ahead must not cost the others their poses."""
    desk = Desk()
    ahead, good, placed = desk.cloud(5.0, frame="ahead"), desk.cloud(0.05), desk.cloud(0.1, frame="map")
    desk.pose(0.0)
    desk.pose(0.1)
    assert desk.all(1.9) == [(good, INTEGRATED), (placed, INTEGRATED)]
    assert desk.all(2.0) == [(ahead, CloudReason.NO_POSE)]


def test_a_cloud_that_came_after_a_doubted_pose_waits_for_its_end() -> None:
    """The clock may have leapt for all that came since: its stamp may be of another time than it seems."""
    desk = Desk()
    desk.drive(0.0, 0.5)
    before = desk.cloud(0.41)
    desk.pose(0.2)
    after = desk.cloud(0.42)
    assert desk.all() == [(before, INTEGRATED)]
    desk.pose(0.6)  # the odd one was a wild stamp
    assert desk.all() == [(after, INTEGRATED)]


def test_doubts_do_not_outlast_the_wait() -> None:
    desk = Desk()
    desk.drive(0.0, 0.5)
    desk.pose(0.2)
    number = desk.cloud(0.42)
    assert desk.all(1.9) == []
    assert desk.all(2.0) == [(number, CloudReason.NO_POSE)]


def test_while_a_stamp_repeats_what_is_not_older_waits() -> None:
    desk = Desk()
    desk.drive(0.0, 0.5)
    desk.pose(0.5, 0.3)
    older, not_older = desk.cloud(0.42, frame="one"), desk.cloud(0.5, frame="two")
    assert desk.all() == [(older, INTEGRATED)]
    desk.pose(0.6)
    assert desk.all() == [(not_older, INTEGRATED)]


@pytest.mark.parametrize("far", [False, True])
def test_a_cloud_that_fell_back_waits_for_poses_then_goes(far: bool) -> None:
    desk = Desk()
    desk.drive(0.0, 0.5)
    number = desk.cloud(0.42)
    desk.doubts[number] = Doubt(None, until_taken=8, far=far)
    desk.pose(0.6)
    assert desk.all() == []
    desk.pose(0.7)
    assert desk.all() == [(number, CloudReason.CLOCK_OFFSET if far else INTEGRATED)]


@pytest.mark.parametrize("far", [False, True])
def test_without_such_poses_it_goes_when_its_wait_is_over(far: bool) -> None:
    desk = Desk()
    desk.drive(0.0, 0.5)
    number = desk.cloud(0.42)
    desk.doubts[number] = Doubt(None, until_taken=8, far=far)
    assert desk.all(1.9) == []
    assert desk.all(2.0) == [(number, CloudReason.CLOCK_OFFSET if far else INTEGRATED)]


def test_a_doubt_with_a_reason_ends_it_at_once() -> None:
    desk = Desk()
    number = desk.cloud(0.42)
    desk.doubts[number] = Doubt(CloudReason.CLOCK_OFFSET)
    assert desk.all() == [(number, CloudReason.CLOCK_OFFSET)]


def test_since_the_map_was_emptied_nothing_is_late() -> None:
    """The same recording may be on its way, its clouds before its poses."""
    desk = Desk()
    desk.drive(0.0, 20.0)
    desk.robots["a"].begin_map(desk.inputs + 1)
    number = desk.cloud(0.05)
    assert desk.all() == []
    assert desk.pose(0.0).verdict.begins_anew
    desk.pose(0.1)
    assert desk.all() == [(number, INTEGRATED)]


def test_robots_do_not_wait_for_each_other() -> None:
    desk = Desk()
    waits = desk.cloud(0.05, robot="a")
    goes = desk.cloud(0.05, robot="b")
    desk.pose(0.0, robot="b")
    desk.pose(0.1, robot="b")
    assert desk.all() == [(goes, INTEGRATED)]
    desk.pose(0.0, robot="a")
    desk.pose(0.1, robot="a")
    assert desk.all() == [(waits, INTEGRATED)]


def test_of_several_robots_the_oldest_first() -> None:
    desk = Desk()
    numbers = [desk.cloud(0.05, robot=robot) for robot in ("b", "a", "b", "a")]
    for robot in ("a", "b"):
        desk.pose(0.0, robot=robot)
        desk.pose(0.1, robot=robot)
    assert [number for number, _ in desk.all()] == numbers


def test_another_robots_poses_help_nobody() -> None:
    desk = Desk()
    number = desk.cloud(0.05, robot="a")
    desk.pose(0.0, robot="b")
    desk.pose(0.1, robot="b")
    assert desk.all(2.0) == [(number, CloudReason.NO_POSE)]


def test_overload_ends_the_oldest_of_the_robot_that_holds_most() -> None:
    desk = Desk()
    small = desk.cloud(1.0, robot="small", size=200)
    first = desk.cloud(1.0, robot="big", size=300)
    second = desk.cloud(1.1, robot="big", size=400)
    assert desk.inbox.size == 900
    assert desk.all() == []
    last = desk.cloud(1.2, robot="small", size=101)
    assert desk.all() == [(first, CloudReason.OVERLOAD)]
    assert desk.inbox.size == 701
    assert desk.all(2.0) == [(small, CloudReason.NO_POSE), (second, CloudReason.NO_POSE), (last, CloudReason.NO_POSE)]


def test_overload_counts_all_sensors_of_a_robot() -> None:
    """Else a robot would get the more room, the more sensors it has."""
    desk = Desk()
    other = desk.cloud(1.0, robot="small", size=400)
    first, second = (desk.cloud(1.0, robot="big", size=290, frame=frame) for frame in ("left", "right"))
    last = desk.cloud(1.2, robot="small", size=100)
    assert desk.all() == [(first, CloudReason.OVERLOAD)]
    assert sorted(desk.all(2.0)) == [(number, CloudReason.NO_POSE) for number in (other, second, last)]


def test_overload_never_ends_an_ingested_cloud() -> None:
    desk = Desk()
    promised = [desk.cloud(1.0, robot="big", size=400, ingested=True) for _ in range(2)]
    assert not desk.inbox.has_room(201)
    assert desk.inbox.has_room(200)
    other = desk.cloud(1.0, robot="small", size=150)
    mine = desk.cloud(1.0, robot="big", size=100)
    assert desk.all() == [(mine, CloudReason.OVERLOAD)], "the robot that holds most ends its oldest published one"
    new = desk.cloud(1.0, robot="small", size=100)
    assert desk.all() == [(other, CloudReason.OVERLOAD)], "where it has none, the next robot does"
    assert sorted(desk.all(2.0)) == [(number, CloudReason.NO_POSE) for number in sorted([*promised, new])]


def test_a_cloud_that_holds_more_than_the_limit_waits_alone() -> None:
    """Decoding may make three times the message of it, and a message may be as large as the limit."""
    desk = Desk()
    assert desk.inbox.has_room(5000)
    desk.cloud(1.0, size=5000)
    assert len(desk.inbox.queues["a", "lidar"]) == 1
    assert not desk.inbox.has_room(1)
    assert desk.tick() is None
    desk.cloud(1.0, size=400)
    assert len(desk.inbox.queues["a", "lidar"]) == 1
    assert desk.tick() == (1, "overload")


def test_a_clock_that_went_back_ends_all_that_its_robot_waited_with() -> None:
    desk = Desk()
    desk.drive(0.0, 0.9)
    first, other, second = desk.cloud(1.0), desk.cloud(1.0, robot="b"), desk.cloud(1.1, ingested=True, frame="two")
    desk.drive(0.95, 0.95)  # those that came after the last pose are told apart by the run
    assert [desk.pose(t).verdict.begins_anew for t in (0.1, 0.2, 0.3)] == [False, False, True]
    after = desk.cloud(5.0)
    assert sorted(desk.all()) == [(first, CloudReason.CLOCK_RESET), (second, CloudReason.CLOCK_RESET)]
    assert sorted(desk.all(2.0)) == [(other, CloudReason.NO_POSE), (after, CloudReason.NO_POSE)]


@pytest.mark.parametrize("promised", [0, 1])
def test_what_a_message_costs_does_not_grow_with_what_waits(promised: int) -> None:
    """Else many small clouds, which pile up fastest, would be what the sequencer is slowest at."""

    class Looked(LoggedCloud):
        looks = 0

        def __getattribute__(self, name: str) -> object:
            Looked.looks += 1
            return super().__getattribute__(name)

    def looks(waiting: int) -> int:
        inbox = Inbox(Settings(config(input={"queue_limit": waiting, "max_message": 1})), {}, {})
        for number in range(waiting + 1):
            Looked.looks = 0
            held = Cloud("lidar", T0 + number, np.zeros((1, 3)), None)
            arrival = Arrival(0.0, promised=number < promised)
            inbox.feed(Looked(number, "a", held, T0 + number, T0 + number, 1, arrival, BY_CONTRACT))
            assert not inbox.holds_before("a", T0)
        assert [decision.cloud.input for decision in inbox.ended] == [promised], "the last one had no room"
        return Looked.looks

    assert looks(300) == looks(30)


def test_robots_take_turns() -> None:
    """Whoever sent much holds nobody up: another robot's cloud comes next, not behind all of it."""
    desk = Desk()
    flood = [desk.cloud(0.1 + 0.01 * n, robot="loud") for n in range(4)]
    quiet = [desk.cloud(0.1, robot="quiet"), desk.cloud(0.2, robot="quiet")]
    for robot in ("loud", "quiet"):
        desk.pose(0.0, robot=robot)
        desk.pose(0.5, robot=robot)
    order = [number for number, _ in desk.all()]
    assert order == [flood[0], quiet[0], flood[1], quiet[1], flood[2], flood[3]]


def test_poses_exactly_the_gap_apart_are_near_enough() -> None:
    """2.01 times 1e9 falls short of 2,010,000,000 in float64."""
    assert Settings(config(input={"max_pose_gap": 2.01})).max_pose_gap_ns == 2_010_000_000
