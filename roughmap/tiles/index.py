"""Which tiles there are: a hash from tile numbers to entries, in arrays that kernels can use."""

from typing import TypeVar

import numpy as np
import numpy.typing as npt

from roughmap.arrays import I4, I8, U8, Scalar
from roughmap.cell import TILE_SHIFT
from roughmap.jit import inline, kernel

T = TypeVar("T", bound=np.generic)

TileBox = tuple[int, int, int, int]
"""Inclusive tile numbers x0, y0, x1, y1."""

TILE_LIMIT = 1 << (31 - TILE_SHIFT)
"""Tile numbers lie in [-TILE_LIMIT, TILE_LIMIT): those of cells whose numbers fit 32 bits."""


@inline
def tile_key(tx: Scalar, ty: Scalar) -> Scalar:
    """Both tile numbers in one word."""
    return (np.uint64(np.uint32(tx)) << np.uint64(32)) | np.uint64(np.uint32(ty))


@inline
def probe(table: I4, key: Scalar) -> Scalar:
    """Where in ``table`` (a power of two long) the search for ``key`` begins."""
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    return np.int64((mixed >> np.uint64(32)) & np.uint64(len(table) - 1))


@inline
def find(table: I4, keys: U8, key: Scalar) -> Scalar:
    """Entry of ``key``, or -1. Linear probing; the table is never more than half full."""
    place = probe(table, key)
    while True:
        entry = table[place]
        if entry < 0 or keys[entry] == key:
            return np.int64(entry)
        place = (place + 1) & (len(table) - 1)


@inline
def place_key(table: I4, key: Scalar, entry: Scalar) -> None:
    """Write ``entry`` under ``key``, which is not in the table yet."""
    place = probe(table, key)
    while table[place] >= 0:
        place = (place + 1) & (len(table) - 1)
    table[place] = entry


@inline
def row_of(table: I4, keys: U8, work: I8, key: Scalar, number: Scalar) -> Scalar:
    """The row of ``key`` among ``number``, a new one without work if it is not there; and how many there are then."""
    row = find(table, keys, key)
    if row < 0:
        row = number
        keys[number] = key
        work[number] = 0
        place_key(table, key, number)
        number += 1
    return row, number


@kernel
def rehash(table: I4, keys: U8, size: int) -> None:
    """Fill an emptied table with the first ``size`` keys."""
    table[:] = -1
    for entry in range(size):
        place_key(table, keys[entry], entry)


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
    """Insert the ancestors ``shift`` levels up that are not there yet; the new number of entries."""
    for n in range(len(new_x)):
        x = np.int32(new_x[n] >> shift)
        y = np.int32(new_y[n] >> shift)
        key = tile_key(x, y)
        if find(table, keys, key) < 0:
            keys[size] = key
            tx[size] = x
            ty[size] = y
            place_key(table, key, size)
            size += 1
    return size


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
    """Entries of a box, ascending by (x, y); their number."""
    number = 0
    for x in range(x0, x1 + 1):
        for y in range(y0, y1 + 1):
            entry = find(table, keys, tile_key(x, y))
            if entry >= 0:
                out[number] = entry
                number += 1
    return number


def grown(array: npt.NDArray[T], size: int) -> npt.NDArray[T]:
    """A copy of ``array`` with ``size`` rows, the new ones zero."""
    larger = np.zeros((size, *array.shape[1:]), array.dtype)
    larger[: len(array)] = array
    return larger


def paired(tx: I4, ty: I4) -> I4:
    """(T, 2) of two (T,): half the time of numpy's column_stack where there are few."""
    tiles = np.empty((len(tx), 2), np.int32)
    tiles[:, 0], tiles[:, 1] = tx, ty
    return tiles


def ascending(known: I4, tx: I4, ty: I4) -> I4:
    """The entries of (T,) different tiles, ascending by signed (tx, ty), read-only; ``known``: the first of them so."""
    if len(known) == len(tx):
        return known
    order = np.concatenate([known, np.arange(len(known), len(tx), dtype=np.int32)])
    packed = (tx[order].astype(np.int64) << 32) + ty[order]
    order = order[np.argsort(packed, kind="stable")]  # this kind merges what is in order already
    order.flags.writeable = False
    return order


