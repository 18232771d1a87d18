"""A start after an end, orderly or not: the map, and all that the run needs to go on, from the store and the log."""

import json
import math
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from service_tools import LoggedRun, cloud, config, metadata, odometry, read_back, transform

from roughmap_schemas import Config
from roughmap_schemas.kinds import Kind
from roughmap_service.engine.newest_run import IdentityError
from roughmap_service.engine.recovery import Recovered, recover
from roughmap_service.journal.reader import LogError
from roughmap_service.offline.replay import replay
from roughmap_service.run.run import RunError
from roughmap_service.run.settings import Settings
from roughmap_service.run.transforms import MAX_TRANSFORMS
from roughmap_service.store.map_db import Store, StoreError


def drive(run: LoggedRun, first: int = 0, scans: int = 3) -> None:
    """Some scans, a checkpoint after each."""
    for k in range(first, first + scans):
        run.scan(float(k), 0.3 * k)
        run.checkpoint()


def digest(recovered: Recovered) -> str:
    return recovered.run.map.digest()


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    return tmp_path / "log"


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "map.db")


def test_from_the_log_alone(logs: Path) -> None:
    with LoggedRun(logs) as run:
        drive(run)
    back = recover(config(), logs, None)
    assert (digest(back), back.run_id, back.index, back.epoch) == (run.run.map.digest(), run.run_id, 1, 2)
    assert (back.run.input, back.run.record) == (run.run.input, run.run.record)
    assert back.run.robots["rover"].to_state() == run.run.robots["rover"].to_state()
    assert back.run.duplicates.to_state() == run.run.duplicates.to_state()
    assert replay([logs]).run.map.digest() == digest(back)


