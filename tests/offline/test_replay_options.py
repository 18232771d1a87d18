"""`roughmap replay` from a store, into a log of its own, and under other settings."""

import json
from dataclasses import replace as with_values
from pathlib import Path

import pytest
from replay_tools import drive, refused, replay
from service_tools import LoggedRun, cloud, config, events_of, inputs_of, odometry, read_back, starts_of

from roughmap import RoughMap
from roughmap_schemas.kinds import Kind
from roughmap_service.cli.main import run as command
from roughmap_service.engine.recovery import recover
from roughmap_service.offline.replay import what_if
from roughmap_service.store.map_db import Store


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    return tmp_path / "log"


def test_from_a_store(logs: Path, tmp_path: Path) -> None:
    """From the cut on, with a cloud that waited then: what lies before it isn't needed, and isn't done twice."""
    store = Store(tmp_path / "map.db")
    with LoggedRun(logs, store=store) as run:
        drive(run, 0, 2)
        run.rotate()
        drive(run, 2, 1)
        run.put(Kind.POINTS, cloud(0.35))
        run.snapshot()
        run.put(Kind.ODOMETRY, odometry(0.3, 0.9))
        run.put(Kind.ODOMETRY, odometry(0.4, 1.0))
        assert [event.outcome for event in run.decide()] == ["integrated"]
        run.rotate()
        drive(run, 5, 1)
    files = sorted(logs.glob("*.mcap"))
    equal = f"equal: 2 checkpoints, sequence 5, digest {run.run.map.digest()}"
    assert replay(logs, "--from", store.path)[:2] == (0, equal)
    assert replay(*files[1:], "--from", store.path)[:2] == (0, equal)
    refused(replay(files[2], "--from", store.path), "gap: ")
    refused(replay(logs, "--from", store.path, "--log-out", tmp_path / "new"), "--log-out needs the whole run")
    refused(replay(logs, "--from", store.path, "--what-if", "map.cell_size=0.2"), "--what-if needs the whole run")
    with LoggedRun(tmp_path / "other") as other:
        drive(other, 0, 1)
    refused(replay(tmp_path / "other", "--from", store.path), "belongs to run")


def test_a_store_that_is_not_in_the_log_gives_another_map(logs: Path, tmp_path: Path) -> None:
    """What lies before the cut is taken on trust; a store of another map shows at the next digest."""
    store = Store(tmp_path / "map.db")
    with LoggedRun(logs, store=store) as run:
        drive(run, 0, 2)
        cut_of_the_first_two = run.run.map.digest()
        run.rotate()
        run.snapshot()
        drive(run, 2, 1)
    with LoggedRun(tmp_path / "else") as other:
        drive(other, 0, 1)
        other.scan(1.0, 3.0)
    cut = store.read_cut()
    assert cut is not None
    assert other.run.map.digest() != cut_of_the_first_two
    with other.run.map.freeze() as frozen:
        store.write(cut, frozen, None)
    code, last, _ = replay(logs, "--from", store.path)
    assert (code, last.split(":")[0]) == (1, "differs at sequence 2"), "where the first file behind the cut begins"


def test_a_replays_own_log_is_equal_and_keeps_each_files_settings(logs: Path, tmp_path: Path) -> None:
    with LoggedRun(logs) as run:
        drive(run)
        run.rotate()
        drive(run, 3)
        run.reset()
        drive(run, 6, 1)
    other = config(sensors={"lidar": {"range_sigma": 0.05}}, log={"compression": "zstd"})
    with LoggedRun(logs, other, recovered=recover(other, logs, None)) as run:
        drive(run, 7)
    new = tmp_path / "new"
    first = replay(logs, "--log-out", new)
    assert first[0] == 0
    assert replay(new)[:2] == first[:2]
    old_items, new_items = read_back(logs), read_back(new)
    assert events_of(new_items) == events_of(old_items)
    assert inputs_of(new_items) == inputs_of(old_items), "numbers, places, bytes and times"
    starts = starts_of(new_items)
    assert [start.config for start in starts] == [start.config for start in starts_of(old_items)]
    assert len({start.metadata.run for start in starts} | {run.run_id}) == 2, "it is a run of its own"
    assert replay(new, "--log-out", tmp_path / "again")[:2] == first[:2]