class LevelIndex:
    """The tiles of one level that exist, each with its sequence. Entries are never removed."""

    def __init__(self) -> None:
        self.size = 0
        self.table = np.full(64, -1, np.int32)
        self.keys = np.zeros(32, np.uint64)
        self.tx = np.zeros(32, np.int32)
        self.ty = np.zeros(32, np.int32)
        self.sequence = np.zeros(32, np.int64)
        self._order = np.zeros(0, np.int32)  # the first so many entries, ascending

    @property
    def capacity(self) -> int:
        """Entries for which there is room: half of the hash table."""
        return len(self.keys)

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays, the entries' order too, whether it was asked for yet or not."""
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
        """Insert the tiles ``(new_x >> shift, new_y >> shift)`` that are not there yet, in this order."""
        self.reserve(len(new_x))
        self.size = _insert_tiles(self.table, self.keys, self.tx, self.ty, self.size, new_x, new_y, shift)

    def find(self, tx: int, ty: int) -> int:
        """Entry of a tile, or -1."""
        number, entries = self._probe_box((tx, ty, tx, ty))
        return int(entries[0]) if number else -1

    def _probe_box(self, box: TileBox) -> tuple[int, I4]:
        x0, y0, x1, y1 = box
        out = np.empty((x1 - x0 + 1) * (y1 - y0 + 1), np.int32)
        return _find_box(self.table, self.keys, x0, y0, x1, y1, out), out

    def entries(self, box: TileBox | None = None) -> I4:
        """Entries of the tiles in ``box`` (inclusive; None: all), ascending by signed (tx, ty); not to be changed."""
        tx, ty = self.tx[: self.size], self.ty[: self.size]
        if box is None:
            self._order = ascending(self._order, tx, ty)
            return self._order
        x0, y0, x1, y1 = box
        if x1 < x0 or y1 < y0:
            return np.zeros(0, np.int32)
        # Few tiles are asked for one by one; for many, one look at every entry is cheaper.
        if (x1 - x0 + 1) * (y1 - y0 + 1) <= max(64, self.size) and min(x0, y0) >= -(1 << 31) and max(x1, y1) < 1 << 31:
            number, out = self._probe_box(box)
            return out[:number]
        chosen = np.flatnonzero((tx >= x0) & (tx <= x1) & (ty >= y0) & (ty <= y1)).astype(np.int32)
        return chosen[np.lexsort((ty[chosen], tx[chosen]))]

    def changed(self, after: int) -> I4:
        """Entries of the tiles whose sequence is larger than ``after``, ascending by signed (tx, ty)."""
        chosen = np.flatnonzero(self.sequence[: self.size] > after).astype(np.int32)
        return chosen[np.lexsort((self.ty[chosen], self.tx[chosen]))]

    def versions(self) -> "TileVersions":
        """The tiles as they are now, to be read while the index goes on."""
        return TileVersions(self.tx[: self.size], self.ty[: self.size], self.sequence[: self.size].copy(), self._order)

    def select(self, box: TileBox | None = None) -> tuple[I4, I4, I8]:
        """Copies of (tx, ty, sequence) of the tiles in ``box`` (inclusive; None: all), ascending by (tx, ty)."""
        chosen = self.entries(box)
        return self.tx[chosen], self.ty[chosen], self.sequence[chosen]


class TileVersions:
    """Which tiles a level had at one moment, and the sequence of each; not changed by what the map does meanwhile."""

    def __init__(self, tx: I4, ty: I4, sequence: I8, order: I4) -> None:
        self._tx, self._ty, self._sequence = tx, ty, sequence  # entries only come: their numbers need no copy
        self._order = order

    def select(self, box: TileBox | None = None) -> tuple[I4, I8]:
        """(T, 2) tiles in ``box`` (inclusive; None: all), ascending by (x, y), and (T,) their sequences."""
        tx, ty = self._tx, self._ty
        if box is None:
            chosen = self._order = ascending(self._order, tx, ty)
        else:
            x0, y0, x1, y1 = box
            chosen = np.flatnonzero((tx >= x0) & (tx <= x1) & (ty >= y0) & (ty <= y1)).astype(np.int32)
            chosen = chosen[np.lexsort((ty[chosen], tx[chosen]))]
        return paired(tx[chosen], ty[chosen]), self._sequence[chosen]
