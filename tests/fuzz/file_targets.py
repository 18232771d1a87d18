"""What is read from files, as functions of any bytes; they lie in memory (/dev/shm) where there is such a place."""

import contextlib
import logging
import sqlite3
import tempfile
from functools import cache
from pathlib import Path

import numpy as np
import xxhash

from roughmap_schemas import ConfigFault, config_from
from roughmap_schemas.config_load import load_config
from roughmap_service.formats.clouds import read_cloud
from roughmap_service.formats.recorded import CloudFileFault, PlacedPoints
from roughmap_service.journal.reader import LogError, is_closed, last_log_time, raw_records, read_file
from roughmap_service.journal.repair import repair
from roughmap_service.journal.run_files import find_files, one_run, read_run
from roughmap_service.store.map_db import STATE_BYTES, Store, StoreError, tile_checksum
from roughmap_service.store.stored_tiles import read_index


@cache
def _keep() -> "tempfile.TemporaryDirectory[str]":
    shared = Path("/dev/shm")
    return tempfile.TemporaryDirectory(prefix="roughmap-fuzz-", dir=shared if shared.is_dir() else None)


def _file(name: str, payload: bytes) -> Path:
    """The only file in a folder of its own."""
    folder = Path(_keep().name)
    for old in folder.iterdir():
        old.unlink()
    path = folder / name
    path.write_bytes(payload)
    return path


def configuration(payload: bytes) -> None:
    """TOML, and behind a zero byte lines NAME=VALUE of the environment (without ROUGHMAP_)."""
    text, _, variables = payload.partition(b"\0")
    lines = variables.decode(errors="replace").splitlines()
    environ = {f"ROUGHMAP_{name}": value for name, _, value in (line.partition("=") for line in lines)}
    with contextlib.suppress(ConfigFault):
        config = load_config(_file("roughmap.toml", text), environ=environ).config
        public = config.public_dict()
        secrets = {"password": None, "user": None}
        shown = {**public, "zenoh": {**public["zenoh"], **secrets}, "http": {**public["http"], "token": None}}
        assert config_from({**shown}, "shown").public_dict() == shown


def log(payload: bytes) -> None:
    """A log file, read and recovered: what is whole stays, nothing is invented, and the result is a closed file."""
    path = _file("run-000000.mcap", payload)
    before: list[object] = []
    with contextlib.suppress(LogError):
        before.extend(read_file(path))  # what came before an error stays
    with contextlib.suppress(LogError):
        list(read_run(one_run(find_files([path.parent]))))
    last_log_time(path)
    logging.disable()  # each repair is told of
    try:
        repair(path, damaged=True)
    finally:
        logging.disable(logging.NOTSET)
    if not path.exists():
        assert not before, "what could be read was put away"
        return
    assert is_closed(path)
    assert list(raw_records(path))
    with contextlib.suppress(LogError):
        after = list(read_file(path))
        assert len(after) <= len(before)
        assert after[1:] == before[1 : len(after)], "what was invented is not the run's"


def blob(payload: bytes) -> None:
    """A tile's bytes in the store, with a right digest and a wrong one."""
    store = Store(Path("map.db"))
    for digest in (payload[:16], *(xxhash.xxh3_128_digest(bytes(size)) for size in STATE_BYTES)):
        with contextlib.suppress(StoreError):
            assert store.unpack(0, 0, digest, payload[16:]).nbytes in STATE_BYTES


def store(payload: bytes) -> None:
    """A whole map.db."""
    found = Store(_file("map.db", payload))
    for read in (found.read_cut, lambda: read_index(found), lambda: list(found.read_tiles())):
        with contextlib.suppress(StoreError):
            read()


def stored(payload: bytes) -> None:
    """A map.db with any values in its rows: each line of the payload is one, of the kind that its first byte says."""
    path = _file("map.db", b"")
    kinds = {b"i": lambda v: int(v or b"0") % 2**63, b"b": bytes, b"f": float, b"n": lambda _: None}
    values: list[object] = []
    for line in payload.split(b"\n"):
        with contextlib.suppress(ValueError):
            values.append(kinds.get(line[:1], lambda v: v.decode(errors="replace"))(line[1:]))
    values += [None] * 8
    checksum = None
    with contextlib.suppress(ValueError, TypeError, OverflowError):
        checksum = tile_checksum(np.array(values[2:6], np.int64))
    with contextlib.closing(sqlite3.connect(path)) as db, db:
        db.execute("CREATE TABLE cut (name, value)")
        db.execute("CREATE TABLE tiles (tx, ty, oldest_ns, newest_ns, checksum, digest, state)")
        db.executemany("INSERT INTO cut VALUES (?, ?)", [tuple(values[:2]), ("state_version", values[2])])
        db.execute("INSERT INTO tiles VALUES (?, ?, ?, ?, ?, ?, ?)", (*values[2:6], checksum, *values[6:8]))
    store(path.read_bytes())


def clouds_npz(payload: bytes) -> None:
    _read_clouds(_file("cloud.npz", payload))


def clouds_text(payload: bytes) -> None:
    _read_clouds(_file("cloud.xyz", payload))


def clouds_ply(payload: bytes) -> None:
    _read_clouds(_file("cloud.ply", payload))


def clouds_pcd(payload: bytes) -> None:
    _read_clouds(_file("cloud.pcd", payload))


def clouds_las(payload: bytes) -> None:
    _read_clouds(_file("cloud.las", payload))


def _read_clouds(path: Path) -> None:
    with contextlib.suppress(CloudFileFault, OSError):
        for part in read_cloud(path):
            assert part.points.shape == (len(part.points), 3)
            if isinstance(part, PlacedPoints) and part.covariance is not None:
                assert part.covariance.shape in {(3, 3), (len(part.points), 3, 3)}
