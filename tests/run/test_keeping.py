"""Which tiles the map no longer keeps, and that a log names them."""

from pathlib import Path

import numpy as np
import pytest
from replay_tools import replay
from service_tools import SECOND, LoggedRun, cloud, config, events_of, odometry, read_back

from roughmap_schemas import Config, ForgetEvent
from roughmap_schemas.kinds import Kind
from roughmap_service.engine.recovery import recover
from roughmap_service.run.keeping import INTERVAL_NS, MOST_TILES, Keeping, pieces
from roughmap_service.run.run import RunError
from roughmap_service.run.settings import Settings
from roughmap_service.store.map_db import Store


def keeping(**keep: float) -> Config:
    return config(map={"keep": keep}, input={"max_speed": 1000.0, "max_leap": 1000.0})


def drive(run: LoggedRun, metres: float, first: float = 0.0, step: float = 5.0) -> None:
    """Scan every second, ``step`` metres further each time."""
    for n in range(round(metres / step)):
        t, x = first + n, (first + n) * step
        for back in (0.3, 0.2, 0.1):
            run.put(Kind.ODOMETRY, odometry(t - back, x))
        run.put(Kind.POINTS, cloud(t - 0.15))
        run.decide()


def forgotten(where: Path) -> list[ForgetEvent]:
    return [event for event in events_of(read_back(where)) if isinstance(event, ForgetEvent)]


def test_without_the_setting_nothing_is_forgotten(tmp_path: Path) -> None:
    with LoggedRun(tmp_path / "log", config(input={"max_speed": 1000.0, "max_leap": 1000.0})) as run:
        drive(run, 60.0)
    assert forgotten(tmp_path / "log") == []


def test_what_the_robot_left_behind_is_forgotten(tmp_path: Path) -> None:
    logs = tmp_path / "log"
    with LoggedRun(logs, keeping(radius=20.0)) as run:
        drive(run, 200.0)
        run.checkpoint()
        left = run.run.map.tile_sequences()[0]
        assert run.counters.snapshot().tiles_forgotten > 0
    events = forgotten(logs)
    assert events
    gone = [tile for event in events for tile in event.tiles]
    assert len(gone) == len(set(gone)), "none twice, the robot only went on"
    assert run.counters.snapshot().tiles_forgotten == len(gone)
    last_x = 195.0
    centres = (left[:, 0] + 0.5) * 6.4
    # A robot at 5 m/s looks every 5 s.
    assert (centres > last_x - 20.0 - 5.0 * 6.0).all()
    assert max(x for x, _ in gone) > 10
    code, said, _ = replay(logs)
    assert (code, said.split(":")[0]) == (0, "equal")


def test_what_is_old_is_forgotten_even_near_the_robot(tmp_path: Path) -> None:
    logs = tmp_path / "log"
    with LoggedRun(logs, keeping(age=8.0)) as run:
        drive(run, 60.0)
        stamps = run.run.map.tile_stamps()[1]
        assert (stamps >= run.run.newest_stamp_ns - 8 * SECOND - INTERVAL_NS).all()
        run.checkpoint()
    assert forgotten(logs)
    assert replay(logs)[0] == 0


def test_a_tile_near_any_robot_is_kept(tmp_path: Path) -> None:
    """One robot stands where the other began."""
    logs = tmp_path / "log"
    with LoggedRun(logs, keeping(radius=20.0)) as run:
        run.scan(0.0, robot="other")
        drive(run, 100.0, first=1.0)
        tiles = set(map(tuple, run.run.map.tile_sequences()[0].tolist()))
    assert (0, 0) in tiles
    assert all(abs((x + 0.5) * 6.4) > 13.0 for event in forgotten(logs) for x, _ in event.tiles)


def test_a_wrong_stamp_of_a_placed_cloud_ages_nothing(tmp_path: Path) -> None:
    with LoggedRun(tmp_path / "log", keeping(age=8.0)) as run:
        drive(run, 20.0)
        before = set(map(tuple, run.run.map.tile_sequences()[0].tolist()))
        run.put(Kind.POINTS, cloud(3e8, shift=900.0, frame="map"), "other")
        (event,) = run.decide()
        assert event.accepted
        assert before < set(map(tuple, run.run.map.tile_sequences()[0].tolist()))


def test_the_ground_under_a_robot_is_kept_whatever_the_radius(tmp_path: Path) -> None:
    """The robot stands at the corner of its tile."""
    with LoggedRun(tmp_path / "log", keeping(radius=0.5)) as run:
        drive(run, 100.0)
        tiles = set(map(tuple, run.run.map.tile_sequences()[0].tolist()))
        x, y, _ = run.run.robots["rover"].buffer.poses[-1].position
    assert (int(x // 6.4), int(y // 6.4)) in tiles
    assert forgotten(tmp_path / "log")


def test_the_map_comes_back_without_them(tmp_path: Path) -> None:
    """From the log alone; from a store's cut before they were forgotten; and from one behind it."""
    logs, store = tmp_path / "log", Store(tmp_path / "map.db")
    with LoggedRun(logs, keeping(radius=20.0), store=store) as run:
        drive(run, 15.0)
        run.snapshot()
        drive(run, 100.0, first=3.0)
        run.checkpoint()
        digest = run.run.map.digest()
        before = run.killed(tmp_path / "killed")
        assert recover(keeping(radius=20.0), before, store).run.map.digest() == digest
        run.snapshot()
    assert recover(keeping(radius=20.0), logs, store).run.map.digest() == digest
    assert recover(keeping(radius=20.0), logs, None).run.map.digest() == digest
    assert len({(tile.tx, tile.ty) for tile in store.read_tiles()}) == run.run.map.tile_count


def test_it_is_looked_for_at_most_every_five_seconds() -> None:
    keep, settings = Keeping(), Settings(keeping(age=1.0))
    assert keep.due(settings, 100 * SECOND)
    assert not keep.due(settings, 100 * SECOND + INTERVAL_NS - 1)
    assert keep.due(settings, 100 * SECOND + INTERVAL_NS)
    assert keep.due(settings, 3 * SECOND), "the map was emptied"
    assert not Keeping().due(Settings(config()), 100 * SECOND)


def test_many_tiles_are_more_than_one_event() -> None:
    tiles = np.zeros((2 * MOST_TILES + 1, 2), np.int32)
    assert [len(some) for some in pieces(tiles)] == [MOST_TILES, MOST_TILES, 1]
    assert list(pieces(tiles[:0])) == []


@pytest.mark.parametrize("tiles", [[(500, 0)], [(0, 0), (500, 0)], [(1 << 40, 0)], [(0, 0), (0, 0)]])
def test_a_log_that_forgets_what_is_not_there(tmp_path: Path, tiles: list[tuple[int, int]]) -> None:
    with LoggedRun(tmp_path / "log") as run:
        run.scan(0.0)
        with pytest.raises(RunError, match="forgets tiles"):
            run.run.follow(ForgetEvent(epoch=1, sequence=2, tiles=tiles))
