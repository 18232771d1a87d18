"""Old files of the log go when a snapshot is committed, and never one that a start would need."""

from pathlib import Path

import pytest
from service_tools import Run, cloud, config, odometry

from roughmap_schemas import Config
from roughmap_service.log_file import Kind
from roughmap_service.recovery import recover
from roughmap_service.store import Store


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    return tmp_path / "log"


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "map.db")


def kept(store: Store, size: int = 1) -> Config:
    return config(log={"keep": size}, store={"path": str(store.path)})


def indexes(logs: Path) -> list[int]:
    return sorted(int(path.stem[-6:]) for path in logs.glob("*.mcap"))


def drive(run: Run, first: int, files: int = 2) -> None:
    """A scan a file."""
    for n in range(first, first + files):
        run.scan(float(n))
        run.rotate()


def test_each_snapshot_deletes_what_lies_before_it(logs: Path, store: Store) -> None:
    with Run(logs, kept(store), store=store) as run:
        drive(run, 0)
        assert run.writer.wait_synced(30.0)
        assert indexes(logs) == [0, 1, 2]
        run.snapshot()
        assert indexes(logs) == [2], "the file that is written to stays"
        drive(run, 2)
        run.snapshot()
        assert indexes(logs) == [4]
        run.scan(9.0)
    assert recover(kept(store), logs, store).state.map.digest() == run.state.map.digest()


def test_an_undecided_cloud_keeps_its_file_and_all_behind(logs: Path, store: Store) -> None:
    with Run(logs, kept(store), store=store) as run:
        drive(run, 0, 1)
        waiting = run.put(Kind.POINTS, cloud(50.0), "slow")
        drive(run, 1)
        run.snapshot()
        assert indexes(logs) == [1, 2, 3]
        back = recover(kept(store), run.killed(logs.with_name("left")), store)
        assert [number for number, _, _ in back.undecided] == [waiting]
        run.put(Kind.ODOMETRY, odometry(50.0), "slow")
        assert [event.input for event in run.decide()] == [waiting]
        run.snapshot()
        assert indexes(logs) == [3]


def test_as_many_bytes_as_the_configuration_says(logs: Path, store: Store) -> None:
    with Run(logs, kept(store, 1 << 30), store=store) as run:
        drive(run, 0, 3)
        run.snapshot()
        assert indexes(logs) == [0, 1, 2, 3]
        sizes = [path.stat().st_size for path in sorted(logs.glob("*.mcap"))]
    with Run(logs, kept(store, sizes[1] + sizes[2]), recovered=recover(kept(store), logs, store), store=store) as again:
        again.rotate()
        again.snapshot()
        closed = sorted(logs.glob("*.mcap"))[:-1]
        assert sum(path.stat().st_size for path in closed) <= sizes[1] + sizes[2]
        assert closed, "and no more than that goes"
        again.scan(20.0)
    assert recover(kept(store), logs, store).state.map.digest() == again.state.map.digest()


def test_without_a_bound_all_stays(logs: Path, store: Store) -> None:
    with Run(logs, config(store={"path": str(store.path)}), store=store) as run:
        drive(run, 0)
        run.snapshot()
    assert indexes(logs) == [0, 1, 2]


def test_without_a_store_it_is_no_setting() -> None:
    with pytest.raises(ValueError, match=r"log\.keep"):
        config(log={"keep": 1000})
