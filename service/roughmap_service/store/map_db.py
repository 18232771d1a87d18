"""The store, `map.db`: the map at one cut of the run, committed in one transaction."""

import json
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import xxhash
import zstandard

from roughmap import STATE_VERSION, RoughMap
from roughmap.arrays import I4, I8
from roughmap.reading.frozen import FrozenMap
from roughmap.tiles.columns import COLUMN_BYTES
from roughmap.tiles.digest import tile_digest
from roughmap.tiles.index import packed
from roughmap.tiles.slots import SLOT_BYTES
from roughmap.tiles.state import TileState
from roughmap_schemas.faults import ReportedError
from roughmap_service.host.disk import make_directory, sync_directory

STATE_BYTES = SLOT_BYTES, SLOT_BYTES + COLUMN_BYTES
"""Bytes of a tile's state, without a column and with one: its arrays, one after another."""

LARGEST_BLOB = 2 * max(STATE_BYTES)
"""No compressed state is longer."""

COMPRESSION_LEVEL = 1
"""Fast rather than small: snapshots are taken while the robot drives."""

SCHEMA = """
CREATE TABLE IF NOT EXISTS cut (name TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS tiles (
    tx INTEGER NOT NULL, ty INTEGER NOT NULL, oldest_ns INTEGER NOT NULL, newest_ns INTEGER NOT NULL,
    checksum BLOB NOT NULL, digest BLOB NOT NULL, state BLOB NOT NULL, PRIMARY KEY (tx, ty)
);
CREATE TABLE IF NOT EXISTS about (name TEXT PRIMARY KEY, value TEXT NOT NULL, checksum TEXT NOT NULL) WITHOUT ROWID;
"""
"""`about` holds what a run does not need and older stores lack: `crs`."""

REMEDY = "move the file away to rebuild the map from the log"

CHUNK_ROWS = 1 << 14
"""Rows that are in memory as Python objects at a time."""

READ_INDEX = "SELECT tx, ty, oldest_ns, newest_ns, checksum, digest"
"""Selects everything stored of a tile except its state."""


class StoreError(ReportedError):
    """A map.db that can't be used; one line with the file, the cause and the remedy."""

    exit_code = 2


class DamagedStore(StoreError):
    """A map.db whose bytes are not what was written."""


class OtherStateVersion(StoreError):
    """A store whose cells have another meaning. It is not converted but rebuilt from the log."""


@dataclass(frozen=True)
class Cut:
    """The place in the run where the stored map stands, and what the run needs beside the map to go on from there.

    ``input`` and ``record`` are the last ones before the cut. ``low_water`` is the input of the oldest undecided cloud,
    or the next input if there is none. ``poses`` (the robots), ``duplicates`` (the remembered messages), ``doubts`` and
    ``readings`` (of undecided clouds: how their points' times were read) and ``times`` (how the sensors' times are
    read) are JSON values. ``digest`` is the map's.
    """

    run: str
    epoch: int
    sequence: int
    input: int
    record: int
    low_water: int
    configuration: dict[str, Any]
    configuration_digest: str
    poses: dict[str, Any] = field(default_factory=dict)
    duplicates: list[Any] = field(default_factory=list)
    doubts: dict[str, Any] = field(default_factory=dict)
    times: list[Any] = field(default_factory=list)
    readings: dict[str, Any] = field(default_factory=dict)
    digest: str = ""
    state_version: int = STATE_VERSION


@dataclass(frozen=True, slots=True)
class StoredTile:
    """One tile as stored."""

    tx: int
    ty: int
    oldest_ns: int
    newest_ns: int
    digest: bytes
    state: TileState


