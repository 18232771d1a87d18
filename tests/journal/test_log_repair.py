"""A file that a kill tore: read up to its last whole record wherever it was torn, and made whole by the repair."""

import contextlib
import errno
import itertools
import os
import shutil
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from replay_tools import replay
from service_tools import WAIT_S, LoggedRun, events_of, inputs_of, read_back

from roughmap_service.journal.reader import TornLog, read_file, read_metadata
from roughmap_service.journal.records import EventRecord, FileStart, InputRecord, LogItem
from roughmap_service.journal.repair import repair


@pytest.fixture(scope="module")
def left(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file as a kill leaves it, in many chunks: each scan and checkpoint was synced before the next."""
    folder = tmp_path_factory.mktemp("left")
    with LoggedRun(folder / "log") as run:
        for k in range(3):
            run.scan(float(k), 0.3 * k)
            run.checkpoint()
            assert run.writer.wait_synced(WAIT_S)
        (path,) = run.killed(folder / "copy").glob("*.mcap")
    return path


def whole_items(path: Path) -> list[LogItem]:
    """What a torn or whole file gives, its beginning aside."""
    found: list[LogItem] = []
    with contextlib.suppress(TornLog):
        found.extend(item for item in read_file(path) if not isinstance(item, FileStart))
    return found


def stock_count(path: Path) -> int:
    """How many messages the stock reader gives of a torn file."""
    count = 0
    with path.open("rb") as stream, contextlib.suppress(EndOfFile, struct.error):
        for record in StreamReader(stream).records:
            count += isinstance(record, Message)
    return count


def lengths(path: Path) -> Iterator[int]:
    """Where to tear: every byte of the beginning and of the end, and a prime's multiples between."""
    size = path.stat().st_size
    return itertools.chain(range(700), range(700, size - 50, 389), range(size - 50, size))


def test_a_torn_file_gives_all_whole_records_wherever_it_is_torn(left: Path, tmp_path: Path) -> None:
    """Never less with more bytes, always the run's own first ones, and of the whole file all."""
    data, expected = left.read_bytes(), whole_items(left)
    assert len(expected) == 15
    path, before = tmp_path / left.name, 0
    begun = False
    for length in lengths(left):
        path.write_bytes(data[:length])
        try:
            read_metadata(path)
        except TornLog:
            assert not begun, f"the beginning is there, but not with {length} bytes"
            continue
        begun = True
        found = whole_items(path)
        assert found == expected[: stock_count(path)], length
        assert len(found) >= before, length
        before = len(found)
    assert begun
    path.write_bytes(data)
    assert whole_items(path) == expected


def test_repaired_wherever_it_is_torn(left: Path, tmp_path: Path) -> None:
    """What was readable is there, the torn rest beside it, nothing else; and the stock reader opens it."""
    data = left.read_bytes()
    size = len(data)
    for number, length in enumerate(itertools.chain(range(0, size, 211), range(size - 20, size + 1))):
        folder = tmp_path / str(number)
        folder.mkdir()
        path = folder / left.name
        path.write_bytes(data[:length])
        try:
            read_metadata(path)
            begun = True
        except TornLog:
            begun = False
        readable = whole_items(path) if begun else []
        torn = repair(path)
        rest = b"" if torn is None else torn.read_bytes()
        assert data[:length].endswith(rest)
        assert {file.name for file in folder.iterdir()} == ({left.name} if begun else set()) | (
            set() if torn is None else {torn.name}
        )
        if not begun:
            assert rest == data[:length]
            continue
        assert whole_items(path) == readable, length
        list(read_file(path))  # and it doesn't end as torn
        with path.open("rb") as stream:
            assert sum(1 for _ in make_reader(stream, validate_crcs=True).iter_messages()) == len(readable)
        again = path.read_bytes()
        assert repair(path) is None
        assert path.read_bytes() == again


def test_a_closed_file_is_never_touched(left: Path, tmp_path: Path) -> None:
    path = tmp_path / left.name
    shutil.copy(left, path)
    repair(path)
    before = path.stat()
    assert repair(path) is None
    after = path.stat()
    assert (after.st_ino, after.st_mtime_ns, after.st_size) == (before.st_ino, before.st_mtime_ns, before.st_size)


def test_garbage_at_the_end_is_torn_off(left: Path, tmp_path: Path) -> None:
    """After a power cut the end may be zeros, old blocks, or a record that looks whole but names a strange channel."""
    strange = b"\x05" + (26).to_bytes(8, "little") + (999).to_bytes(2, "little") + bytes(20) + b"{}  "
    for number, garbage in enumerate([bytes(5000), b"\xff" * 300, os.urandom(400), strange, strange + bytes(100)]):
        path = tmp_path / f"{number}.mcap"
        path.write_bytes(left.read_bytes() + garbage)
        torn = repair(path)
        assert torn is not None
        assert torn.read_bytes() == garbage, number
        assert whole_items(path) == whole_items(left)


def test_a_damaged_chunk_ends_what_is_kept(left: Path, tmp_path: Path) -> None:
    """A flipped bit in a torn file: what lies before it is kept, the rest put aside, bytes and all."""
    data = bytearray(left.read_bytes())
    expected = whole_items(left)
    at = data.index(expected[7].payload) if isinstance(expected[7], InputRecord) else 0
    assert at
    data[at + 3] ^= 1
    path = tmp_path / left.name
    path.write_bytes(data)
    torn = repair(path)
    assert torn is not None
    assert bytes(data).endswith(torn.read_bytes())
    assert len(torn.read_bytes()) > len(data) - at
    kept = whole_items(path)
    assert kept == expected[: len(kept)]
    assert len(kept) == 5, "the chunks before the damaged one"


def test_a_kill_within_the_repair_leaves_one_or_the_other(left: Path, tmp_path: Path) -> None:
    """A half-written new file, a half-written rest, and the whole rest of an earlier tear of the same file."""
    path = tmp_path / left.name
    path.write_bytes(left.read_bytes()[:-3])
    (tmp_path / (left.name + ".part")).write_bytes(b"half of it")
    (tmp_path / (left.name + ".rest")).write_bytes(b"half of the rest")
    (tmp_path / (left.name + ".torn")).write_bytes(b"of an earlier tear")
    torn = repair(path)
    assert torn is not None
    assert (tmp_path / (left.name + ".torn")).read_bytes() == b"of an earlier tear"
    assert left.read_bytes()[:-3].endswith(torn.read_bytes())
    assert sorted(file.name for file in tmp_path.iterdir()) == [left.name, f"{left.name}.torn", torn.name]


def test_a_repaired_run_replays_as_the_torn_one(left: Path, tmp_path: Path) -> None:
    shutil.copy(left, tmp_path)
    torn = replay(tmp_path)
    items = read_back(tmp_path)
    repair(tmp_path / left.name)
    assert torn[0] == 0
    assert replay(tmp_path)[:2] == torn[:2]
    assert (inputs_of(read_back(tmp_path)), events_of(read_back(tmp_path))) == (inputs_of(items), events_of(items))
    assert isinstance(whole_items(tmp_path / left.name)[-1], EventRecord)


def test_a_file_that_was_never_begun_keeps_no_folder_from_being_replayed(left: Path, tmp_path: Path) -> None:
    """As a kill leaves it between the making of a file and its first record."""
    shutil.copy(left, tmp_path)
    expected = replay(tmp_path)[:2]
    for length in (0, 5, 40):
        nothing = tmp_path / left.name.replace("000000", "000001")
        nothing.write_bytes(left.read_bytes()[:length])
        assert replay(tmp_path)[:2] == expected
        code, _, told = replay(nothing)
        assert (code, "ends before its footer" in told) == (2, True)


@pytest.mark.parametrize("which", [0, 1])
def test_a_repair_for_which_there_is_no_room_leaves_all_as_it_was(
    left: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, which: int
) -> None:
    """A full disk must not stay full of tries; with room again the next start repairs the file."""
    path = tmp_path / left.name
    torn = left.read_bytes()[:-40]
    path.write_bytes(torn)
    real, calls = os.fsync, itertools.count()

    def fsync(handle: int) -> None:
        if next(calls) == which:
            raise OSError(errno.ENOSPC, "No space left on device")
        real(handle)

    with monkeypatch.context() as full:
        full.setattr(os, "fsync", fsync)
        with pytest.raises(OSError, match="No space left"):
            repair(path)
    assert list(tmp_path.iterdir()) == [path]
    assert path.read_bytes() == torn
    assert repair(path) == path.with_name(path.name + ".torn")
