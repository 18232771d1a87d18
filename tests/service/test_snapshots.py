"""A snapshot that can't be made says so, lets go of the map, and leaves the way free for the next."""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from service_tools import WAIT_S, Run, cloud

from roughmap import RoughMap
from roughmap_service.log_file import Kind
from roughmap_service.recovery import recover
from roughmap_service.snapshots import cut_of
from roughmap_service.store import Store


def no_memory(*_: Any, **__: Any) -> Any:
    raise MemoryError


def no_thread(*_: Any) -> None:
    raise RuntimeError("can't start new thread")


@pytest.mark.parametrize(
    ("owner", "name", "fault", "told"),
    [
        (Store, "write", no_memory, "no memory"),
        (RoughMap, "freeze", no_memory, "no memory"),
        (threading.Thread, "start", no_thread, "new thread"),
    ],
)
def test_no_snapshot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, owner: type, name: str, fault: Callable[..., Any], told: str
) -> None:
    store = Store(tmp_path / "map.db")
    with Run(tmp_path / "log", store=store) as run:
        run.put(Kind.POINTS, cloud(1.0, frame="map", points=[[1.0, 1.0, 0.0]]))
        run.decide()
        run.checkpoint()
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, fault)
            thread = run.snapshots.offer(cut_of(run.run, run.config, run.state, run.inbox, run.duplicates))
            if thread is not None:
                thread.join(WAIT_S)
        assert told in run.snapshots.error
        assert str(store.path) in run.snapshots.error
        assert not run.state.map._table.pool.pins.any()
        run.snapshot()
        assert recover(run.config, tmp_path / "log", store).state.map.digest() == run.state.map.digest()
