"""The map on disk, `map.db`: one cut of the run, committed in one transaction."""

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

from roughmap import CELL_DTYPE, STATE_VERSION, RoughMap
from roughmap.arrays import I8, Records
from roughmap.reading.frozen import FrozenMap
from roughmap_schemas.faults import ReportedError
from roughmap_service.host.disk import make_directory, sync_directory

TILE_BYTES = 64 * 64 * CELL_DTYPE.itemsize

COMPRESSION_LEVEL = 1
"""Snapshots are taken while the robot drives: fast counts for more than small."""

SCHEMA = """
CREATE TABLE IF NOT EXISTS cut (name TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS tiles (
    tx INTEGER NOT NULL, ty INTEGER NOT NULL, oldest_ns INTEGER NOT NULL, newest_ns INTEGER NOT NULL,
    checksum BLOB NOT NULL, digest BLOB NOT NULL, records BLOB NOT NULL, PRIMARY KEY (tx, ty)
);
"""


READ_INDEX = "SELECT tx, ty, oldest_ns, newest_ns, checksum, digest"
"""What is stored of a tile beside its records."""


class StoreError(ReportedError):
    """A map.db that can't be used; one line that names the file, what is wrong and what to do."""

    exit_code = 2


class DamagedStore(StoreError):
    """A map.db whose bytes are not what was written."""


class OtherStateVersion(StoreError):
    """A store whose cells mean something else: it is never converted, but built anew from the log."""


@dataclass(frozen=True)
class Cut:
    """Where in the run the stored map stands, and what beside the map the run needs to go on from there.

    ``input`` and ``record`` are the last ones before the cut; ``low_water`` is the oldest undecided cloud's input, else
    the next input. ``poses`` are the robots' pose buffers, ``duplicates`` the remembered messages, as JSON values;
    ``digest`` is the map's.
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
    digest: str = ""
    state_version: int = STATE_VERSION


@dataclass(frozen=True, slots=True)
class StoredTile:
    """One tile as stored; ``records`` (4096,) CELL_DTYPE."""

    tx: int
    ty: int
    oldest_ns: int
    newest_ns: int
    digest: bytes
    records: Records


class Store:
    """A `map.db` for reading and for writing whole cuts."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def exists(self) -> bool:
        """Whether there is such a file."""
        return self.path.exists()

    def read_cut(self) -> Cut | None:
        """The cut, or None if nothing was stored yet. StoreError if the file is no store, or one of another version."""
        if not self.path.exists():
            return None
        with self.reading() as db:
            if not db.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
                return None  # a kill came between the making of the file and of its tables
            rows = db.execute("SELECT name, value FROM cut").fetchall()
        if not rows:
            return None
        if not all(isinstance(text, str) for row in rows for text in row):
            raise DamagedStore(f"{self.path}: damaged (its cut); move it away to build it anew from the log")
        texts: dict[str, str] = dict(rows)
        version, checksum = texts.get("state_version"), texts.pop("checksum", "")
        if version != str(STATE_VERSION):
            raise OtherStateVersion(f"{self.path}: a store of state version {version}, not {STATE_VERSION}")
        if checksum != _checksum(texts):
            raise DamagedStore(f"{self.path}: damaged (its cut); move it away to build it anew from the log")
        try:
            return Cut(**{name: json.loads(value) for name, value in texts.items()})
        except (TypeError, ValueError, RecursionError) as error:
            raise StoreError(f"{self.path}: a store of another version ({error}); start with --fresh") from None

    def read_tiles(self) -> Iterator[StoredTile]:
        """All tiles, each checked against its digest. StoreError names the first that is damaged."""
        with self.reading() as db:
            for *numbers, checksum, digest, blob in db.execute(f"{READ_INDEX}, records FROM tiles ORDER BY tx, ty"):
                tx, ty, oldest, newest = self.checked([numbers], [checksum])[0].tolist()
                records = self.unpacked(tx, ty, digest, blob)
                yield StoredTile(tx, ty, oldest, newest, digest, records)

    def checked(self, numbers: Sequence[Sequence[object]], checksums: Sequence[object]) -> I8:
        """(T, 4) of the tiles' tx, ty, oldest and newest stamp as stored. StoreError if they are not what was written:
        no digest covers the stamps."""
        try:
            table = np.array(numbers, np.int64)
        except (ValueError, TypeError, OverflowError) as error:
            raise self.damaged(str(error)) from None
        for row, checksum in zip(table, checksums, strict=True):
            if tile_checksum(row) != checksum:
                raise self.damaged(f"the stamps of tile ({row[0]}, {row[1]})")
        return table

    def damaged(self, why: str) -> DamagedStore:
        """The error of a store whose content can't be."""
        return DamagedStore(f"{self.path}: damaged ({why}); move the file away to rebuild it")

    def unpacked(self, tx: int, ty: int, digest: object, blob: object) -> Records:
        """A tile's (4096,) records from what is stored of it. StoreError that names it if the digest is another."""
        raw = b""
        with suppress(zstandard.ZstdError, TypeError):
            if zstandard.frame_content_size(blob) == TILE_BYTES:  # type: ignore[arg-type] # before it is allocated
                raw = zstandard.ZstdDecompressor().decompress(blob)  # type: ignore[arg-type]
        if len(raw) != TILE_BYTES or xxhash.xxh3_128_digest(raw) != digest:
            raise DamagedStore(f"{self.path}: tile ({tx}, {ty}) is damaged; move the file away to rebuild it")
        return np.frombuffer(raw, CELL_DTYPE)

    def load_into(self, rough_map: RoughMap, cut: Cut) -> None:
        """Fill an empty map with the stored tiles, at the cut's sequence."""
        rough_map.set_sequence(cut.sequence)
        for tile in self.read_tiles():
            try:
                rough_map.load_tile(tile.tx, tile.ty, tile.records, tile.oldest_ns, tile.newest_ns, tile.digest)
            except ValueError as error:
                raise self.damaged(str(error)) from None

    def write(self, cut: Cut, frozen: FrozenMap, after: int | None, went_on: Callable[[], None] = lambda: None) -> None:
        """Commit a cut: the tiles of ``frozen`` that changed after sequence ``after`` (None: all, and no others).
        ``went_on`` is called at each tile.

        One transaction; what was there stays if anything fails. sqlite3.Error or OSError from the disk.
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
                tiles = _rows(frozen, after, pack, went_on)
                db.executemany("INSERT OR REPLACE INTO tiles VALUES (?, ?, ?, ?, ?, ?, ?)", tiles)
                db.execute("DELETE FROM cut")
                texts = {name: json.dumps(value, allow_nan=False) for name, value in asdict(cut).items()}
                db.executemany("INSERT INTO cut VALUES (?, ?)", [*texts.items(), ("checksum", _checksum(texts))])
                db.execute("COMMIT")
            except BaseException:
                if db.in_transaction:  # some errors end it themselves
                    db.execute("ROLLBACK")
                raise

    def write_map(
        self, rough_map: RoughMap, configuration: dict[str, Any], configuration_digest: str, run: str
    ) -> None:
        """Store a map that no service keeps, as `build` and `replay` make them: a run's beginning, without a log."""
        digest = rough_map.digest()
        cut = Cut(run, 0, rough_map.sequence, 0, 0, 1, configuration, configuration_digest, digest=digest)
        with rough_map.freeze() as frozen:
            self.write(cut, frozen, None)

    def set_aside(self, run: str | None = None) -> Path:
        """Rename the store to map.db.RUN, so that a new run may begin; returns the new name.

        ``run`` None: the one that it is of, "empty" or "unknown". StoreError, and nothing renamed, for what is none.
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
        """Rename a store that can't be used as one, with what SQLite keeps beside it; returns the new name."""
        aside = self.path.with_name(f"{self.path.name}.damaged")
        for ending in ("-wal", "-shm", ""):
            path = self.path.with_name(self.path.name + ending)
            if path.exists():
                path.replace(aside.with_name(aside.name + ending))
        sync_directory(self.path.parent)
        return aside

    def _run(self) -> str:
        """The run that the store is of, whatever its version."""
        with self.reading() as db:
            if not db.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
                return "empty"
            row = db.execute("SELECT value FROM cut WHERE name = 'run'").fetchone()
        run = "" if row is None else str(row[0]).strip('"')
        return run if run.isalnum() else "unknown" if run else "empty"

    @contextmanager
    def reading(self) -> Iterator[sqlite3.Connection]:
        """A connection that only reads; what goes wrong is a StoreError."""
        try:
            with closing(self.open_reading()) as db:
                yield db
        except READ_ERRORS as error:
            raise read_error(self.path, error) from None

    def open_reading(self, *, check_same_thread: bool = True) -> sqlite3.Connection:
        """The connection itself, to be closed by the caller. sqlite3.Error."""
        uri = f"{self.path.absolute().as_uri()}?mode=rw"
        return sqlite3.connect(uri, uri=True, timeout=5.0, check_same_thread=check_same_thread)


