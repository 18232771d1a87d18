"""A power cut that leaves nothing that was not synced, at every call of a start that repairs a log, and behind a run's
beginning, a snapshot, a store put aside: what chance finds by and by in `make faults`, found each time."""

import os
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import paths  # noqa: F401 - before what it makes importable
from cut_states import DiskTree
from journals import DIES, journal_of
from service_tools import WAIT_S, LoggedRun, config, inputs_of, read_back
from shim import Shim

from roughmap_service.engine.recovery import recover
from roughmap_service.host.disk import make_directory
from roughmap_service.store.map_db import Store


class Worst(random.Random):
    """Of what a cut may leave, the least."""

    def choice(self, seq: Any) -> Any:
        return seq[0]


def store_of(log: Path) -> Store:
    return Store(log.parent / "store" / "map.db")


def killed(log: Path) -> None:
    """A run that ends by a kill, all of it on the disk."""
    make_directory(log)
    run = LoggedRun(log)
    for k in range(3):
        run.scan(float(k), 0.3 * k)
    assert run.writer.wait_synced(WAIT_S)
    os._exit(DIES)


def started(log: Path) -> None:
    """A start after that, which gives its file a footer."""
    recover(config(), log, None)
    os._exit(DIES)


def begun(log: Path) -> None:
    """A run with nothing in it: a service that is ready, and may have told its epoch."""
    make_directory(log)
    LoggedRun(log)
    os._exit(DIES)


def stored(log: Path) -> None:
    """A run with a snapshot."""
    make_directory(log)
    run = LoggedRun(log, store=store_of(log))
    run.scan(0.0)
    run.snapshot()
    os._exit(DIES)


def put_aside(log: Path) -> None:
    """What `--fresh` does to the store."""
    store_of(log).set_aside()
    os._exit(DIES)


def left_of(shim: Shim, where: Path, *steps: Callable[[Path], None]) -> Path:
    """What the worst cut behind the last step leaves."""
    disk = DiskTree(shim.root)
    for call in journal_of(shim, *steps):
        disk.take(call)
    disk.top.write(where, Worst())
    return where


def test_a_repair_never_takes_away_what_was_on_the_disk(tmp_path: Path) -> None:
    shim = Shim(tmp_path / "shim", journal=True)
    before = len(journal_of(shim, killed))
    whole = [one.payload for one in inputs_of(read_back(shim.root / "log"))]
    calls = journal_of(shim, started)
    assert (len(whole), len(calls) > before) == (9, True)
    disk = DiskTree(shim.root)
    for number, call in enumerate(calls, 1):
        disk.take(call)
        if number >= before:
            left = tmp_path / f"left{number}"
            disk.top.write(left, Worst())
            recover(config(), left / "log", None)
            assert [one.payload for one in inputs_of(read_back(left / "log"))] == whole, f"cut behind call {number}"


def test_an_epoch_that_may_have_been_published_is_not_used_again(tmp_path: Path) -> None:
    left = left_of(Shim(tmp_path / "shim", journal=True), tmp_path / "left", begun)
    assert recover(config(), left / "log", None).epoch == 2


def test_a_reported_snapshot_is_on_disk(tmp_path: Path) -> None:
    shim = Shim(tmp_path / "shim", journal=True)
    left = left_of(shim, tmp_path / "left", stored)
    there = store_of(shim.root / "log").read_cut()
    assert there is not None
    assert store_of(left / "log").read_cut() == there
    assert [tile.digest for tile in store_of(left / "log").read_tiles()] == [
        tile.digest for tile in store_of(shim.root / "log").read_tiles()
    ]


def test_a_store_that_was_put_aside_stays_there(tmp_path: Path) -> None:
    """Else it would come back beside the log of the new run, and no start would go on from the two."""
    shim = Shim(tmp_path / "shim", journal=True)
    left = left_of(shim, tmp_path / "left", stored, put_aside)
    (aside,) = (shim.root / "store").glob("map.db.*")
    assert not store_of(left / "log").exists()
    assert Store(left / "store" / aside.name).read_cut() == Store(aside).read_cut() is not None
