"""Index of the tiles of a level: a hash from tile numbers to entries, in arrays for the kernels."""

from typing import TypeVar

import numpy as np
import numpy.typing as npt

from roughmap.arrays import I4, I8, U8, Flags, Scalar
from roughmap.cell import TILE_SHIFT
from roughmap.jit import inline, kernel

T = TypeVar("T", bound=np.generic)

TileBox = tuple[int, int, int, int]
"""Tile numbers x0, y0, x1, y1, inclusive."""

TILE_LIMIT = 1 << (31 - TILE_SHIFT)
"""Tile numbers lie in [-TILE_LIMIT, TILE_LIMIT), so that cell numbers fit 32 bits."""


@inline
def tile_key(tx: Scalar, ty: Scalar) -> Scalar:
    """Pack both tile numbers into one word."""
    return (np.uint64(np.uint32(tx)) << np.uint64(32)) | np.uint64(np.uint32(ty))


@inline
def probe(table: I4, key: Scalar) -> Scalar:
    """Return where the search for ``key`` begins in ``table``, whose length is a power of two."""
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    return np.int64((mixed >> np.uint64(32)) & np.uint64(len(table) - 1))


@inline
def find(table: I4, keys: U8, key: Scalar) -> Scalar:
    """Return the entry of ``key``, or -1. Linear probing; the table is never more than half full."""
    place = probe(table, key)
    while True:
        entry = table[place]
        if entry < 0 or keys[entry] == key:
            return np.int64(entry)
        place = (place + 1) & (len(table) - 1)


@inline
def insert_key(table: I4, key: Scalar, entry: Scalar) -> None:
    """Insert ``entry`` under ``key``, which must not be in the table yet."""
    place = probe(table, key)
    while table[place] >= 0:
        place = (place + 1) & (len(table) - 1)
    table[place] = entry


@inline
def find_or_add(table: I4, keys: U8, work: I8, key: Scalar, number: Scalar) -> Scalar:
    """Return the row of ``key`` and the number of rows, after adding a row with ``work`` 0 if there was none."""
    row = find(table, keys, key)
    if row < 0:
        row = number
        keys[number] = key
        work[number] = 0
        insert_key(table, key, number)
        number += 1
    return row, number


@kernel
def rehash(table: I4, keys: U8, size: int) -> None:
    """Rebuild the table from the first ``size`` keys."""
    table[:] = -1
    for entry in range(size):
        insert_key(table, keys[entry], entry)


@kernel
def _insert_tiles(
    table: I4,
    keys: U8,
    tx: I4,
    ty: I4,
    size: int,
    new_x: I4,
    new_y: I4,
    shift: int,
) -> int:
    """Insert the ancestors ``shift`` levels up that are missing; return the new number of entries."""
    for n in range(len(new_x)):
        x = np.int32(new_x[n] >> shift)
        y = np.int32(new_y[n] >> shift)
        key = tile_key(x, y)
        if find(table, keys, key) < 0:
            keys[size] = key
            tx[size] = x
            ty[size] = y
            insert_key(table, key, size)
            size += 1
    return size


@kernel
def _find_each(table: I4, keys: U8, tx: I4, ty: I4, entries: I4) -> None:
    for n in range(len(tx)):
        entries[n] = find(table, keys, tile_key(tx[n], ty[n]))


@kernel
def _mark_parents(table: I4, keys: U8, tx: I4, ty: I4, flags: Flags) -> None:
    """Set the flags of the entries one level above the tiles (T,)."""
    for n in range(len(tx)):
        flags[find(table, keys, tile_key(np.int32(tx[n] >> 1), np.int32(ty[n] >> 1)))] = True


@kernel
def _find_box(
    table: I4,
    keys: U8,
    x0: int,
    y0: int,
    x1: int,
    y1: int,
    out: I4,
) -> int:
    """Write the entries of a box to ``out``, ascending by (x, y); return their number."""
    number = 0
    for x in range(x0, x1 + 1):
        for y in range(y0, y1 + 1):
            entry = find(table, keys, tile_key(x, y))
            if entry >= 0:
                out[number] = entry
                number += 1
    return number


def grown(array: npt.NDArray[T], size: int) -> npt.NDArray[T]:
    """Return a copy of ``array`` with ``size`` rows, the new ones zero."""
    larger = np.zeros((size, *array.shape[1:]), array.dtype)
    larger[: len(array)] = array
    return larger