class Store:
    """A `map.db`, read and written as a whole."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def exists(self) -> bool:
        """Return whether the file exists."""
        return self.path.exists()

    def read_cut(self) -> Cut | None:
        """Return the cut, None if nothing was stored yet; StoreError for another file or another version."""
        if not self.path.exists():
            return None
        with self.connection() as db:
            if not db.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
                return None  # a kill came after the file was created and before its tables were
            rows = db.execute("SELECT name, value FROM cut").fetchall()
        if not rows:
            return None
        if not all(isinstance(text, str) for row in rows for text in row):
            raise DamagedStore(f"{self.path}: damaged (its cut); {REMEDY}")
        texts: dict[str, str] = dict(rows)
        version, checksum = texts.get("state_version"), texts.pop("checksum", "")
        if version != str(STATE_VERSION):
            raise OtherStateVersion(f"{self.path}: the store has state version {version}, not {STATE_VERSION}")
        if checksum != _checksum(texts):
            raise DamagedStore(f"{self.path}: damaged (its cut); {REMEDY}")
        try:
            return Cut(**{name: json.loads(value) for name, value in texts.items()})
        except (TypeError, ValueError, RecursionError) as error:
            raise StoreError(f"{self.path}: the store is of another version ({error}); start with --fresh") from None

    def crs(self) -> str | None:
        """Return the coordinate reference system of x and y, WKT or EPSG:n; None if it is not known. StoreError."""
        if not self.path.exists():
            return None
        with self.connection() as db:
            if not db.execute("SELECT count(*) FROM sqlite_master WHERE name = 'about'").fetchone()[0]:
                return None  # a store from before there was this table
            row = db.execute("SELECT value, checksum FROM about WHERE name = 'crs'").fetchone()
        if row is None:
            return None
        if not isinstance(row[0], str) or row[1] != _checksum({"crs": row[0]}):
            raise self.damaged("its coordinate reference system")
        return row[0]

    def read_tiles(self) -> Iterator[StoredTile]:
        """Yield all tiles, each checked against its digest; StoreError names the first damaged one."""
        with self.connection() as db:
            for *numbers, checksum, digest, blob in db.execute(f"{READ_INDEX}, state FROM tiles ORDER BY tx, ty"):
                tx, ty, oldest, newest = self.verify_index([numbers], [checksum])[0].tolist()
                yield StoredTile(tx, ty, oldest, newest, digest, self.unpack(tx, ty, digest, blob))

    def verify_index(self, numbers: Sequence[Sequence[object]], checksums: Sequence[object]) -> I8:
        """Return the tiles' stored tx, ty, oldest and newest stamp as (T, 4), verified against their checksums.

        StoreError if they are damaged. The tiles' digests do not cover the stamps.
        """
        try:
            table = np.array(numbers, np.int64)
        except (ValueError, TypeError, OverflowError) as error:
            raise self.damaged(str(error)) from None
        for row, checksum in zip(table, checksums, strict=True):
            if tile_checksum(row) != checksum:
                raise self.damaged(f"the stamps of tile ({row[0]}, {row[1]})")
        return table

    def damaged(self, cause: str) -> DamagedStore:
        """Return the error for a store with impossible content."""
        return DamagedStore(f"{self.path}: damaged ({cause}); {REMEDY}")

    def unpack(self, tx: int, ty: int, digest: object, blob: object) -> TileState:
        """Return a tile's state; StoreError names the tile if it does not match its digest."""
        raw = b""
        with suppress(zstandard.ZstdError, TypeError):
            if zstandard.frame_content_size(blob) in STATE_BYTES:  # type: ignore[arg-type] # before it is allocated
                raw = zstandard.ZstdDecompressor().decompress(blob)  # type: ignore[arg-type]
        if len(raw) not in STATE_BYTES or xxhash.xxh3_128_digest(raw) != digest:
            raise DamagedStore(f"{self.path}: tile ({tx}, {ty}) is damaged; {REMEDY}")
        return TileState.of_bytes(raw)

    def load_into(self, rough_map: RoughMap, cut: Cut) -> None:
        """Fill an empty map with the stored tiles, and set the cut's sequence."""
        rough_map.set_sequence(cut.sequence)
        for tile in self.read_tiles():
            try:
                rough_map.load_tile(tile.tx, tile.ty, tile.state, tile.oldest_ns, tile.newest_ns, tile.digest)
            except ValueError as error:
                raise self.damaged(str(error)) from None

    def write(
        self,
        cut: Cut,
        frozen: FrozenMap,
        after: int | None,
        progress: Callable[[], None] = lambda: None,
        remaining: I4 | None = None,
        crs: str | None = None,
    ) -> None:
        """Commit a cut with the tiles of ``frozen`` that changed after the sequence ``after``.

        ``after`` None replaces all stored tiles by those of ``frozen``. ``remaining`` (T, 2): all tiles of the map, if
        it has forgotten some since; stored ones that are not among them are deleted. ``progress`` is called at each
        tile. ``crs`` None leaves the stored one. This is one transaction: if anything fails, the store stays as it was.
        sqlite3.Error or OSError from the disk.
        """
        pack = zstandard.ZstdCompressor(level=COMPRESSION_LEVEL, write_checksum=True)
        make_directory(self.path.parent)
        with closing(sqlite3.connect(self.path, isolation_level=None, timeout=5.0)) as db:
            db.execute("PRAGMA journal_mode = WAL")
            db.execute("PRAGMA synchronous = FULL")
            db.executescript(SCHEMA)
            db.execute("BEGIN IMMEDIATE")
            try:
                if after is None:
                    db.execute("DELETE FROM tiles")
                elif remaining is not None:
                    _delete_others(db, remaining)
                tiles = _rows(frozen, after, pack, progress)
                db.executemany("INSERT OR REPLACE INTO tiles VALUES (?, ?, ?, ?, ?, ?, ?)", tiles)
                db.execute("DELETE FROM cut")
                texts = {name: json.dumps(value, allow_nan=False) for name, value in asdict(cut).items()}
                db.executemany("INSERT INTO cut VALUES (?, ?)", [*texts.items(), ("checksum", _checksum(texts))])
                if crs is not None:
                    db.execute("INSERT OR REPLACE INTO about VALUES ('crs', ?, ?)", (crs, _checksum({"crs": crs})))
                db.execute("COMMIT")
            except BaseException:
                if db.in_transaction:  # some errors already ended it
                    db.execute("ROLLBACK")
                raise

    def write_map(
        self,
        rough_map: RoughMap,
        configuration: dict[str, Any],
        configuration_digest: str,
        run: str,
        crs: str | None = None,
    ) -> None:
        """Store a map that was made by `build` or `replay`, as the beginning of a run without a log.

        ``crs``: the coordinate reference system of its x and y, WKT or EPSG:n, if it is known.
        """
        digest = rough_map.digest()
        cut = Cut(run, 0, rough_map.sequence, 0, 0, 1, configuration, configuration_digest, digest=digest)
        with rough_map.freeze() as frozen:
            self.write(cut, frozen, None, crs=crs)

    def set_aside(self, run: str | None = None) -> Path:
        """Set the store aside as map.db.RUN, so that a new run can begin; return the new path.

        ``run`` None means the store's own run, or "empty" or "unknown". StoreError, and no change, for another file.
        """
        if run is None:
            run = self._run()
        with closing(sqlite3.connect(self.path, timeout=5.0)) as db:
            db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            db.execute("PRAGMA journal_mode = DELETE")
        aside = self.path.rename(self.path.with_name(f"{self.path.name}.{run}"))
        sync_directory(self.path.parent)
        return aside

    def set_aside_damaged(self) -> Path:
        """Set a damaged store aside, together with SQLite's files beside it; return the new path."""
        aside = self.path.with_name(f"{self.path.name}.damaged")
        for ending in ("-wal", "-shm", ""):
            path = self.path.with_name(self.path.name + ending)
            if path.exists():
                path.replace(aside.with_name(aside.name + ending))
        sync_directory(self.path.parent)
        return aside

    def _run(self) -> str:
        """Return the run of the store, whatever its version."""
        with self.connection() as db:
            if not db.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
                return "empty"
            row = db.execute("SELECT value FROM cut WHERE name = 'run'").fetchone()
        run = "" if row is None else str(row[0]).strip('"')
        return run if run.isalnum() else "unknown" if run else "empty"

    @contextmanager
    def connection(self) -> Iterator[sqlite3.Connection]:
        """Give a connection for reading; SQLite's errors become StoreError."""
        try:
            with closing(self.open_connection()) as db:
                yield db
        except READ_ERRORS as error:
            raise read_error(self.path, error) from None

    def open_connection(self, *, check_same_thread: bool = True) -> sqlite3.Connection:
        """Return a connection for reading, to be closed by the caller; sqlite3.Error."""
        uri = f"{self.path.absolute().as_uri()}?mode=rw"
        return sqlite3.connect(uri, uri=True, timeout=5.0, check_same_thread=check_same_thread)


