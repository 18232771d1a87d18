"""Mountings that came with transforms, over restarts: the same map from the log, from store and log, and by `log.keep`.

What is told of them, and that such a transform counts again where it would otherwise be a duplicate.
"""

import logging
from pathlib import Path
from typing import Any

import pytest
from service_tools import LEVEL, T0, WAIT_S, LoggedRun, cloud, config, events_of, odometry, read_back

from roughmap_schemas import CloudReason, Config, encode_transform
from roughmap_schemas.kinds import Kind
from roughmap_service.engine.recovery import recover
from roughmap_service.inputs.queue import InputMessage
from roughmap_service.offline.replay import replay
from roughmap_service.store.map_db import Store

PLACES = ((0.3, 0.0, 0.2), (0.3, 0.4, 0.2), (0.7, 0.0, 0.0))


def by_transform(**more: Any) -> Config:
    return config(sensors={"lidar": {"range_sigma": 0.01, "extrinsics": "transform"}}, **more)


def mount(run: LoggedRun, place: tuple[float, ...] = PLACES[0], turn: Any = LEVEL) -> int:
    return run.put(Kind.TRANSFORM, encode_transform(0, "base_link", "lidar", place, turn))


def drive(run: LoggedRun, first: int, scans: int = 2) -> list[str]:
    """Some scans, one after the other; their outcomes."""
    return [str(run.scan(float(k), 0.3 * k).outcome) for k in range(first, first + scans)]


def same_robots(one: LoggedRun, other: Any) -> None:
    assert other.run.robots["rover"].to_state() == one.run.robots["rover"].to_state()
    assert other.run.map.digest() == one.run.map.digest()


def test_a_start_goes_on_with_the_mounting_that_came_last(tmp_path: Path) -> None:
    """From the log alone, and from a store whose cut is after the mounting and before the end."""
    logs, store = tmp_path / "log", Store(tmp_path / "map.db")
    with LoggedRun(logs, by_transform(), store=store) as run:
        mount(run)
        drive(run, 0)
        mount(run, PLACES[1])
        drive(run, 2)
        run.snapshot()
        drive(run, 4)
        run.checkpoint()
    for kept in (None, store):
        back = recover(by_transform(), logs, kept)
        assert (back.cut is None) == (kept is None)
        same_robots(run, back)
    assert replay([logs]).difference is None
    assert replay([logs], from_store=store.path).difference is None

    with LoggedRun(logs, by_transform(), recovered=recover(by_transform(), logs, store)) as again:
        assert drive(again, 6) == ["integrated"] * 2, "no transform came since the start"
        again.checkpoint()
    assert replay([logs]).difference is None


def test_it_may_come_after_the_cut(tmp_path: Path) -> None:
    logs, store = tmp_path / "log", Store(tmp_path / "map.db")
    with LoggedRun(logs, by_transform(), store=store) as run:
        mount(run)
        drive(run, 0)
        run.snapshot()
        mount(run, PLACES[2])
        drive(run, 2)
        run.checkpoint()
    for kept in (None, store):
        same_robots(run, recover(by_transform(), logs, kept))
    assert replay([logs], from_store=store.path).difference is None


def test_it_goes_on_where_the_file_that_held_it_is_gone(tmp_path: Path) -> None:
    """With `log.keep` the store alone knows it."""
    logs, store = tmp_path / "log", Store(tmp_path / "map.db")
    bounded = by_transform(log={"keep": 1}, store={"path": str(store.path)})
    with LoggedRun(logs, bounded, store=store) as run:
        mount(run)
        drive(run, 0)
        run.rotate()
        assert run.writer.wait_synced(WAIT_S)
        run.snapshot()
        assert [path.name for path in logs.glob("*.mcap")] == [run.writer.path.name]
        drive(run, 2)
        run.checkpoint()
    same_robots(run, recover(bounded, logs, store))
    assert replay([logs], from_store=store.path).difference is None


def test_clouds_that_wait_over_a_restart_are_placed_by_what_comes_after_it(tmp_path: Path) -> None:
    logs, store = tmp_path / "log", Store(tmp_path / "map.db")
    with LoggedRun(logs, by_transform(), store=store) as run:
        with pytest.raises(IndexError):  # nothing is decided yet
            run.scan(0.0)
        run.snapshot()
    for n, kept in enumerate((None, store)):
        back = recover(by_transform(), logs, kept)
        assert [cloud.input for cloud in back.run.clouds.values()] == [2]
        if n:
            with LoggedRun(logs, by_transform(), recovered=back, store=store) as again:
                mount(again)
                assert [str(event.outcome) for event in again.decide()] == ["integrated"]
                again.checkpoint()
        else:
            back.run.map.reset()
    assert replay([logs]).difference is None