def kept_rows(array: npt.NDArray[T], kept: I4) -> npt.NDArray[T]:
    """Return a copy of ``array``, as long as it, with the rows ``kept`` first and zeros after them."""
    fewer = np.zeros_like(array)
    fewer[: len(kept)] = array[kept]
    return fewer


def paired(tx: I4, ty: I4) -> I4:
    """Return (T, 2) from two (T,); half the time of numpy's column_stack for few tiles."""
    tiles = np.empty((len(tx), 2), np.int32)
    tiles[:, 0], tiles[:, 1] = tx, ty
    return tiles


def packed(tx: I4, ty: I4) -> I8:
    """Return one number for each of (T,) tiles, which ascends as (tx, ty) does."""
    return (tx.astype(np.int64) << 32) + ty


def ascending(known: I4, tx: I4, ty: I4) -> I4:
    """Return the entries of (T,) different tiles, ascending by signed (tx, ty), read-only.

    ``known``: the first len(known) entries in that order, from an earlier call.
    """
    if len(known) == len(tx):
        return known
    order = np.concatenate([known, np.arange(len(known), len(tx), dtype=np.int32)])
    keys = packed(tx[order], ty[order])
    order = order[np.argsort(keys, kind="stable")]  # this kind merges runs that are already in order
    order.flags.writeable = False
    return order


