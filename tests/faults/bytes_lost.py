"""A log that ends at any byte, and one flipped bit anywhere in log or store: nothing raised, nothing invented."""

import contextlib
import logging
import random
import shutil
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from mcap.records import Message
from report import Trial
from service_tools import WAIT_S, LoggedRun, config, inputs_of

from roughmap import RoughMap
from roughmap_schemas.kinds import Kind
from roughmap_service.engine.recovery import recover
from roughmap_service.journal.reader import DamagedLog, LogError, TornLog, raw_records
from roughmap_service.journal.records import FileStart, LogItem
from roughmap_service.journal.repair import repair
from roughmap_service.journal.run_files import find_files, one_run, read_run
from roughmap_service.store.map_db import Store, StoreError

LAST = 64 * 1024
"""Bytes of the log's end at every one of which it is cut."""

FOOTER = 8 * 1024
"""The same for one that was closed in order: its data are cut as the other's are, what stands behind them is not."""


def _drive(run: LoggedRun, first: int, scans: int, rng: np.random.Generator, points: int) -> None:
    """Scans of a size, with a reset, a checkpoint and a cloud without poses among them."""
    from service_tools import cloud

    for k in range(first, first + scans):
        run.scan(float(k), 0.3 * k)
        body = rng.uniform([-3.0, -3.0, -0.5], [3.0, 3.0, 0.5], (points, 3))
        run.put(Kind.POINTS, cloud(0.1 * k + 0.05, points=body))
        run.decide()
        if k % 4 == 3:
            run.checkpoint()
    run.put(Kind.POINTS, cloud(first + 0.5), "blind")
    run.decide(100.0)


def _log(folder: Path, rng: random.Random, *, closed: bool, points: int = 1200) -> Path:
    """A run over two files, the last of which is a little longer than `LAST`, closed or as a kill leaves it."""
    numbers = np.random.default_rng(rng.randrange(1 << 30))
    with LoggedRun(folder / "whole") as run:
        _drive(run, 0, 2, numbers, 50)
        run.reset()
        run.rotate()
        for k in range(5):  # each of them flushed: the ends of chunks are where a cut tells most
            _drive(run, 2 + k, 1, numbers, points)
            assert run.writer.wait_synced(WAIT_S)
        left = run.killed(folder / "left")
    return folder / "whole" if closed else left


def _items(log: Path) -> list[LogItem]:
    """The run without its files' beginnings, of which a rewritten one has a place of its own."""
    return [item for item in read_run(one_run(find_files([log]))) if not isinstance(item, FileStart)]


def log_cuts(trial: Trial, folder: Path, rng: random.Random, number: int | None) -> None:
    """Cut a log at every byte of its end (``number`` None), or at so many, those around the records among them."""
    logging.disable(logging.WARNING)
    try:
        for closed in (True, False):
            _cut_all(trial, folder / f"cuts-{closed}", rng, number, closed=closed)
    finally:
        logging.disable(logging.NOTSET)


def _cut_all(trial: Trial, folder: Path, rng: random.Random, number: int | None, *, closed: bool) -> None:
    log = _log(folder, rng, closed=closed)
    whole, last = _items(log), sorted(log.glob("*.mcap"))[-1]
    content, messages = last.read_bytes(), _messages(last)
    trial.expect(len(content) > LAST, f"the last file has {len(content)} bytes only")
    work = folder / "work"
    shutil.copytree(log, work, ignore=shutil.ignore_patterns(".lock"))
    path = work / last.name
    before, rewritten, there = -1, b"", []
    for cut in _places(content, rng, number, FOOTER if closed else LAST):
        for torn in work.glob(f"{last.name}.*"):
            torn.unlink()  # else each repair would look for one name more
        path.write_bytes(content[:cut])
        where = f"cut at byte {cut} of {len(content)}"
        try:
            repair(path)
            now = path.read_bytes() if path.exists() else b""
            if now == rewritten and before >= 0:  # to the byte what was looked at already
                trial.once()
                continue
            rewritten, there = now, _messages(path) if now else []
            if len(there) != before:  # what a run comes to depends on nothing but the messages that are left of it
                items, back = _items(work), recover(config(), work, None)
                trial.expect(items == whole[: len(items)], f"{where}: the run is not the beginning of what was written")
                trial.expect(back.run.input == len(inputs_of(items)), f"{where}: recovered to {back.run.input}")
                trial.note("recovered whole")
        except Exception as error:  # noqa: BLE001 - whatever it was, a start would fail
            trial.expect(False, f"{where}: {type(error).__name__}: {error}")
            continue
        trial.expect(there == messages[: len(there)], f"{where}: what is read is not the beginning of what was written")
        trial.expect(len(there) >= before, f"{where}: fewer messages than with a byte less")
        before = len(there)
        trial.once()
    trial.expect(before == len(messages), f"the whole log gives {before} of {len(messages)} messages")