def test_clouds_that_ended_without_one_end_so_in_a_replay(tmp_path: Path) -> None:
    logs = tmp_path / "log"
    with LoggedRun(logs, by_transform()) as run:
        with pytest.raises(IndexError):
            run.scan(0.0)
        (event,) = run.decide(100.0)
        assert event.outcome == CloudReason.NO_EXTRINSICS
        mount(run)
        assert drive(run, 1) == ["integrated"] * 2
        run.checkpoint()
    assert replay([logs]).difference is None
    same_robots(run, recover(by_transform(), logs, None))


def test_the_same_bytes_count_again_where_they_change_something(tmp_path: Path) -> None:
    """Set back to what it was, and under settings that it did not mount anything under; else they are duplicates."""
    logs = tmp_path / "log"
    with LoggedRun(logs) as run:
        first = mount(run)
        assert mount(run) == first, "the sensor is mounted as configured"
    with LoggedRun(logs, by_transform(), recovered=recover(by_transform(), logs, None)) as run:
        second = mount(run)
        assert second > first
        assert mount(run) == second
        third = mount(run, PLACES[1])
        assert mount(run) > third
        assert drive(run, 0) == ["integrated"] * 2
        run.checkpoint()
    assert len(read_back(logs)) == len(events_of(read_back(logs))) + 4 + 6 + 2  # transforms, scans, files
    assert replay([logs]).difference is None
    same_robots(run, recover(by_transform(), logs, None))


def told(caplog: pytest.LogCaptureFixture) -> list[tuple[str, str]]:
    lines = [(getattr(record, "event", ""), record.getMessage()) for record in caplog.records]
    return [line for line in lines if line[0].startswith("mounting")]


def test_a_mounting_is_told_when_it_comes_and_when_it_changed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A change of less than 1 mm and 0.1 degrees is not, until such changes add up to more."""
    caplog.set_level(logging.INFO)
    with LoggedRun(tmp_path / "log", by_transform()) as run:
        mount(run, (0.3, 0.0, 0.2))
        mount(run, (0.3, 0.0, 0.2006))
        mount(run, (0.3, 0.0, 0.2012))
        mount(run, (0.3, 0.0, 0.2012), (0.0, 0.0, 0.0008, (1.0 - 0.0008**2) ** 0.5))
        mount(run, (0.3, 0.0, 0.2012), (0.0, 0.0, 0.01, (1.0 - 0.01**2) ** 0.5))
        listed = run.streams.recent.told()
    lines = told(caplog)
    assert [event for event, _ in lines] == ["mounting", "mounting_changed", "mounting_changed"]
    assert lines[0][1] == "robot rover sensor lidar: its mounting came: base_link -> lidar at 0.3, 0, 0.2 m"
    assert "its mounting changed by 0.0012 m, 0.00 degrees: base_link -> lidar" in lines[1][1]
    assert "changed by 0 m, 1.15 degrees" in lines[2][1]
    assert len(listed) == 2
    assert listed[0].startswith("robot rover sensor lidar: its mounting changed by ")
    assert "(2 times, last" in listed[0]


def test_a_sensor_on_a_mast_that_turns_is_one_entry(tmp_path: Path) -> None:
    with LoggedRun(tmp_path / "log", by_transform()) as run:
        for k in range(200):
            mount(run, (0.3, 0.01 * k, 0.2))
        changed = [text for text in run.streams.recent.told() if "its mounting changed" in text]
    assert len(changed) == 1
    assert "(199 times" in changed[0]


def test_what_is_missing_is_told_with_the_key_and_the_table(tmp_path: Path) -> None:
    with LoggedRun(tmp_path / "log", by_transform()) as run:
        for k in range(60):
            t = 0.1 * k
            for kind, payload in scan_messages(t):
                run.live.accept(InputMessage(kind, "rover", payload, T0, t), t)
            run.decide(t)
        (text,) = run.streams.problems().values()
    assert text.startswith("robot rover sensor lidar: none of its last ")
    assert "the sensor's mounting has not come yet" in text
    assert "base frame to lidar on robots/rover/transform" in text
    assert "[sensors.lidar]" in text


def scan_messages(t: float) -> list[tuple[Kind, bytes]]:
    return [(Kind.ODOMETRY, odometry(t)), (Kind.POINTS, cloud(t + 0.03)), (Kind.ODOMETRY, odometry(t + 0.06))]