READ_ERRORS = (sqlite3.Error, UnicodeDecodeError, MemoryError)
"""What SQLite raises when reading: the second if its message quotes damaged bytes, the third also over a damaged
length."""


def read_error(path: Path, error: Exception) -> StoreError:
    """Return the StoreError for one of `READ_ERRORS`; DamagedStore if SQLite calls the database malformed."""
    # "malformed" has no exception class of its own. A file that is not a database must not be set aside.
    kind = DamagedStore if type(error) is sqlite3.DatabaseError and "malformed" in str(error) else StoreError
    cause = str(error) or "no memory to read it"
    return kind(f"{path}: {cause}; not a map.db, or damaged: if the whole log is there, {REMEDY}")


def tile_checksum(numbers: I8) -> bytes:
    """Return the checksum of a tile's tx, ty, oldest_ns and newest_ns, (4,)."""
    return xxhash.xxh3_64_digest(numbers.tobytes())


def _checksum(texts: Mapping[str, str]) -> str:
    """Return the checksum of a cut's rows."""
    return xxhash.xxh3_128_hexdigest(json.dumps(sorted(texts.items())).encode())


def _delete_others(db: sqlite3.Connection, remaining: I4) -> None:
    """Delete all stored tiles but ``remaining`` (T, 2)."""
    kept = packed(remaining[:, 0], remaining[:, 1])
    gone: list[list[int]] = []
    rows = db.execute("SELECT tx, ty FROM tiles")
    while part := rows.fetchmany(CHUNK_ROWS):
        stored = np.array(part, np.int32)
        gone += stored[~np.isin(packed(stored[:, 0], stored[:, 1]), kept)].tolist()
    db.executemany("DELETE FROM tiles WHERE tx = ? AND ty = ?", gone)


def _rows(
    frozen: FrozenMap, after: int | None, pack: zstandard.ZstdCompressor, progress: Callable[[], None]
) -> Iterable[tuple[Any, ...]]:
    for (tx, ty), sequence in zip(frozen.tiles.tolist(), frozen.sequences.tolist(), strict=True):
        if after is not None and sequence <= after:
            continue
        progress()
        state = frozen.state(tx, ty)
        assert state is not None  # noqa: S101 - one of the frozen map's own tiles
        numbers = (tx, ty, *frozen.stamps(tx, ty))
        checksum = tile_checksum(np.array(numbers, np.int64))
        blob = pack.compress(b"".join(array.tobytes() for array in state.arrays))
        yield *numbers, checksum, tile_digest(state), blob
