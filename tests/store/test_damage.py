"""A log or store whose bytes are not what was written: named, kept beside, and the rest of the run goes on."""

import logging
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from mcap.opcode import Opcode
from mcap.reader import make_reader
from service_tools import LoggedRun, config, inputs_of, read_back

from roughmap_service.engine.recovery import Recovered, recover
from roughmap_service.journal.reader import MAGIC, DamagedLog, LogError, last_log_time, raw_records, read_file
from roughmap_service.offline.replay import replay
from roughmap_service.store.map_db import Store, StoreError


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    return tmp_path / "log"


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "map.db")


def three_files(logs: Path, store: Store | None = None, snapshot_in: int = 2) -> list[str]:
    """A run over three files of two scans each; the map's digest at the end of each."""
    digests = []
    with LoggedRun(logs, store=store) as run:
        for n in range(3):
            for k in range(2):
                run.scan(2.0 * n + k, 0.3 * (2 * n + k))
            if store is not None and n == snapshot_in:
                run.snapshot()
            digests.append(run.run.map.digest())
            if n < 2:
                run.rotate()
    return digests


def flip(path: Path, at: float) -> None:
    """One bit, ``at`` so far through the file."""
    data = bytearray(path.read_bytes())
    data[int(at * len(data))] ^= 4
    path.write_bytes(data)


def goes_on(logs: Path, back: Recovered) -> None:
    """The run is taken up again, and what is there is a whole log."""
    with LoggedRun(logs, recovered=back) as run:
        run.skip_to(50.0)
        run.scan(50.0)
        run.checkpoint()
    assert replay([logs]).difference is None


@pytest.mark.parametrize("damaged", [1, 2])
def test_a_log_ends_before_its_damage(logs: Path, damaged: int, caplog: pytest.LogCaptureFixture) -> None:
    digests = three_files(logs)
    files = sorted(logs.iterdir())
    chunk = files[damaged].read_bytes().index(b"robots/rover/points")
    flip(files[damaged], chunk / files[damaged].stat().st_size)
    with caplog.at_level(logging.WARNING):
        back = recover(config(), logs, None)
    assert back.run.map.digest() == digests[damaged - 1]
    assert f"{files[damaged]}: damaged at or before byte" in caplog.text
    left = {path.name for path in logs.iterdir()}
    assert f"{files[damaged].name}.torn" in left
    assert (f"{files[2].name}.behind" in left) == (damaged == 1)
    goes_on(logs, back)


def test_what_the_store_holds_already_may_be_damaged_in_the_log(logs: Path, store: Store) -> None:
    digests = three_files(logs, store)
    first, second, _ = sorted(logs.iterdir())
    before = first.read_bytes(), second.read_bytes()
    for path, at in ((first, 0.7), (second, 0.01)):  # in a chunk, and in the beginning, which is read of every file
        flip(path, at)
    with pytest.raises(LogError):
        replay([logs])
    back = recover(config(), logs, store)
    assert back.run.map.digest() == digests[2]
    first.write_bytes(before[0])
    second.write_bytes(before[1])
    goes_on(logs, back)


def test_a_file_whose_beginning_is_damaged_is_put_aside_whole(logs: Path) -> None:
    digests = three_files(logs)
    path = sorted(logs.iterdir())[1]
    flip(path, path.read_bytes().index(b"base_sequence") / path.stat().st_size)
    back = recover(config(), logs, None)
    assert back.run.map.digest() == digests[0]
    assert path.with_name(path.name + ".torn").exists()
    goes_on(logs, back)


def test_a_run_without_its_beginning_is_not_replaced_by_a_new_one(logs: Path) -> None:
    three_files(logs)
    path = sorted(logs.iterdir())[0]
    before = sorted(logs.iterdir())
    flip(path, path.read_bytes().index(b"base_sequence") / path.stat().st_size)
    with pytest.raises(DamagedLog, match=path.name):
        recover(config(), logs, None)
    assert sorted(logs.iterdir()) == before


