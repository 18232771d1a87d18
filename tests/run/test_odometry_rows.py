"""Any rows of odometry stamps, and clocks that leap: what holds whatever comes."""

import json

from hypothesis import given
from hypothesis import strategies as st
from odometry_heard import SETTINGS, TENTH, Heard
from properties import examples

from roughmap_service.run.odometry_clock import MAX_HELD, Verdict
from roughmap_service.run.robot import Robot

TAKE, REPEAT, HOLD, FORWARD, BACK, BREAK = Verdict

tenths = st.integers(1, 400)
rows = st.one_of(
    st.lists(tenths, max_size=60),
    # Runs of steady steps from anywhere, as clocks that leap make them.
    st.lists(st.tuples(tenths, st.integers(1, 12), st.sampled_from([0.0, 0.05, 1.0, 1.0, 3.0])), max_size=12).map(
        lambda runs: [t + k * step for t, length, step in runs for k in range(length)]
    ),
    # Two sources and jitter.
    st.lists(st.floats(-5.0, 5.0), max_size=60).map(lambda late: [max(100 + k + d, 1) for k, d in enumerate(late)]),
)


@examples(300)
@given(rows, st.integers(0, 60), st.integers(0, 80))
def test_any_row_of_stamps(row: list[float], stored: int, emptied: int) -> None:
    """Whatever comes: little is held, poses rise, each message is settled once or still held, and a robot that was
    stored and restored goes on as if it had not been."""
    heard, again = Heard(), Heard()
    settled = 0
    poses_since = 1
    for number, t in enumerate(row, 1):
        if number == stored:
            state = json.loads(json.dumps(heard.robot.to_state(), allow_nan=False))
            again.robot = Robot(SETTINGS, "rover")
            again.robot.load_state(state)
        if number == emptied:
            settled += len(heard.robot.clock.held)
            for one in (heard, again):
                one.robot.begin_map(number)
        clock = heard.robot.clock
        newest, held = clock.newest_ns, {h.input for h in clock.held}
        verdict = heard.robot.judge(round(t * TENTH))
        taken = heard.add(t)
        assert taken.verdict is verdict
        assert again.add(t) == taken
        assert again.robot.to_state() == heard.robot.to_state()

        settled += len(taken.settled)
        assert settled + len(clock.held) == number
        assert len(clock.held) <= MAX_HELD
        assert {h.input for h in clock.held} <= held | {number}
        assert (verdict is HOLD) == (number in {h.input for h in clock.held})
        assert bool(clock.held) == bool(clock.doubted)
        assert heard.poses == sorted(set(heard.poses))
        assert heard.poses[-1] == clock.newest_ns, "every message of this row gives a pose"
        if verdict.begins_anew:
            poses_since = min(heard.inputs_of_poses)
            assert poses_since >= clock.begun
        elif verdict in (TAKE, FORWARD):
            assert clock.newest_ns > newest
        else:
            assert clock.newest_ns == newest
        assert min(heard.inputs_of_poses) >= poses_since, "no pose of a clock before comes back"
        if verdict not in (HOLD, REPEAT):
            assert taken.settled[-1] is None, "what is believed is taken"
            assert not clock.held


@examples(100)
@given(
    st.integers(10, 200), st.sampled_from([0.2, 0.5, 1.0, 2.4]),
    st.lists(st.tuples(st.integers(3, 30), st.floats(-80.0, 5000.0)), max_size=5),
)  # fmt: skip
def test_a_clock_that_leaps_costs_no_more_than_what_shows_it(
    steady: int, step: float, leaps: list[tuple[int, float]]
) -> None:
    """However it leaps, after three messages it is believed: only a short step back may cost poses, each one of them at
    a time at which two clocks' stamps overlap."""
    heard = Heard()
    t = 10_000.0
    for k in range(steady):
        assert heard.add(t + k * step).settled == [None]
    t += steady * step
    lost = 0
    for length, by in leaps:
        t += by
        for _ in range(length):
            lost += sum(reason is not None for reason in heard.add(t).settled)
            t += step
        assert not heard.robot.clock.held or heard.robot.clock.held[0].input > heard.inputs - 3
        assert abs(heard.poses[-1] - round((t - step) * TENTH)) <= 1 or heard.robot.clock.two_sources
    assert heard.robot.clock.two_sources or lost <= 3 * len(leaps)
