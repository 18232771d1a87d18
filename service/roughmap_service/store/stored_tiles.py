"""The tiles of a map.db, taken from it when they are first needed."""

import sqlite3
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass

import numpy as np

from roughmap import RoughMap
from roughmap.arrays import I4, I8, U1, Records
from roughmap.tiles.shelf import copy_known_rows
from roughmap_service.store.map_db import READ_ERRORS, READ_INDEX, TILE_BYTES, Cut, Store, read_error

READ_TILE = "SELECT CASE WHEN length(records) <= ? THEN records END FROM tiles WHERE tx = ? AND ty = ?"

CHUNK = 1 << 14
"""Rows that are in memory as Python's objects at a time."""


@dataclass(frozen=True, eq=False)
class TileIndex:
    """Which tiles are stored: (T,) ``tx``, ``ty``, ``oldest_ns``, ``newest_ns``, and (T, 16) ``digest``."""

    tx: I4
    ty: I4
    oldest_ns: I8
    newest_ns: I8
    digest: U1


def read_index(store: Store) -> TileIndex:
    """The index of all tiles, without their records. StoreError if it can be none."""
    numbers, digests = [np.zeros((0, 4), np.int64)], [b""]
    with store.reading() as db:
        rows = db.execute(f"{READ_INDEX} FROM tiles ORDER BY tx, ty")
        while part := rows.fetchmany(CHUNK):
            numbers.append(store.checked([row[:4] for row in part], [row[4] for row in part]))
            try:
                digests.append(b"".join(row[5] for row in part))
            except TypeError as error:
                raise store.damaged(str(error)) from None
            if len(digests[-1]) != 16 * len(part):
                raise store.damaged("a digest is not of 16 bytes")
    table = np.concatenate(numbers)
    if len(table) and not (table[:, :2].min() >= -(1 << 31) and table[:, :2].max() < 1 << 31):
        raise store.damaged("a tile's number is not of 32 bits")
    tx, ty, oldest, newest = table.T
    digest = np.frombuffer(b"".join(digests), np.uint8).reshape(-1, 16)
    return TileIndex(tx.astype(np.int32), ty.astype(np.int32), oldest.copy(), newest.copy(), digest)


class StoredTiles:
    """Reads the records of tiles, by their number in the index; any thread may, and none waits for another.

    Each read has a connection to itself: there are as many as were ever needed at once, at most one a thread. One more
    is only kept open: SQLite has whoever closes the last one write back its log with all readers locked out, for as
    long as a slow disk takes, and that would be each snapshot.
    """

    def __init__(self, store: Store) -> None:
        self.index = read_index(store)
        self.store = store
        self._idle: deque[sqlite3.Connection] = deque()
        self._closed = False
        try:
            self._kept = store.open_reading(check_same_thread=False)
            self._kept.execute("SELECT count(*) FROM sqlite_master").fetchone()  # it holds the file from here on
        except READ_ERRORS as error:
            raise read_error(store.path, error) from None

    def read(self, number: int, records: Records) -> None:
        """Fill (4096,) zeroed records. StoreError names a tile that is damaged, or is no longer the indexed one;
        MemoryError if there is none for it now."""
        index = self.index
        tx, ty = int(index.tx[number]), int(index.ty[number])
        try:
            with self._connection() as db:
                row = db.execute(READ_TILE, (2 * TILE_BYTES, tx, ty)).fetchone()
        except MemoryError:
            raise  # the machine's: a length that is damaged was not asked for
        except READ_ERRORS as error:
            raise read_error(self.store.path, error) from None
        blob = None if row is None else row[0]
        copy_known_rows(self.store.unpacked(tx, ty, index.digest[number].tobytes(), blob), records)

    @contextmanager
    def _connection(self) -> Iterator[sqlite3.Connection]:
        """One that is idle, or another."""
        try:
            db = self._idle.pop()  # a deque's ends are safe from any thread
        except IndexError:
            db = self.store.open_reading(check_same_thread=False)
            db.execute("PRAGMA cache_size = -64")  # KiB: a tile is read once, and 2 MiB of its pages would stay
        try:
            yield db
        finally:
            self._idle.append(db)
            if self._closed:
                self.close()

    def close(self) -> None:
        """Let go of the file; of what is being read right now, when that is done."""
        self._closed = True
        self._kept.close()
        with suppress(IndexError):
            while True:
                self._idle.pop().close()


def set_index(rough_map: RoughMap, cut: Cut, stored: StoredTiles, places: I4) -> None:
    """Fill an empty map with the stored tiles, which lie in ``places`` of its shelf, at the cut's sequence."""
    index = stored.index
    rough_map.set_sequence(cut.sequence)
    try:
        rough_map.load_shelved(index.tx, index.ty, index.oldest_ns, index.newest_ns, index.digest, places)
    except ValueError as error:
        raise stored.store.damaged(str(error)) from None
