"""The tiles of the store, read from it when they are first needed."""

import sqlite3
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass

import numpy as np

from roughmap import RoughMap
from roughmap.arrays import I4, I8, U1
from roughmap.tiles.shelf import copy_known_rows
from roughmap.tiles.state import TileState
from roughmap_service.store.map_db import CHUNK_ROWS, LARGEST_BLOB, READ_ERRORS, READ_INDEX, Cut, Store, read_error

READ_TILE = "SELECT CASE WHEN length(state) <= ? THEN state END FROM tiles WHERE tx = ? AND ty = ?"
"""Selects a tile's state, or NULL if it is longer than a bound: a damaged length must not become an allocation."""


@dataclass(frozen=True, eq=False)
class TileIndex:
    """The stored tiles without their cells: (T,) ``tx``, ``ty``, ``oldest_ns``, ``newest_ns``; (T, 16) ``digest``."""

    tx: I4
    ty: I4
    oldest_ns: I8
    newest_ns: I8
    digest: U1


def read_index(store: Store) -> TileIndex:
    """Return the index of all stored tiles; StoreError if it is damaged."""
    numbers, digests = [np.zeros((0, 4), np.int64)], [b""]
    with store.connection() as db:
        rows = db.execute(f"{READ_INDEX} FROM tiles ORDER BY tx, ty")
        while part := rows.fetchmany(CHUNK_ROWS):
            numbers.append(store.verify_index([row[:4] for row in part], [row[4] for row in part]))
            try:
                digests.append(b"".join(row[5] for row in part))
            except TypeError as error:
                raise store.damaged(str(error)) from None
            if len(digests[-1]) != 16 * len(part):
                raise store.damaged("a digest that does not have 16 bytes")
    table = np.concatenate(numbers)
    if len(table) and not (table[:, :2].min() >= -(1 << 31) and table[:, :2].max() < 1 << 31):
        raise store.damaged("a tile's number that does not fit 32 bits")
    tx, ty, oldest, newest = table.T
    digest = np.frombuffer(b"".join(digests), np.uint8).reshape(-1, 16)
    return TileIndex(tx.astype(np.int32), ty.astype(np.int32), oldest.copy(), newest.copy(), digest)


class StoredTiles:
    """Reads tiles by their number in the index, from any number of threads without waiting.

    Each read has a connection of its own; there are as many as were ever needed at once, at most one per thread. One
    more is kept open without use: SQLite writes back its log, with all readers locked out, when the last connection is
    closed, and without it each snapshot would do that for as long as a slow disk takes.
    """

    def __init__(self, store: Store) -> None:
        self.index = read_index(store)
        self.store = store
        self._idle: deque[sqlite3.Connection] = deque()
        self._closed = False
        try:
            self._kept = store.open_connection(check_same_thread=False)
            self._kept.execute("SELECT count(*) FROM sqlite_master").fetchone()  # opens the file
        except READ_ERRORS as error:
            raise read_error(store.path, error) from None

    def read(self, number: int, room: TileState) -> bool:
        """Read the tile ``number`` into zeroed arrays; return whether it has a column.

        StoreError names a tile that is damaged or no longer the indexed one. MemoryError if memory is short.
        """
        index = self.index
        tx, ty = int(index.tx[number]), int(index.ty[number])
        try:
            with self._connection() as db:
                row = db.execute(READ_TILE, (LARGEST_BLOB, tx, ty)).fetchone()
        except MemoryError:
            raise  # memory is short: `READ_TILE` does not ask for a damaged length
        except READ_ERRORS as error:
            raise read_error(self.store.path, error) from None
        blob = None if row is None else row[0]
        state = self.store.unpack(tx, ty, index.digest[number].tobytes(), blob)
        copy_known_rows(state, room)
        return state.column is not None

    @contextmanager
    def _connection(self) -> Iterator[sqlite3.Connection]:
        """Give an idle connection or a new one."""
        try:
            db = self._idle.pop()  # a deque is safe to pop from any thread
        except IndexError:
            db = self.store.open_connection(check_same_thread=False)
            db.execute("PRAGMA cache_size = -64")  # KiB; a tile is read once, and the default would keep 2 MiB of pages
        try:
            yield db
        finally:
            self._idle.append(db)
            if self._closed:
                self.close()

    def close(self) -> None:
        """Close all connections; one that is in use is closed after its read."""
        self._closed = True
        self._kept.close()
        with suppress(IndexError):
            while True:
                self._idle.pop().close()


def set_index(rough_map: RoughMap, cut: Cut, stored: StoredTiles, places: I4) -> None:
    """Fill an empty map with the stored tiles, at ``places`` of its shelf, and set the cut's sequence."""
    index = stored.index
    rough_map.set_sequence(cut.sequence)
    try:
        rough_map.load_shelved(index.tx, index.ty, index.oldest_ns, index.newest_ns, index.digest, places)
    except ValueError as error:
        raise stored.store.damaged(str(error)) from None
