"""Loading of stored tiles into a table: checks, and entries at the map's current sequence."""

import numpy as np

from roughmap.arrays import I4, I8, U1
from roughmap.cell import BASED, CELL_DTYPE, COLUMN_DTYPE, STAMP_LIMIT_NS, TILE_CELLS, TRUST_DTYPE
from roughmap.points.checks import checked_stamp
from roughmap.tiles.index import TILE_LIMIT, packed
from roughmap.tiles.shelf import copy_known_rows
from roughmap.tiles.state import TileState
from roughmap.tiles.table import TileTable


def load_tile(
    table: TileTable,
    sequence: int,
    tx: int,
    ty: int,
    state: TileState,
    oldest_ns: int,
    newest_ns: int,
    digest: bytes | None,
) -> None:
    """Load one tile; see `RoughMap.load_tile`."""
    if not (-TILE_LIMIT <= tx < TILE_LIMIT and -TILE_LIMIT <= ty < TILE_LIMIT):
        raise ValueError(f"tile ({tx}, {ty}): expected numbers in [{-TILE_LIMIT}, {TILE_LIMIT})")
    for array, dtype in zip(state.arrays, (CELL_DTYPE, TRUST_DTYPE, COLUMN_DTYPE), strict=False):
        if array.shape != (TILE_CELLS * TILE_CELLS,) or array.dtype != dtype:
            raise ValueError(f"tile ({tx}, {ty}): expected (4096,) of CELL_DTYPE, TRUST_DTYPE and COLUMN_DTYPE")
    if digest is not None and len(digest) != 16:
        raise ValueError(f"tile ({tx}, {ty}): expected a digest of 16 bytes, got {len(digest)}")
    stamps = checked_stamp(oldest_ns, "oldest_ns"), checked_stamp(newest_ns, "newest_ns")
    known = state.cells["count"] != 0
    if not known.any():
        raise ValueError(f"tile ({tx}, {ty}): expected a known cell")
    if state.column is not None:
        based = state.column["flags"] & BASED != 0
        if not based.any() or (based & ~known).any():
            raise ValueError(f"tile ({tx}, {ty}): expected a column with a based cell, and no such cell unknown")
    if table.levels[0].find(tx, ty) >= 0:
        raise ValueError(f"tile ({tx}, {ty}): already in the map")
    columns = state.column is not None
    entries = table.insert(np.array([tx], np.int32), np.array([ty], np.int32), columns=columns)
    entry = int(entries[0])
    copy_known_rows(state, table.pool.writable(int(table.slot[entry])))
    table.used[entry] = sequence
    table.oldest_ns[entry], table.newest_ns[entry] = stamps
    for z, level in enumerate(table.levels):
        level.sequence[level.find(tx >> z, ty >> z)] = sequence
    if digest is not None:
        table.digests.set(entries, np.frombuffer(digest, np.uint8)[None])


def load_shelved(
    table: TileTable, sequence: int, tx: I4, ty: I4, oldest_ns: I8, newest_ns: I8, digests: U1, places: I4
) -> None:
    """Load many tiles that lie on the shelf; see `RoughMap.load_shelved`."""
    number = len(tx)
    if table.size:
        raise ValueError(f"expected an empty map, found {table.size} tiles")
    if number == 0:
        return
    lowest, highest = min(int(tx.min()), int(ty.min())), max(int(tx.max()), int(ty.max()))
    if lowest < -TILE_LIMIT or highest >= TILE_LIMIT:
        raise ValueError(f"expected tile numbers in [{-TILE_LIMIT}, {TILE_LIMIT}), found {lowest} to {highest}")
    if len(np.unique(packed(tx, ty))) < number:
        raise ValueError("expected different tiles, found one twice")
    if not (int(oldest_ns.min()) >= 0 and bool((oldest_ns <= newest_ns).all()) and newest_ns.max() < STAMP_LIMIT_NS):
        raise ValueError("expected stamps in [0, 2^32 s), the oldest not after the newest")
    entries = table.insert(tx, ty, ~places)
    table.used[entries] = sequence
    table.oldest_ns[entries], table.newest_ns[entries] = oldest_ns, newest_ns
    table.digests.set(entries, digests)
    for level in table.levels:
        level.sequence[: level.size] = sequence