def _messages(path: Path) -> list[tuple[int, bytes]]:
    """Channel and bytes of a file's messages, checksums looked at, as far as it goes."""
    found = []
    with contextlib.suppress(TornLog):
        for record, _ in raw_records(path):
            if isinstance(record, Message):
                found.append((record.channel_id, record.data))
    return found


def _places(content: bytes, rng: random.Random, number: int | None, last: int) -> Iterable[int]:
    every = range(max(len(content) - last, 0), len(content) + 1)
    if number is None:
        return every
    edges = {at + k for at in range(every.start, len(content)) if content[at : at + 1] == b"\x06" for k in (0, 1)}
    some = rng.sample(sorted(edges), min(number // 2, len(edges))) + rng.sample(every, min(number // 2, len(every)))
    return sorted({place for place in [*some, len(content)] if place in every})


def log_flips(trial: Trial, folder: Path, rng: random.Random, number: int) -> None:
    """Flip one bit of a closed log: what is read is what was written, or the damage is named; a start goes on."""
    log = _log(folder, rng, closed=True, points=20)
    whole = _items(log)
    digest = recover(config(), log, None).run.map.digest()
    files = sorted(log.glob("*.mcap"))
    work = folder / "work"
    logging.disable(logging.ERROR)
    for _ in range(number):
        shutil.rmtree(work, ignore_errors=True)
        shutil.copytree(log, work)
        file, at, bit = rng.choice(files), 0, rng.randrange(8)
        path = work / file.name
        data = bytearray(path.read_bytes())
        at = rng.randrange(len(data))
        data[at] ^= 1 << bit
        path.write_bytes(data)
        where = f"bit {bit} of byte {at} of {file.name[-11:]} ({len(data)} bytes)"
        try:
            items = _items(work)
            trial.expect(items == whole, f"{where}: read as something else, and nothing said")
            trial.note("without a bearing on the run")
        except LogError as error:
            trial.expect(file.name in str(error), f"{where}: not named: {error}")
            trial.note("named")
        try:
            back = recover(config(), work, None)
            items = _items(work)
            trial.expect(items == whole[: len(items)], f"{where}: a start takes up what was not written")
            trial.expect(len(items) < len(whole) or back.run.map.digest() == digest, f"{where}: another map")
        except DamagedLog as error:
            trial.expect(file.name in str(error), f"{where}: not named: {error}")
            trial.note("left to the operator")
        except Exception as error:  # noqa: BLE001 - nothing else may come
            trial.expect(False, f"{where}: a start fails: {type(error).__name__}: {error}")
        trial.once()
    logging.disable(logging.NOTSET)


def _stamps(rough_map: RoughMap) -> list[tuple[int, int]]:
    with rough_map.freeze() as frozen:
        return [frozen.stamps(x, y) for x, y in frozen.tiles.tolist()]


def store_flips(trial: Trial, folder: Path, rng: random.Random, number: int) -> None:
    """Flip one bit of the store: the map is that of the log, or the damage is named."""
    numbers = np.random.default_rng(rng.randrange(1 << 30))
    store = Store(folder / "map.db")
    with LoggedRun(folder / "whole", store=store) as run:
        _drive(run, 0, 6, numbers, 300)
        run.snapshot()
        _drive(run, 6, 2, numbers, 300)
        digest, stamps = run.run.map.digest(), _stamps(run.run.map)
    content = store.path.read_bytes()
    work = folder / "work"
    logging.disable(logging.ERROR)
    for _ in range(number):
        shutil.rmtree(work, ignore_errors=True)
        shutil.copytree(folder / "whole", work / "log")
        at, bit = rng.randrange(len(content)), rng.randrange(8)
        data = bytearray(content)
        data[at] ^= 1 << bit
        flipped = Store(work / "map.db")
        flipped.path.write_bytes(data)
        where = f"bit {bit} of byte {at} of the store ({len(data)} bytes)"
        try:
            back = recover(config(), work / "log", flipped)
            trial.expect(back.run.map.digest() == digest, f"{where}: another map")
            trial.expect(_stamps(back.run.map) == stamps, f"{where}: tiles of other times")
            trial.note("without a bearing on the map" if back.cut is not None else "rebuilt from the log")
        except StoreError as error:
            trial.expect(str(flipped.path) in str(error), f"{where}: not named: {error}")
            trial.note("left to the operator")
        except Exception as error:  # noqa: BLE001 - nothing else may come
            trial.expect(False, f"{where}: a start fails: {type(error).__name__}: {error}")
        trial.once()
    logging.disable(logging.NOTSET)