READ_ERRORS = (sqlite3.Error, UnicodeDecodeError, MemoryError)
"""What SQLite raises over a store: the second where its message quotes damaged bytes, the third also for a length that
is damaged."""


def read_error(path: Path, error: Exception) -> StoreError:
    """What an error of `READ_ERRORS` is: that the store is damaged, or that it can't be read, or is none."""
    # "malformed" has no class of its own; what is no database at all is not ours to put away.
    kind = DamagedStore if type(error) is sqlite3.DatabaseError and "malformed" in str(error) else StoreError
    mend = "where the whole log is there, move it away, and the map is built from that"
    return kind(f"{path}: {str(error) or 'no memory to read it'}; it is no map.db, or damaged: {mend}")


def tile_checksum(numbers: I8) -> bytes:
    """Over a tile's tx, ty, oldest_ns and newest_ns, (4,)."""
    return xxhash.xxh3_64_digest(numbers.tobytes())


def _checksum(texts: Mapping[str, str]) -> str:
    """Over the rows of a cut."""
    return xxhash.xxh3_128_hexdigest(json.dumps(sorted(texts.items())).encode())


def _rows(
    frozen: FrozenMap, after: int | None, pack: zstandard.ZstdCompressor, went_on: Callable[[], None]
) -> Iterable[tuple[Any, ...]]:
    for (tx, ty), sequence in zip(frozen.tiles.tolist(), frozen.sequences.tolist(), strict=True):
        if after is not None and sequence <= after:
            continue
        went_on()
        raw = frozen.records(tx, ty).tobytes()
        numbers = (tx, ty, *frozen.stamps(tx, ty))
        checksum = tile_checksum(np.array(numbers, np.int64))
        yield *numbers, checksum, bytes.fromhex(frozen.digest(tx, ty)), pack.compress(raw)
