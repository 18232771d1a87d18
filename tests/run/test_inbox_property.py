"""Whatever comes in whichever order: each cloud is decided once, in its robot's order, and the inbox ends empty."""

from collections import defaultdict

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from properties import examples
from service_tools import LEVEL, PRECISE, T0, config

from roughmap_schemas import Cloud, CloudReason, Odometry
from roughmap_service.run.inbox import INTEGRATED, Arrival, Inbox, LoggedCloud, Proposal
from roughmap_service.run.poses import PoseBuffer
from roughmap_service.run.settings import Settings

TENTH = 10**8
SETTINGS = Settings(
    config(input={"max_wait": 1.0, "max_pose_gap": 0.25, "pose_history": 2.0, "queue_limit": 500, "max_message": 500})
)
ROBOTS = ("a", "b", "c")
OUT_OF_TURN = (CloudReason.OVERLOAD, CloudReason.CLOCK_RESET)
"""These end clouds from outside, whatever waits before them."""

robots = st.sampled_from(ROBOTS)
tenths = st.integers(0, 60)
steps = st.one_of(
    st.tuples(st.just("pose"), robots, tenths),
    st.tuples(st.just("cloud"), robots, tenths, st.integers(0, 5), st.integers(1, 300), st.booleans(), st.booleans()),
    st.tuples(st.just("tick"), st.floats(0, 0.6)),
    st.tuples(st.just("reset"), robots),
)


@examples(200)
@given(st.lists(steps, max_size=60))
def test_one_decision_a_cloud_in_order(row: list[tuple]) -> None:
    poses = {robot: PoseBuffer("map", SETTINGS.history_ns, 1.0, 1.0) for robot in ROBOTS}
    inbox = Inbox(SETTINGS, poses)
    fed: dict[str, list[int]] = defaultdict(list)
    clouds: dict[int, LoggedCloud] = {}
    stamps: dict[int, int] = {}
    decisions: list[Proposal] = []
    now = 0.0
    for number, (kind, *values) in enumerate(row, 1):
        if kind == "pose":
            robot, t = values
            stamps[number] = T0 + t * TENTH
            message = Odometry(stamps[number], "map", "base", (0.0, 0.0, 0.0), LEVEL, PRECISE)
            if poses[robot].add(message, number)[1]:
                inbox.clock_reset(robot)
        elif kind == "cloud":
            robot, t, long, size, ingested, placed = values
            if ingested and not inbox.has_room(size):
                continue
            first = T0 + t * TENTH + 1
            held = Cloud("map" if placed else "lidar", first, np.zeros((1, 3)), None)
            clouds[number] = LoggedCloud(
                number, robot, held, first, first + long * TENTH, size, Arrival(now, promised=ingested)
            )
            fed[robot].append(number)
            inbox.feed(clouds[number])
            assert inbox.size <= SETTINGS.queue_limit, "the limit holds, whatever has been fed"
        elif kind == "reset":
            inbox.clock_reset(values[0])
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
    for robot in ROBOTS:
        in_turn = [d.cloud.input for d in decisions if d.cloud.robot == robot and d.outcome not in OUT_OF_TURN]
        assert in_turn == sorted(in_turn)
    for decision in decisions:
        cloud = decision.cloud
        assert not (cloud.arrival.promised and decision.outcome == CloudReason.OVERLOAD)
        if decision.outcome == INTEGRATED and cloud.cloud.frame_id == "lidar":
            assert stamps[decision.poses[0][0]] <= cloud.first_ns
            assert stamps[decision.poses[-1][0]] >= cloud.last_ns
