"""A new run beside an old one, logs of another release, and stores that don't fit the log."""

import json
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
import zstandard
from log_edits import nth, rewrite
from service_tools import LoggedRun, config

from roughmap import RoughMap
from roughmap_service.engine.recovery import begin_new_run, recover
from roughmap_service.run.run import RunError
from roughmap_service.store.map_db import STATE_BYTES, OtherStateVersion, Store, StoreError


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    return tmp_path / "log"


@pytest.fixture
def store(tmp_path: Path) -> Store:
    """In a folder whose name has what is special in a URI."""
    return Store(tmp_path / "50% of #1?" / "map.db")


def drive(logs: Path, store: Store | None = None) -> LoggedRun:
    with LoggedRun(logs, store=store) as run:
        for n in range(2):
            run.scan(float(n))
            run.checkpoint()
        if store is not None:
            run.snapshot()
    return run


def other_digest(payload: bytes) -> bytes:
    return json.dumps({**json.loads(payload), "digest": "0" * 32}).encode()


def test_a_new_run_is_the_newest_even_if_the_clock_was_set_back(logs: Path) -> None:
    with LoggedRun(logs, created_ns=10**18) as old:
        old.scan(0.0)
        old.checkpoint()
    (logs / "roughmap-holiday.mcap").write_bytes(b"no log")
    (logs / f"roughmap-{'f' * 32}-000000.mcap").write_bytes(b"no log either")
    anew = begin_new_run(config(), logs)
    assert (anew.run_id, anew.epoch, anew.run.map.sequence) == (None, 1, 0)
    assert anew.not_before_ns == 10**18 + 1
    with LoggedRun(logs, recovered=anew, created_ns=max(5, anew.not_before_ns)) as new:
        new.scan(0.0)
    (logs / f"roughmap-{'f' * 32}-000000.mcap").unlink()
    assert recover(config(), logs, None).run_id == new.run_id != old.run_id


def test_nothing_to_be_newer_than(tmp_path: Path) -> None:
    assert begin_new_run(config(), tmp_path).not_before_ns == 0


@pytest.mark.parametrize("own", [True, False], ids=["this release", "another"])
def test_a_checkpoint_that_comes_out_otherwise(logs: Path, own: bool, caplog: pytest.LogCaptureFixture) -> None:
    """The same bytes are promised within a release: there it is a damaged log, else it is said and the run goes on."""
    run = drive(logs)
    (path,) = logs.glob("*.mcap")
    changes = {} if own else {"version": "0.0.1"}
    rewrite(path, nth("/events", 1, other_digest), **changes)
    if own:
        with pytest.raises(RunError, match="can't be replayed"):
            recover(config(), logs, None)
    else:
        assert recover(config(), logs, None).run.map.digest() == run.run.map.digest()
        assert "of another version" in caplog.text


def test_a_store_is_put_aside_by_its_run(logs: Path, store: Store) -> None:
    run = drive(logs, store)
    assert store.set_aside().name == f"map.db.{run.run_id}"
    assert not store.exists()


def test_a_store_of_another_version_is_put_aside_too(logs: Path, store: Store) -> None:
    run = drive(logs, store)
    with closing(sqlite3.connect(store.path)) as db, db:
        db.execute("UPDATE cut SET value = '99' WHERE name = 'state_version'")
        db.execute("UPDATE cut SET name = 'something' WHERE name = 'poses'")
    with pytest.raises(OtherStateVersion):
        store.read_cut()
    assert store.set_aside().name == f"map.db.{run.run_id}"


@pytest.mark.parametrize(("run", "name"), [("", "empty"), ('"../../etc"', "unknown"), (None, "empty")])
def test_a_store_without_a_run(store: Store, run: str | None, name: str) -> None:
    store.path.parent.mkdir()
    with closing(sqlite3.connect(store.path)) as db, db:
        if run is not None:
            db.execute("CREATE TABLE cut (name, value)")
        if run:
            db.execute("INSERT INTO cut VALUES ('run', ?)", (run,))
    assert store.set_aside().name == f"map.db.{name}"


def test_what_is_no_store_is_not_put_aside(store: Store) -> None:
    store.path.parent.mkdir()
    store.path.write_bytes(b"holiday pictures " * 100)
    with pytest.raises(StoreError, match=r"not a map\.db"):
        store.set_aside()
    assert store.path.read_bytes().startswith(b"holiday")


def bomb() -> bytes:
    """A frame that says it holds a gibibyte."""
    pack = zstandard.ZstdCompressor().compressobj(size=1 << 30)
    return pack.compress(b"\0" * 1000) + pack.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)


@pytest.mark.parametrize(
    "state", [bomb(), b"", b"noise", "text", zstandard.compress(b"short")], ids=["bomb", "", "noise", "text", "short"]
)
def test_states_that_are_none(logs: Path, store: Store, state: object) -> None:
    drive(logs, store)
    with closing(sqlite3.connect(store.path)) as db, db:
        db.execute("UPDATE tiles SET state = ?", (state,))
    with pytest.raises(StoreError, match=r"tile \(0, .*\) is damaged"):
        list(store.read_tiles())


def test_a_tile_that_can_be_none_of_a_map(logs: Path, store: Store) -> None:
    """Whole, and yet without a known cell."""
    import xxhash

    drive(logs, store)
    raw = bytes(STATE_BYTES[0])
    with closing(sqlite3.connect(store.path)) as db, db:
        db.execute("UPDATE tiles SET state = ?, digest = ?", (zstandard.compress(raw), xxhash.xxh3_128_digest(raw)))
    cut = store.read_cut()
    assert cut is not None
    with pytest.raises(StoreError, match=r"damaged .*expected a known cell"):
        store.load_into(RoughMap(), cut)