def test_from_the_log_of_a_version_whose_limits_on_poses_were_settings(
    logs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A transform that the constant would have forgotten places a cloud again; then the constants hold."""
    shown = config().public_dict()
    with monkeypatch.context() as earlier:
        earlier.setattr(Config, "public_dict", lambda _: {**shown, "input": {**shown["input"], "max_transforms": 1500}})
        run = LoggedRun(logs)
    with run:
        run.run.use(Settings(run.config, max_transforms=1500))
        for k in range(MAX_TRANSFORMS + 1):
            run.put(Kind.TRANSFORM, transform(float(k)))
        run.put(Kind.ODOMETRY, odometry(0.5, frame="odom"))
        run.put(Kind.ODOMETRY, odometry(0.6, frame="odom"))
        run.put(Kind.POINTS, cloud(0.55))
        assert [(event.outcome, event.poses[0][1]) for event in run.decide()] == [("integrated", 1)]
        run.checkpoint()
    back = recover(config(), logs, None)
    assert digest(back) == run.run.map.digest()
    assert replay([logs]).difference is None
    assert back.run.robots["rover"].settings.max_transforms == MAX_TRANSFORMS


def test_nothing_there_is_a_beginning(logs: Path, store: Store) -> None:
    logs.mkdir()
    back = recover(config(), logs, store)
    assert (back.run_id, back.index, back.epoch, back.run.map.sequence) == (None, 0, 1, 0)


@pytest.mark.parametrize("behind", [0, 2])
def test_from_the_store_and_what_the_log_has_behind_it(logs: Path, store: Store, behind: int) -> None:
    with LoggedRun(logs, store=store) as run:
        drive(run)
        run.snapshot()
        drive(run, 3, behind)
    back = recover(config(), logs, store)
    assert digest(back) == run.run.map.digest()
    assert back.run.map.sequence == run.run.map.sequence
    assert back.run.robots["rover"].to_state() == run.run.robots["rover"].to_state()
    assert back.run.duplicates.to_state() == run.run.duplicates.to_state()
    assert back.cut is not None
    assert not back.was_reset


def test_from_the_store_where_the_log_is_gone(logs: Path, store: Store) -> None:
    """The same run in a new epoch: what was told in the one before can't be compared."""
    with LoggedRun(logs, store=store) as run:
        drive(run)
        run.snapshot()
    for path in logs.iterdir():
        path.unlink()
    back = recover(config(), logs, store)
    assert (digest(back), back.run_id, back.epoch) == (run.run.map.digest(), run.run_id, run.run.epoch + 1)
    assert (back.run.input, back.run.record) == (run.run.input, run.run.record)


def test_every_event_is_applied_once_whichever_files_are_left(logs: Path, store: Store) -> None:
    """Files that lie before the cut and its undecided clouds may be gone; with one more gone it can't go on."""
    with LoggedRun(logs, store=store) as run:
        drive(run, 0, 2)
        run.rotate()
        drive(run, 2, 2)
        run.snapshot()
        run.rotate()
        drive(run, 4, 2)
    files = sorted(logs.glob("*.mcap"))
    assert len(files) == 3
    files[0].unlink()
    assert digest(recover(config(), logs, store)) == run.run.map.digest()
    with pytest.raises(LogError, match=r"begins at record .*no store before it"):
        recover(config(), logs, None)
    files[1].unlink()
    with pytest.raises(LogError, match="the store ends at record"):
        recover(config(), logs, store)


def test_a_file_in_which_nothing_stands_yet_goes_on_from_the_store(logs: Path, store: Store) -> None:
    """All files before it were deleted, as `log.keep` may: it tells itself what lies before it."""
    with LoggedRun(logs, store=store) as run:
        drive(run)
        run.rotate()
        run.snapshot()
    before, _ = sorted(logs.glob("*.mcap"))
    before.unlink()
    back = recover(config(), logs, store)
    assert (digest(back), back.run_id, back.index, back.epoch) == (run.run.map.digest(), run.run_id, 2, 2)
    assert (back.run.input, back.run.record) == (run.run.input, run.run.record)


@pytest.mark.parametrize("stored", [False, True])
def test_undecided_clouds_wait_again(logs: Path, store: Store, stored: bool) -> None:
    with LoggedRun(logs, store=store) as run:
        drive(run)
        waiting = run.put(Kind.POINTS, cloud(0.35))
        run.put(Kind.ODOMETRY, odometry(0.3, 0.9), "other")
        if stored:
            run.snapshot()
        drive(run, 5, 0)
    back = recover(config(), logs, store if stored else None)
    assert sorted(back.run.clouds) == [waiting]
    with LoggedRun(logs, recovered=back) as again:
        again.put(Kind.ODOMETRY, odometry(0.3, 0.9))
        again.put(Kind.ODOMETRY, odometry(0.4, 0.9))
        (event,) = again.decide()
        again.checkpoint()
    assert (event.input, event.outcome, event.epoch) == (waiting, "integrated", 2)
    assert replay([logs]).run.map.digest() == again.run.map.digest()


def test_a_reset_behind_the_cut(logs: Path, store: Store) -> None:
    with LoggedRun(logs, store=store) as run:
        drive(run)
        run.snapshot()
        run.reset()
        run.scan(9.0)
    back = recover(config(), logs, store)
    assert (digest(back), back.was_reset) == (run.run.map.digest(), True)
    assert (back.run.epoch, back.epoch) == (2, 3)
    with LoggedRun(logs, recovered=back, store=store) as again:
        again.snapshot()
    assert digest(recover(config(), logs, store)) == run.run.map.digest()


def test_what_a_kill_leaves(logs: Path, tmp_path: Path) -> None:
    with LoggedRun(logs) as run:
        drive(run)
        left = run.killed(tmp_path / "left")
        expected = run.run.map.digest()
    assert digest(recover(config(), left, None)) == expected
    assert replay([left]).run.map.digest() == expected


def test_a_log_that_lost_its_end_is_what_counts(logs: Path, store: Store, tmp_path: Path) -> None:
    """The map after a start equals the replay of the surviving log, even if the store knows more."""
    with LoggedRun(logs, store=store) as run:
        drive(run)
        run.rotate()
        short = run.run.map.digest()
        drive(run, 3)
        run.snapshot()
    sorted(logs.glob("*.mcap"))[1].unlink()
    back = recover(config(), logs, store)
    assert (digest(back), back.cut) == (short, None)
    with LoggedRun(logs, recovered=back, store=store) as again:
        drive(again, 3, 1)
        again.snapshot()
    assert replay([logs]).difference is None
    assert digest(recover(config(), logs, store)) == again.run.map.digest()


def test_a_store_of_another_state_version_is_rebuilt(logs: Path, store: Store) -> None:
    with LoggedRun(logs, store=store) as run:
        drive(run)
        run.snapshot()
    with closing(sqlite3.connect(store.path)) as db, db:
        db.execute("UPDATE cut SET value = '0' WHERE name = 'state_version'")
    back = recover(config(), logs, store)
    assert (digest(back), back.cut) == (run.run.map.digest(), None)
    assert not store.exists()
    assert store.path.with_name("map.db.outdated").exists()


def test_another_map_is_refused_with_both_values(logs: Path, store: Store) -> None:
    with LoggedRun(logs, store=store) as run:
        drive(run, 0, 1)
        run.snapshot()
    other = config(map={"cell_size": 0.25})
    for known in (None, store):
        with pytest.raises(IdentityError, match=r"cell_size is 0\.25 .* but 0\.1 in"):
            recover(other, logs, known)


@pytest.mark.parametrize(("before", "now"), [(0.5, math.inf), (math.inf, 0.5), (0.5, 0.6)])
def test_a_limit_that_is_or_was_infinite_makes_another_map(logs: Path, before: float, now: float) -> None:
    """Maps without it are as those of versions that had no such limit."""
    with LoggedRun(logs, config(map={"max_vertical_sigma": before})) as run:
        drive(run, 0, 1)
    with pytest.raises(IdentityError) as caught:
        recover(config(map={"max_vertical_sigma": now}), logs, None)
    here, there = (repr("inf" if math.isinf(value) else value) for value in (now, before))
    assert f"map.max_vertical_sigma is {here} in the configuration but {there} in" in str(caught.value)
    assert recover(config(map={"max_vertical_sigma": before}), logs, None).run_id == run.run_id


def test_the_newest_of_two_runs(logs: Path, store: Store) -> None:
    with LoggedRun(logs, created_ns=1) as old:
        drive(old, 0, 1)
    with LoggedRun(logs, created_ns=2, store=store) as new:
        drive(new, 0, 2)
        new.snapshot()
    assert recover(config(), logs, None).run_id == new.run_id
    assert recover(config(), logs, store).run_id == new.run_id
    with LoggedRun(logs, created_ns=3) as newest:
        drive(newest, 0, 1)
    with pytest.raises(StoreError, match=newest.run_id[:8]):
        recover(config(), logs, store)


def test_a_log_that_was_tampered_with_is_not_followed(logs: Path) -> None:
    with LoggedRun(logs) as run:
        event = run.scan(0.0)
        run.log_event(event)
    with pytest.raises(RunError, match=f"input {event.input}"):
        recover(config(), logs, None)


def test_a_configuration_of_another_version(logs: Path) -> None:
    with LoggedRun(logs) as run:
        drive(run, 0, 1)
    assert read_back(logs)
    values = json.loads(json.dumps(metadata().configuration))
    values["map"]["gravity"] = 9.81
    from roughmap_service.engine.newest_run import check_identity

    with pytest.raises(IdentityError, match="another version"):
        check_identity(config(), values, logs)