class LevelIndex:
    """The existing tiles of one level, each with its sequence. Entries are never removed; see :meth:`only`."""

    def __init__(self) -> None:
        self.size = 0
        self.table = np.full(64, -1, np.int32)
        self.keys = np.zeros(32, np.uint64)
        self.tx = np.zeros(32, np.int32)
        self.ty = np.zeros(32, np.int32)
        self.sequence = np.zeros(32, np.int64)
        self._order = np.zeros(0, np.int32)  # the first entries, ascending; extended when it is asked for

    @property
    def capacity(self) -> int:
        """Number of entries that fit: half the length of the hash table."""
        return len(self.keys)

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays, including the order of the entries, even if it has not been computed yet."""
        arrays = (self.table, self.keys, self.tx, self.ty, self.sequence)
        return sum(a.nbytes for a in arrays) + self.size * self._order.itemsize

    def reserve(self, more: int) -> None:
        """Make room for ``more`` entries."""
        capacity = self.capacity
        while capacity < self.size + more:
            capacity *= 2
        if capacity == self.capacity:
            return
        table = np.empty(2 * capacity, np.int32)
        keys = grown(self.keys, capacity)
        tx, ty, sequence = grown(self.tx, capacity), grown(self.ty, capacity), grown(self.sequence, capacity)
        rehash(table, keys, self.size)
        self.table, self.keys, self.tx, self.ty, self.sequence = table, keys, tx, ty, sequence

    def insert(self, new_x: I4, new_y: I4, shift: int = 0) -> None:
        """Insert the tiles ``(new_x >> shift, new_y >> shift)`` that are missing, in this order."""
        self.reserve(len(new_x))
        self.size = _insert_tiles(self.table, self.keys, self.tx, self.ty, self.size, new_x, new_y, shift)

    def only(self, kept: I4) -> "LevelIndex":
        """Return an index of the entries ``kept``, ascending, alone, which are numbered anew.

        It has a hash of its own: with linear probing, entries can't be removed one by one without moving others.
        """
        index = LevelIndex()
        index.size = len(kept)
        index.keys, index.sequence = kept_rows(self.keys, kept), kept_rows(self.sequence, kept)
        index.tx, index.ty = kept_rows(self.tx, kept), kept_rows(self.ty, kept)
        index.table = np.empty_like(self.table)
        rehash(index.table, index.keys, index.size)
        number = np.full(self.size, -1, np.int32)
        number[kept] = np.arange(len(kept), dtype=np.int32)
        order = number[self._order]
        index._order = order[order >= 0]
        index._order.flags.writeable = False
        return index

    def with_children(self, below: "LevelIndex") -> I4:
        """Return the entries that have a child among the tiles ``below``, one level down, ascending."""
        flags = np.zeros(self.size, np.bool_)
        _mark_parents(self.table, self.keys, below.tx[: below.size], below.ty[: below.size], flags)
        return np.flatnonzero(flags).astype(np.int32)

    def find(self, tx: int, ty: int) -> int:
        """Return the entry of a tile, or -1."""
        number, entries = self._probe_box((tx, ty, tx, ty))
        return int(entries[0]) if number else -1

    def find_each(self, tx: I4, ty: I4) -> I4:
        """Return the entries of (T,) tiles, -1 for those that are not there."""
        entries = np.empty(len(tx), np.int32)
        _find_each(self.table, self.keys, np.ascontiguousarray(tx), np.ascontiguousarray(ty), entries)
        return entries

    def find_present(self, tiles: npt.ArrayLike) -> I4:
        """Return the entries of those of (T, 2) tile numbers that are there, each once, ascending.

        ValueError for anything but (T, 2) integers.
        """
        wanted = np.asarray(tiles)
        if wanted.size == 0:
            return np.zeros(0, np.int32)
        if wanted.ndim != 2 or wanted.shape[1] != 2 or wanted.dtype.kind not in "iu":
            raise ValueError(f"tiles: expected (T, 2) integers, got {wanted.dtype} of shape {wanted.shape}")
        wanted = wanted[((wanted >= -TILE_LIMIT) & (wanted < TILE_LIMIT)).all(axis=1)].astype(np.int32)
        entries: I4 = np.unique(self.find_each(wanted[:, 0], wanted[:, 1]))
        return entries[entries >= 0]

    def _probe_box(self, box: TileBox) -> tuple[int, I4]:
        x0, y0, x1, y1 = box
        out = np.empty((x1 - x0 + 1) * (y1 - y0 + 1), np.int32)
        return _find_box(self.table, self.keys, x0, y0, x1, y1, out), out

    def entries(self, box: TileBox | None = None) -> I4:
        """Return the entries of the tiles in ``box`` (None: all), ascending by signed (tx, ty); read-only."""
        tx, ty = self.tx[: self.size], self.ty[: self.size]
        if box is None:
            self._order = ascending(self._order, tx, ty)
            return self._order
        x0, y0, x1, y1 = box
        if x1 < x0 or y1 < y0:
            return np.zeros(0, np.int32)
        # A small box is probed tile by tile; for a large one, a scan of all entries is cheaper.
        if (x1 - x0 + 1) * (y1 - y0 + 1) <= max(64, self.size) and min(x0, y0) >= -(1 << 31) and max(x1, y1) < 1 << 31:
            number, out = self._probe_box(box)
            return out[:number]
        chosen = np.flatnonzero((tx >= x0) & (tx <= x1) & (ty >= y0) & (ty <= y1)).astype(np.int32)
        return chosen[np.lexsort((ty[chosen], tx[chosen]))]

    def changed(self, after: int) -> I4:
        """Return the entries of the tiles whose sequence is larger than ``after``, ascending by signed (tx, ty)."""
        chosen = np.flatnonzero(self.sequence[: self.size] > after).astype(np.int32)
        return chosen[np.lexsort((self.ty[chosen], self.tx[chosen]))]

    def versions(self) -> "TileVersions":
        """Return the tiles as they are now, to be read while the index changes."""
        return TileVersions(self.tx[: self.size], self.ty[: self.size], self.sequence[: self.size].copy(), self._order)

    def select(self, box: TileBox | None = None) -> tuple[I4, I4, I8]:
        """Return copies of (tx, ty, sequence) of the tiles in ``box`` (None: all), ascending by (tx, ty)."""
        chosen = self.entries(box)
        return self.tx[chosen], self.ty[chosen], self.sequence[chosen]


class TileVersions:
    """The tiles of a level and their sequences at one moment; later changes of the map do not show."""

    def __init__(self, tx: I4, ty: I4, sequence: I8, order: I4) -> None:
        self._tx, self._ty, self._sequence = tx, ty, sequence  # existing entries never move: no copy needed
        self._order = order

    def select(self, box: TileBox | None = None) -> tuple[I4, I8]:
        """Return the (T, 2) tiles in ``box`` (None: all), ascending by (x, y), and their (T,) sequences."""
        tx, ty = self._tx, self._ty
        if box is None:
            chosen = self._order = ascending(self._order, tx, ty)
        else:
            x0, y0, x1, y1 = box
            chosen = np.flatnonzero((tx >= x0) & (tx <= x1) & (ty >= y0) & (ty <= y1)).astype(np.int32)
            chosen = chosen[np.lexsort((ty[chosen], tx[chosen]))]
        return paired(tx[chosen], ty[chosen]), self._sequence[chosen]
