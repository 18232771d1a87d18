"""Which scans of a sensor clear what they see through: one in each interval, whatever else happens."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from log_edits import rewrite
from replay_tools import replay
from service_tools import SECOND, LoggedRun, cloud, config, events_of, odometry, read_back

from roughmap_schemas import Config, IntegrationEvent
from roughmap_schemas.kinds import Kind
from roughmap_service.engine.recovery import recover
from roughmap_service.run.sensor_clock import SensorClock
from roughmap_service.store.map_db import Store

X, Y = np.meshgrid(np.arange(0.55, 4.0, 0.05), np.arange(-1.5, 1.5, 0.05))
FLOOR = np.column_stack((X.ravel(), Y.ravel(), np.full(X.size, -1.0)))
POST = np.column_stack(
    (np.full(200, 2.02), np.tile(np.linspace(-0.2, 0.2, 10), 20), np.repeat(np.linspace(-0.7, 0.3, 20), 10))
)
WALL = np.column_stack(
    (np.full(4000, 4.5), np.tile(np.linspace(-2.0, 2.0, 80), 50), np.repeat(np.linspace(-1.0, 1.0, 50), 80))
)


LIFT = {"lidar": np.zeros(3), "map": np.array([0.0, 0.0, 1.0])}
"""The sensor is 1 m above the map's origin."""


def ground(**sections: Any) -> Config:
    return config(map={"surface": "ground", **sections.pop("map", {})}, service={"threads": 1}, **sections)


def scan(run: LoggedRun, t: float, *, post: bool = False, frame: str = "lidar") -> IntegrationEvent:
    """A scan at ``t`` seconds, of the floor, of a wall behind it, and with ``post`` of a post in between."""
    for at in (t - 0.02, t, t + 0.02):
        run.put(Kind.ODOMETRY, odometry(at))
    points = np.concatenate((FLOOR, *([POST] if post else []), WALL))
    run.put(Kind.POINTS, cloud(t, frame=frame, points=points + LIFT[frame]))
    return run.decide()[-1]


def cleared(where: Path) -> list[int]:
    return [event.cleared for event in events_of(read_back(where)) if isinstance(event, IntegrationEvent)]


def test_a_post_that_was_taken_away_is_cleared_by_one_scan_in_an_interval(tmp_path: Path) -> None:
    logs = tmp_path / "log"
    with LoggedRun(logs, ground()) as run:
        for n in range(4):
            assert scan(run, n / 10, post=True).accepted
        found = [scan(run, n / 10).cleared for n in range(4, 14)]
        run.checkpoint()
    # Scans come every 0.1 s, the interval is 0.2 s. The scan at 0 s was the first to clear.
    assert [number > 0 for number in found[:4]] == [True, False, True, False]
    assert found[1::2] == [0] * 5
    assert cleared(logs)[4:] == found
    code, said, _ = replay(logs)
    assert (code, said.split(":")[0]) == (0, "equal")


def test_a_replay_compares_what_was_cleared(tmp_path: Path) -> None:
    logs = tmp_path / "log"
    with LoggedRun(logs, ground()) as run:
        scan(run, 0.0, post=True)
        assert scan(run, 0.3).cleared
        run.checkpoint()
    (file,) = logs.glob("*.mcap")

    def fewer(topic: str, data: bytes) -> bytes:
        return re.sub(rb'"cleared":[1-9][0-9]*', b'"cleared":1', data) if topic.endswith("/events") else data

    rewrite(file)
    assert replay(logs)[0] == 0, "only what the edit changes may make a difference"
    rewrite(file, fewer)
    code, said, _ = replay(logs)
    assert (code, "cleared 1 in the log" in said) == (1, True)


def test_points_in_the_maps_frame_clear_nothing(tmp_path: Path) -> None:
    with LoggedRun(tmp_path / "log", ground()) as run:
        scan(run, 0.0, post=True)
        assert [scan(run, t, frame="map").cleared for t in (0.3, 0.6)] == [0, 0]


def test_a_map_of_all_points_is_not_cleared(tmp_path: Path) -> None:
    with LoggedRun(tmp_path / "log", config(map={"surface": "all"})) as run:
        scan(run, 0.0, post=True)
        assert [scan(run, t).cleared for t in (0.3, 0.6)] == [0, 0]


@pytest.mark.parametrize("stored", [False, True])
def test_the_last_clearing_outlasts_a_restart(tmp_path: Path, stored: bool) -> None:
    """The next scan within the interval clears nothing, whether the run came from the log or from a store's cut."""
    logs, store = tmp_path / "log", Store(tmp_path / "map.db") if stored else None
    with LoggedRun(logs, ground(), store=store) as run:
        scan(run, 0.0, post=True)
        scan(run, 0.1, post=True)
        assert scan(run, 0.2).cleared
        if stored:
            run.snapshot()
    with LoggedRun(logs, ground(), recovered=recover(ground(), logs, store), store=store) as run:
        assert scan(run, 0.3).cleared == 0
        assert scan(run, 0.4).cleared > 0
        run.checkpoint()
    assert replay(logs)[0] == 0


def test_a_reset_forgets_the_last_clearing(tmp_path: Path) -> None:
    with LoggedRun(tmp_path / "log", ground()) as run:
        scan(run, 0.0, post=True)
        run.reset()
        assert run.run.robots["rover"].sensors["lidar"].cleared_ns == -1
        scan(run, 0.1, post=True)
        assert run.run.robots["rover"].sensors["lidar"].cleared_ns == run.run.newest_stamp_ns
        run.checkpoint()
    assert replay(tmp_path / "log")[0] == 0


@pytest.mark.parametrize(
    ("stamp", "clears"), [(10.0, False), (10.1, False), (10.2, True), (11.0, True), (9.9, True), (0.0, True)]
)
def test_when_a_scan_clears(stamp: float, clears: bool) -> None:
    """As well if its stamp lies before the last one: the clock went back."""
    sensor, interval_ns = SensorClock(), SECOND // 5
    assert sensor.clears(round(stamp * SECOND), interval_ns)
    sensor.cleared_ns = 10 * SECOND
    assert sensor.clears(round(stamp * SECOND), interval_ns) is clears
    assert sensor.clears(round(stamp * SECOND), 0)
