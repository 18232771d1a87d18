"""Logs of version 1 of the rules are replayed by their events, whatever the rules would decide today.

The files in `rules_1` are such a log, as version 0.1.0 made it before there were other rules: odometry out of order,
sent twice, too fast, 7 s ahead at once, and back by 7 s; covariances that are large, negative or not estimated; a
transform later than a pose; points with times; a reset; a second file; a cloud that is still undecided. It is of state
version 1, so its digests can't be compared: a replay of it makes the log of today's state that these tests compare.
"""

import math
from pathlib import Path

import pytest
from log_edits import rewrite
from replay_tools import replay
from service_tools import LoggedRun, config, events_of, odometry, read_back, starts_of

from roughmap_schemas import IntegrationEvent
from roughmap_schemas.kinds import Kind
from roughmap_service.engine.recovery import blank, recover
from roughmap_service.run.settings import RULES, Settings

OLD = Path(__file__).with_name("rules_1")

AS_THEN = config(input={"pose_history": 5.0}, map={"max_vertical_sigma": math.inf, "surface": "all"})


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    code, said, _ = replay(OLD, "--log-out", tmp_path / "log")
    assert (code, "; all 20 events came out as logged; sequence 10, " in said) == (3, True)
    return tmp_path / "log"


def test_it_holds_what_the_rules_of_today_would_decide_otherwise() -> None:
    items = read_back(OLD)
    assert [start.metadata.rules for start in starts_of(items)] == [1, 1]
    assert "max_turn" in starts_of(items)[0].metadata.configuration["input"], "a setting that is gone"
    outcomes = [str(event.outcome) for event in events_of(items) if isinstance(event, IntegrationEvent)]
    assert set(outcomes) == {"integrated", "pose_jump", "pose_gap", "no_pose", "late", "empty"}


def test_it_replays_equal(logs: Path) -> None:
    assert replay(logs)[1].startswith("equal: 4 checkpoints, sequence 10")


@pytest.mark.parametrize(("rules", "equal"), [(1, True), (RULES, False)])
def test_a_file_s_own_rules_count(logs: Path, rules: int, equal: bool) -> None:
    """Under those of today the same messages lead to other poses, so the events name some that are not there."""
    for path in logs.iterdir():
        rewrite(path, rules=rules)
    assert replay(logs)[0] == (0 if equal else 1)


def test_the_run_goes_on_under_the_rules_of_today(logs: Path) -> None:
    """The undecided cloud finds its poses, and all of it is one log."""
    back = recover(AS_THEN, logs, None)
    assert back.run.map.digest() == replay(logs)[1].rpartition(" ")[2]
    assert back.run.settings.rules == RULES
    (waiting,) = back.run.clouds
    with LoggedRun(logs, AS_THEN, recovered=back) as run:
        for t in (1.3, 1.4):
            run.put(Kind.ODOMETRY, odometry(t, 4.1))
        assert [(event.input, event.outcome) for event in run.decide()] == [(waiting, "integrated")]
        assert run.scan(15.0, 4.1).outcome == "integrated"
        run.put(Kind.ODOMETRY, odometry(1.45, 4.1))  # held today, inserted then
        assert run.run.robots["rover"].clock.held
        run.checkpoint()
    assert [start.metadata.rules for start in starts_of(read_back(logs))] == [1, 1, RULES]
    code, said, _ = replay(logs)
    assert (code, said.rpartition(" ")[2]) == (0, run.run.map.digest())


def test_a_run_under_the_rules_of_version_1_replays_equal(tmp_path: Path) -> None:
    """Made here: odometry out of order and twice, placed as the rules of version 1 place it."""
    recovered = blank(config())
    recovered.run.use(Settings(config(), rules=1))
    with LoggedRun(tmp_path / "log", recovered=recovered) as run:
        for n, t in enumerate((0.0, 0.2, 0.1, 0.1, 0.4, 0.3)):
            run.put(Kind.ODOMETRY, odometry(t, t + 0.001 * n))
        assert [pose.input for pose in run.run.robots["rover"].buffer.poses] == [1, 3, 2, 6, 5]
        run.checkpoint()
        assert run.scan(5.0, 0.5).outcome == "integrated"
        run.checkpoint()
    assert [start.metadata.rules for start in starts_of(read_back(tmp_path / "log"))] == [1]
    assert replay(tmp_path / "log")[0] == 0