def test_a_log_goes_to_an_empty_folder_only_and_that_is_seen_first(logs: Path, tmp_path: Path) -> None:
    with LoggedRun(logs) as run:
        drive(run)
    outcome = replay(logs, "--log-out", tmp_path)
    refused(outcome, "is not empty")
    assert "replay:" not in outcome[2], "nothing was replayed before"
    (tmp_path / "map.db").touch()
    outcome = replay(logs, "-o", tmp_path / "map.db")
    refused(outcome, "exists; name another file")
    assert "replay:" not in outcome[2]
    (tmp_path / "new").mkdir()
    assert replay(logs, "--log-out", tmp_path / "new")[0] == 0


def test_what_if(logs: Path, tmp_path: Path) -> None:
    """Every file under its own settings but for the one that is changed: the same as a run that had it so."""
    noisy = {"lidar": {"range_sigma": 0.05}}
    for directory, cell_size in ((logs, 0.1), (tmp_path / "coarse", 0.2)):
        first, second = config(map={"cell_size": cell_size}), config(map={"cell_size": cell_size}, sensors=noisy)
        with LoggedRun(directory, first) as run:
            drive(run)
        with LoggedRun(directory, second, recovered=recover(second, directory, None)) as run:
            drive(run, 3)
    store, new = tmp_path / "map.db", tmp_path / "new"
    code, told, _ = replay(logs, "--what-if", "map.cell_size=0.2", "--json", "-o", store, "--log-out", new)
    result = json.loads(told)
    assert (code, result["equal"]) == (0, True)
    heights = next(layer for layer in result["what_if"] if layer["layer"] == "mean_height")
    assert heights["cells"] > 0
    cut = Store(store).read_cut()
    assert cut is not None
    rough_map = RoughMap(cell_size=0.2)
    Store(store).load_into(rough_map, cut)
    assert rough_map.digest() == run.run.map.digest()
    assert cut.configuration["map"]["cell_size"] == 0.2
    code, last, _ = replay(new)
    assert (code, last.rpartition(" ")[2]) == (0, run.run.map.digest())


def test_what_if_there_had_been_room_for_more_tiles(logs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with LoggedRun(logs, config(map={"max_tiles": 2})) as run:
        assert [run.scan(float(t), 10.0 * t).outcome for t in range(3)] == ["integrated", *["too_many_tiles"] * 2]
        run.checkpoint()
    assert replay(logs)[0] == 0
    capsys.readouterr()
    assert command(["replay", str(logs), "--what-if", "map.max_tiles=9"]) == 0
    assert "confidence_factor" in capsys.readouterr().out, "no name is cut where no terminal's width wants it"
    state = what_if([logs], lambda _: config(map={"max_tiles": 9}))
    assert state.map.tile_count > run.run.map.tile_count
    assert state.map.sequence == 3


@pytest.mark.parametrize("change", ["map.cell_sizes=1", "map.cell_size=-1", "map.cell_size.x=1", "nothing.there=1"])
def test_what_if_of_no_setting_is_seen_first(change: str, logs: Path) -> None:
    with LoggedRun(logs) as run:
        drive(run)
    outcome = replay(logs, "--what-if", change)
    refused(outcome, "--what-if ")
    assert "replay:" not in outcome[2]


def test_a_store_that_the_logs_dont_go_on_from(logs: Path, tmp_path: Path) -> None:
    """A cloud that waited at the cut lies in a file that is not there; or the store's map is another map."""
    store = Store(tmp_path / "map.db")
    with LoggedRun(logs, store=store) as run:
        run.put(Kind.POINTS, cloud(0.05))
        run.rotate()
        run.snapshot()
        run.put(Kind.ODOMETRY, odometry(0.0))
        run.put(Kind.ODOMETRY, odometry(0.1))
        assert [event.outcome for event in run.decide()] == ["integrated"]
        run.checkpoint()
    files = sorted(logs.glob("*.mcap"))
    refused(replay(files[1], "--from", store.path), "gap: the logs begin at input 2")
    assert replay(logs, "--from", store.path)[0] == 0
    cut = store.read_cut()
    assert cut is not None
    with RoughMap() as empty, empty.freeze() as frozen:
        store.write(with_values(cut, configuration_digest="0" * 32), frozen, None)
    refused(replay(logs, "--from", store.path), "different settings in [map]")
    refused(replay(logs, "--from", logs.parent / "empty.db"), "empty.db")
    (logs.parent / "text.db").write_text("no SQLite file" * 100)
    refused(replay(logs, "--from", logs.parent / "text.db"), "text.db")
