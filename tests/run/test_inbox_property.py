"""Whatever comes in whichever order: each cloud is decided once, in its sensor's order, and the inbox ends empty."""

from collections import defaultdict

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from properties import examples
from service_tools import LEVEL, PRECISE, T0, config

from roughmap_schemas import Cloud, CloudReason, Odometry
from roughmap_service.run.inbox import INTEGRATED, Arrival, Inbox, LoggedCloud, Proposal
from roughmap_service.run.robot import Robot
from roughmap_service.run.sensor_clock import Doubt
from roughmap_service.run.sensor_times import BY_CONTRACT
from roughmap_service.run.settings import Settings

TENTH = 10**8
SETTINGS = Settings(
    config(input={"max_wait": 1.0, "max_pose_gap": 0.25, "pose_history": 2.0, "queue_limit": 500, "max_message": 500})
)
ROBOTS = ("a", "b", "c")

robots = st.sampled_from(ROBOTS)
frames = st.sampled_from(["lidar", "other", "map"])
tenths = st.integers(0, 60)
doubts = st.one_of(
    st.none(),
    st.none(),
    st.builds(Doubt, st.just(CloudReason.CLOCK_OFFSET)),
    st.builds(Doubt, st.none(), st.integers(0, 12), st.booleans()),
)
steps = st.one_of(
    st.tuples(st.just("pose"), robots, tenths),
    st.tuples(st.just("drive"), robots, tenths, st.integers(2, 12)),
    st.tuples(st.just("cloud"), robots, tenths, st.integers(0, 5), st.integers(1, 300), st.booleans(), frames, doubts),
    st.tuples(st.just("tick"), st.floats(0, 0.6)),
    st.tuples(st.just("emptied")),
)


@examples(200)
@given(st.lists(steps, max_size=60))
def test_one_decision_a_cloud_in_order(row: list[tuple]) -> None:
    heard: dict[str, Robot] = {}
    in_doubt: dict[int, Doubt] = {}
    inbox = Inbox(SETTINGS, heard, in_doubt)
    clouds: dict[int, LoggedCloud] = {}
    stamps: dict[int, int] = {}
    decisions: list[Proposal] = []
    now, number = 0.0, 0
    for kind, *values in row:
        if kind in ("pose", "drive"):
            robot, t, *several = values
            for k in range(several[0] if several else 1):
                number += 1
                stamps[number] = T0 + (t + k) * TENTH
                message = Odometry(stamps[number], "map", "base", (0.0, 0.0, 0.0), LEVEL, PRECISE)
                heard.setdefault(robot, Robot(SETTINGS, robot)).take_odometry(message, number, stamps[number])
        elif kind == "cloud":
            robot, t, long, size, ingested, frame, doubt = values
            if ingested and not inbox.has_room(size):
                continue
            number += 1
            first = T0 + t * TENTH + 1
            held = Cloud(frame, first, np.zeros((1, 3)), None)
            clouds[number] = LoggedCloud(
                number, robot, held, first, first + long * TENTH, size, Arrival(now, promised=ingested), BY_CONTRACT
            )
            if doubt is not None:
                in_doubt[number] = doubt
            inbox.feed(clouds[number])
            assert inbox.size <= SETTINGS.queue_limit, "the limit holds, whatever has been fed"
        elif kind == "emptied":
            for one in heard.values():
                one.begin_map(number + 1)
        else:
            now += values[0]
            while (decision := inbox.tick(now)) is not None:
                decisions.append(decision)
        undecided = set(clouds) - {d.cloud.input for d in decisions}
        waiting = [clouds[n] for n in undecided - {d.cloud.input for d in inbox.ended}]
        assert inbox.size == sum(cloud.size for cloud in waiting)
        for robot in ROBOTS:
            first = min((cloud.first_ns for cloud in waiting if cloud.robot == robot), default=None)
            for stamp in (T0, *(cloud.first_ns + after for cloud in waiting for after in (0, 1))):
                assert inbox.holds_before(robot, stamp) == (first is not None and first < stamp)
    while (due := inbox.deadline()) is not None:
        decision = inbox.tick(due)
        assert decision is not None, "at its deadline something is due"
        decisions.append(decision)

    assert sorted(d.cloud.input for d in decisions) == sorted(clouds)
    assert (inbox.size, inbox.queues, inbox.deadline()) == (0, {}, None)
    in_turn: dict[tuple[str, str], list[int]] = defaultdict(list)
    for decision in decisions:
        cloud = decision.cloud
        if decision.outcome != CloudReason.OVERLOAD:  # it ends clouds from outside, whatever waits before them
            in_turn[cloud.sensor].append(cloud.input)
        assert not (cloud.arrival.promised and decision.outcome == CloudReason.OVERLOAD)
        if cloud.cloud.frame_id == "map":
            assert decision.outcome in (INTEGRATED, CloudReason.OVERLOAD)
        elif decision.outcome == INTEGRATED:
            line = [stamps[odometry] for odometry, _ in decision.poses]
            assert line == sorted(set(line))
            assert line[0] <= cloud.first_ns
            assert line[-1] >= cloud.last_ns
            doubt = in_doubt.get(cloud.input, Doubt())
            assert doubt.reason is None
            assert not doubt.far
    for inputs in in_turn.values():
        assert inputs == sorted(inputs)
