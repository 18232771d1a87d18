"""A snapshot that can't be made says so, lets go of the map, and leaves the way free for the next."""

import logging
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import zstandard
from service_tools import WAIT_S, LoggedRun, cloud, config

from roughmap import RoughMap
from roughmap_schemas.kinds import Kind
from roughmap_service.engine.recovery import recover
from roughmap_service.run.poses import PoseBuffer
from roughmap_service.store import snapshots
from roughmap_service.store.map_db import Store


def no_memory(*_: Any, **__: Any) -> Any:
    raise MemoryError


def no_memory_to_pack(*_: Any) -> None:
    raise zstandard.ZstdError("cannot compress: Allocation error : not enough memory")


def no_thread(*_: Any) -> None:
    raise RuntimeError("can't start new thread")


@pytest.mark.parametrize(
    ("owner", "name", "fault", "told"),
    [
        (Store, "write", no_memory, "no memory"),
        (Store, "write", no_memory_to_pack, "not enough memory"),
        (RoughMap, "freeze", no_memory, "no memory"),
        (PoseBuffer, "to_state", no_memory, "no memory"),
        (threading.Thread, "start", no_thread, "new thread"),
    ],
)
def test_no_snapshot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, owner: type, name: str, fault: Callable[..., Any], told: str
) -> None:
    store = Store(tmp_path / "map.db")
    with LoggedRun(tmp_path / "log", store=store) as run:
        run.put(Kind.POINTS, cloud(1.0, frame="map", points=[[1.0, 1.0, 0.0]]))
        run.decide()
        run.checkpoint()
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, fault)
            thread = run.snapshots.offer(run.cut)
            if thread is not None:
                thread.join(WAIT_S)
        assert told in run.snapshots.error
        assert str(store.path) in run.snapshots.error
        assert not run.snapshots.ok
        assert not run.run.map._table.pool.pins.any()
        run.snapshot()
        assert run.snapshots.ok
        assert recover(run.config, tmp_path / "log", store).run.map.digest() == run.run.map.digest()


def test_what_was_forgotten_is_forgotten_after_a_start(tmp_path: Path) -> None:
    """Tiles that a snapshot had stored; the next one may be the last thing that the run did."""
    store = Store(tmp_path / "map.db")
    with LoggedRun(tmp_path / "log", store=store) as run:
        run.put(Kind.POINTS, cloud(1.0, frame="map", points=[[1.0, 1.0, 0.0], [40.0, 1.0, 0.0]]))
        run.decide()
        run.snapshot()
        assert run.run.map.forget([(6, 0)]) == 1
        run.snapshot()
    assert [(tile.tx, tile.ty) for tile in store.read_tiles()] == [(0, 0)]
    cut = store.read_cut()
    assert cut is not None
    assert (cut.sequence, cut.digest) == (2, run.run.map.digest())


def test_a_snapshot_that_fails_lets_no_file_of_the_log_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The store is still the one before it, and may need them."""
    store = Store(tmp_path / "map.db")
    bounded = config(log={"keep": 1}, store={"path": str(store.path)})
    with LoggedRun(tmp_path / "log", bounded, store=store) as run:
        for t in range(2):
            run.scan(float(t))
            run.rotate()
        assert run.writer.wait_synced(WAIT_S)
        files = {path.name for path in (tmp_path / "log").glob("*.mcap")}
        with monkeypatch.context() as patch:
            patch.setattr(Store, "write", no_memory)
            thread = run.snapshots.offer(run.cut)
            assert thread is not None
            thread.join(WAIT_S)
        assert {path.name for path in (tmp_path / "log").glob("*.mcap")} == files
        assert len(files) == 3
        run.snapshot()
        assert [path.name for path in (tmp_path / "log").glob("*.mcap")] == [run.writer.path.name]


def test_what_the_store_does_not_take_is_reported_once_and_so_is_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    with LoggedRun(tmp_path / "log", store=Store(tmp_path / "folder" / "map.db")) as run:
        (tmp_path / "folder").write_text("a file is in its way")
        for _ in range(3):
            thread = run.snapshots.offer(run.cut)
            assert thread is not None
            thread.join(WAIT_S)
            assert not run.snapshots.ok
        (tmp_path / "folder").unlink()
        run.snapshot()
        run.snapshot()
    told = [record.event for record in caplog.records if record.name == snapshots.__name__]  # type: ignore[attr-defined]
    assert told == ["snapshot_failed", "snapshot_recovered", "snapshot", "snapshot"]


def test_a_store_that_hangs_is_one_that_takes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From when that is seen on, until a snapshot is there."""
    asked, free, write = threading.Event(), threading.Event(), Store.write

    def stuck(*arguments: Any) -> None:
        asked.set()
        assert free.wait(WAIT_S)
        write(*arguments)

    monkeypatch.setattr(snapshots, "HANG_SECONDS", 0.0)
    monkeypatch.setattr(Store, "write", stuck)
    store = Store(tmp_path / "map.db")
    with LoggedRun(tmp_path / "log", store=store) as run:
        run.snapshots.look()
        assert run.snapshots.ok, "nothing is being stored"
        thread = run.snapshots.offer(run.cut)
        assert thread is not None
        assert asked.wait(WAIT_S)
        assert run.snapshots.ok, "nobody looked"
        run.snapshots.look()
        assert (run.snapshots.ok, run.snapshots.error) == (False, f"{store.path}: its disk has not answered for 0 s")
        free.set()
        thread.join(WAIT_S)
        run.snapshots.look()
        assert (run.snapshots.ok, run.snapshots.error) == (True, "")