def test_a_closed_file_that_seems_to_go_on_is_damaged(logs: Path) -> None:
    """A length that reaches past the end looks like the tear of a kill; but the file was closed."""
    three_files(logs)
    path = sorted(logs.iterdir())[2]
    data = bytearray(path.read_bytes())
    data[data.index(b"\x06", len(data) // 2) + 4] ^= 1  # in the length of a chunk, 16 MiB more
    path.write_bytes(data)
    with pytest.raises(DamagedLog):
        list(raw_records(path))


@pytest.mark.parametrize("what", ["tile", "cut", "row", "page"])
def test_a_damaged_store_is_rebuilt(logs: Path, store: Store, what: str, caplog: pytest.LogCaptureFixture) -> None:
    digests = three_files(logs, store)
    with closing(sqlite3.connect(store.path)) as db, db:
        db.execute("PRAGMA journal_mode = DELETE")
        if what == "tile":
            db.execute("UPDATE tiles SET state = x'00'")
        elif what == "cut":
            db.execute("UPDATE cut SET value = replace(value, '0.3', '0.4') WHERE name = 'poses'")
        elif what == "row":
            db.execute("DELETE FROM tiles WHERE tx = (SELECT max(tx) FROM tiles)")
    if what == "page":
        store.path.write_bytes(store.path.read_bytes()[: store.path.stat().st_size // 3])
    back = recover(config(), logs, store)
    assert (back.run.map.digest(), back.cut) == (digests[2], None)
    assert str(store.path) in caplog.text
    assert store.path.with_name("map.db.damaged").exists()
    assert not store.exists()


def test_a_damaged_store_that_no_log_can_replace_is_left_alone(logs: Path, store: Store) -> None:
    three_files(logs, store)
    sorted(logs.iterdir())[0].unlink()
    with closing(sqlite3.connect(store.path)) as db, db:
        db.execute("UPDATE tiles SET state = x'00'")
    with pytest.raises(StoreError, match="is damaged"):
        recover(config(), logs, store)
    assert store.exists()
    assert len(inputs_of(read_back(logs))) == 12


def test_an_index_that_became_a_message_is_damage(logs: Path) -> None:
    """Kinds of records stand outside of all checksums, one bit apart: 7 is an index of messages, 5 a message."""
    three_files(logs)
    path = sorted(logs.iterdir())[0]
    data = path.read_bytes()
    at, found = 8, 0  # behind the magic bytes
    while data[at] != Opcode.DATA_END:
        if data[at] == Opcode.MESSAGE_INDEX:
            found += 1
            path.write_bytes(data[:at] + bytes([Opcode.MESSAGE]) + data[at + 1 :])
            with pytest.raises(DamagedLog, match=r"outside of all chunks|damaged"):
                list(read_file(path))
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
    assert found


@pytest.mark.parametrize("size", [16, 30, 44, 90])
def test_a_last_file_with_nothing_but_its_ends(logs: Path, size: int) -> None:
    """As where a power cut kept all pages but two from the disk."""
    digests = three_files(logs)
    last = sorted(logs.iterdir())[-1]
    last.write_bytes(MAGIC.ljust(size - len(MAGIC), b"\0") + MAGIC)
    back = recover(config(), logs, None)
    assert back.run.map.digest() == digests[1]
    assert last.with_name(f"{last.name}.torn").stat().st_size == size
    goes_on(logs, back)


@pytest.mark.parametrize("damaged", [0, 2])
def test_a_damage_behind_all_that_a_file_holds_of_the_run(logs: Path, damaged: int) -> None:
    """As where a power cut kept a footer's beginning from the disk: the next file says that nothing is missing."""
    digests = three_files(logs)
    whole = read_back(logs)
    path = sorted(logs.iterdir())[damaged]
    data = bytearray(path.read_bytes())
    end = data.rindex(bytes([Opcode.DATA_END]) + (4).to_bytes(8, "little"))
    data[end : end + 40] = bytes(40)
    path.write_bytes(data)
    with pytest.raises(DamagedLog):
        read_back(logs)
    back = recover(config(), logs, None)
    assert back.run.map.digest() == digests[-1]
    assert read_back(logs) == whole
    assert {file.name for file in logs.glob("*.mcap?*")} == {f"{path.name}.torn"}
    goes_on(logs, back)


@pytest.mark.parametrize("whole", [True, False], ids=["whole run", "its beginning deleted"])
def test_a_damage_before_the_cut_in_the_cut_s_file(logs: Path, store: Store, whole: bool) -> None:
    """The log ends before the store: the map is the log's, or, where that can't be had, the store's; epochs rise."""
    with LoggedRun(logs, store=store) as run:
        run.scan(0.0)
        run.rotate()
        first = run.run.map.digest()
        run.reset()
        run.scan(1.0)
        assert run.writer.wait_synced(30.0)
        run.scan(2.0)
        run.snapshot()
        stored = run.run.map.digest()
        run.scan(3.0)
        run.checkpoint()
        epoch = run.run.epoch
    files = sorted(logs.iterdir())
    if not whole:
        files[0].unlink()
    data = files[1].read_bytes()
    flip(files[1], data.index(PointCloud.DESCRIPTOR.full_name.encode()) / len(data))
    back = recover(config(), logs, store)
    assert back.run.map.digest() == (first if whole else stored)
    assert back.epoch > epoch
    kept = f"{files[1].name}.{'torn' if whole else 'behind'}"
    assert logs.joinpath(kept).exists()
    with LoggedRun(logs, recovered=back, store=store) as run:
        run.skip_to(50.0)
        run.scan(50.0)
        run.snapshot()
        after = run.run.map.digest()
    again = recover(config(), logs, store)
    assert again.run.map.digest() == after
    assert again.epoch > back.epoch


def test_epochs_rise_although_a_file_that_named_one_is_gone(logs: Path, store: Store) -> None:
    with LoggedRun(logs, store=store) as run:
        run.scan(0.0)
        run.checkpoint()
    with LoggedRun(logs, recovered=recover(config(), logs, store), store=store) as run:
        run.scan(1.0)
        run.snapshot()
        epoch = run.run.epoch
    sorted(logs.iterdir())[-1].unlink()
    assert recover(config(), logs, store).epoch > epoch


def test_what_was_kept_of_a_file_stays_when_it_is_damaged_again(logs: Path) -> None:
    three_files(logs)
    path = sorted(logs.iterdir())[-1]
    sizes = []
    for place in (0.8, 0.7):
        flip(path, place)
        recover(config(), logs, None)
        sizes.append([file.stat().st_size for file in sorted(logs.glob("*.torn*"))])
    assert len(sizes[1]) == 2
    assert sizes[0][0] == sizes[1][0]


@pytest.mark.parametrize("length", [9, 261, 4096])
def test_zeros_where_a_record_was_are_damage(logs: Path, length: int) -> None:
    """Nine of them look like a record of no kind and no length, which readers pass over: what was there is missing."""
    three_files(logs)
    path = sorted(logs.iterdir())[-1]
    data = path.read_bytes()
    chunks = [at for at, kind in record_starts(data) if kind == Opcode.CHUNK]
    assert len(chunks) == 1
    path.write_bytes(data[: chunks[0]] + bytes(length) + data[chunks[0] :])
    with pytest.raises(DamagedLog, match="without a valid opcode"):
        list(read_file(path))


def record_starts(data: bytes) -> Iterator[tuple[int, int]]:
    """Where each record of the data section begins, and its kind."""
    at = 8
    while data[at] != Opcode.DATA_END:
        yield at, data[at]
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")


def test_epochs_of_what_is_lost_do_not_come_again_though_the_start_after_it_ended_early(logs: Path) -> None:
    """By a kill or a stop, before it had begun a file of its own."""
    three_files(logs)
    for _ in range(3):
        with LoggedRun(logs, recovered=recover(config(), logs, None)) as run:
            epoch = run.run.epoch
    first = sorted(logs.iterdir())[0]
    flip(first, first.read_bytes().index(b"robots/rover/points") / first.stat().st_size)
    assert recover(config(), logs, None).epoch > epoch
    back = recover(config(), logs, None)
    assert back.epoch > epoch
    goes_on(logs, back)
    assert recover(config(), logs, None).epoch == back.epoch + 1


def test_a_damaged_footer_does_not_move_the_times_of_the_log(logs: Path) -> None:
    three_files(logs)
    last_ns = recover(config(), logs, None).last_ns
    for path in sorted(logs.iterdir())[:2]:
        data, times = path.read_bytes(), times_of(path)
        # Behind the data end record, opcode 15 of four bytes, they stand in the statistics first.
        at = data.index(times, data.rindex(b"\x0f" + (4).to_bytes(8, "little"))) + len(times) - 1
        path.write_bytes(data[:at] + bytes([data[at] ^ 128]) + data[at + 1 :])
        assert last_log_time(path) == 0
    assert recover(config(), logs, None).last_ns == last_ns


def times_of(path: Path) -> bytes:
    """The first and the last log time of a file's messages, as its footer has them."""
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    times = summary.statistics.message_start_time, summary.statistics.message_end_time
    return b"".join(time.to_bytes(8, "little") for time in times)
