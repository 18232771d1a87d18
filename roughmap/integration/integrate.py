"""From bounded points to changed tiles: collect and bring into memory; make room, update in order, mark."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from roughmap.arrays import I4, I8, U1, U8
from roughmap.cell import REASON_NAMES, TILE_CELLS, TooManyTiles
from roughmap.integration.blocks import State
from roughmap.integration.fused import collect_odd, update_tiles
from roughmap.integration.workspace import Planes, ThreadScratch, Workspace, blocks_of
from roughmap.jit import kernel
from roughmap.points.place import BLOCK
from roughmap.settings import Rules, Settings
from roughmap.tiles.changes import mark_changed
from roughmap.tiles.index import find, row_of
from roughmap.tiles.table import Hold, TileTable

_DENSE_POINTS = 128
"""A tile that so many points of one scan touch will soon be known for the most part."""

_NEVER_NS = np.iinfo(np.int64)


@dataclass(frozen=True, eq=False)
class AddReport:
    """What became of a call's points.

    ``accepted``: how many were used. ``rejected``: {reason: number} of the others, without zeros. ``tiles``: (T, 2)
    int32, the level-0 tiles of which a cell changed, ascending by (x, y).
    """

    accepted: int
    rejected: dict[str, int] = field(default_factory=dict)
    tiles: I4 = field(default_factory=lambda: np.zeros((0, 2), np.int32))


class Work(NamedTuple):
    """What is left to do when a call's points are bounded and their tiles are found, in the workspace's rows of tiles.

    ``planes``, ``edges`` (P + 1,), ``stamps``: the points, their range a thread, one stamp or one a point. ``rows``
    (P, R): see `_merged`. ``tx``, ``ty`` (T,): the tiles; ``entries`` (T,) of the table, -1 for those that are ``new``.
    ``changed`` (T, 2): the tiles, ascending. ``owner`` (T,): the thread of each; ``bits`` (T, 64): room for their
    changed cells.
    """

    planes: Planes
    edges: I8
    stamps: I8
    rows: I4
    tx: I4
    ty: I4
    entries: I4
    new: I8
    changed: I4
    owner: U1
    bits: U8


@dataclass(frozen=True, eq=False)
class Prepared:
    """A call's points, placed and counted as in `AddReport`; the map is as it was.

    ``work`` is for `RoughMap.integrate`; None: there is nothing to do. It is of the map as it was at ``state``.
    """

    accepted: int
    rejected: dict[str, int]
    work: Work | None = None
    state: tuple[int, ...] = ()


@kernel
def _find_all(table: I4, keys: U8, wanted: U8, entries: I4) -> None:
    for n in range(len(wanted)):
        entries[n] = find(table, keys, wanted[n])


@kernel
def _merge(table: I4, keys: U8, work: I8, number: int, found: U8, points: I8, rows: I4) -> int:
    """Add a part's tiles to those of the parts before it; ``rows``: where each is. The number of tiles."""
    for n in range(len(found)):
        row, number = row_of(table, keys, work, found[n], number)
        work[row] += points[n]
        rows[n] = row
    return number


@kernel
def _share_out(order: I8, work: I8, parts: int, owner: U1) -> None:
    """Give each tile, the busiest first, to the part that has the least to do."""
    load = np.zeros(parts, np.int64)
    for n in order:
        least = np.argmin(load)
        owner[n] = least
        load[least] += work[n]


Geometry = Callable[[int, int, ThreadScratch, State], tuple[int, State]]
"""Phase one over a range of points: (start, stop, scratch, state before) to (where it stopped, state there)."""


def find_tiles(start: int, stop: int, planes: Planes, rules: Rules, scratch: ThreadScratch, geometry: Geometry) -> None:
    """Phase one for a range of points: their ``geometry``, and the tiles in which they take part, in the scratch."""
    tiles = scratch.tiles
    tiles.clear()
    at, state = start, (0, start, start)
    while at < stop:
        at, state = geometry(at, stop, scratch, state)
        tiles.number, tiles.runs, _ = state
        if at < stop:
            tiles.double()
    at, odd = start, state[2]
    while at < odd:
        at, tiles.number = collect_odd(
            at, odd, planes, rules, tiles.arrays, tiles.number, scratch.lines, scratch.shares
        )
        if at < odd:
            tiles.double()


def _merged(space: Workspace, parts: int) -> I4:
    """Bring all parts' tiles together in the first one's; (P, R): the rows there of the tiles that each part found."""
    first, *others = [scratch.tiles for scratch in space.scratch[:parts]]
    rows = np.empty((parts, max(first.number, *(other.number for other in others), 1)), np.int32)
    rows[0, : first.number] = np.arange(first.number)
    for n, other in enumerate(others, 1):
        while 2 * (first.number + other.number) > len(first.table):
            first.double()
        found, points = other.keys[: other.number], other.work[: other.number]
        first.number = _merge(first.table, first.keys, first.work, first.number, found, points, rows[n])
    return rows


def prepare(
    number: int,
    planes: Planes,
    stamps: I8,
    geometry: Geometry,
    state: tuple[int, ...],
    table: TileTable,
    settings: Settings,
    space: Workspace,
    max_new_tiles: int | None,
    max_tiles: int | None,
    hold: Hold,
) -> Prepared:
    """Phase one of ``number`` points: their ``geometry``, and the tiles that they touch, in memory and shared out.

    `TooManyTiles` before any is brought back; for ``hold``, and what may be raised then, see `TileTable.bring_back`.
    """
    parts = space.parts(number)
    edges = np.array([min(blocks_of(number) * n // parts * BLOCK, number) for n in range(parts + 1)])

    def find(part: int, scratch: ThreadScratch) -> None:
        find_tiles(int(edges[part]), int(edges[part + 1]), planes, settings.rules, scratch, geometry)

    space.run(parts, find)
    counts = np.sum([scratch.tiles.rejected for scratch in space.scratch[:parts]], axis=0)
    accepted = number - int(counts.sum())
    rejected = {name: n for name, n in zip(REASON_NAMES, counts.tolist(), strict=True) if n}
    if not accepted:
        return Prepared(0, rejected)
    work = _work(planes, edges, stamps, table, space, max_new_tiles, max_tiles)
    table.bring_back(work.entries[work.entries >= 0], hold)
    return Prepared(accepted, rejected, work, (*state, space.uses))


def _work(
    planes: Planes,
    edges: I8,
    stamps: I8,
    table: TileTable,
    space: Workspace,
    max_new_tiles: int | None,
    max_tiles: int | None,
) -> Work:
    """What there is to do. ``edges``: the ranges of points whose tiles the first P threads' scratch holds."""
    parts = len(edges) - 1
    rows = _merged(space, parts)
    tiles = space.scratch[0].tiles
    number = tiles.number
    keys, work = tiles.keys[:number], tiles.work[:number]
    entries = np.empty(number, np.int32)
    base = table.levels[0]
    _find_all(base.table, base.keys, keys, entries)
    new = np.flatnonzero(entries < 0)
    allowed = len(new) if max_new_tiles is None else max_new_tiles
    if max_tiles is not None:
        allowed = min(allowed, max(max_tiles - table.size, 0))
    if len(new) > allowed:
        raise TooManyTiles(len(new), allowed)
    tx = (keys >> np.uint64(32)).astype(np.uint32).view(np.int32)
    ty = keys.astype(np.uint32).view(np.int32)
    order = np.lexsort((ty, tx))
    owner = np.zeros(number, np.uint8)
    _share_out(np.argsort(-work, kind="stable"), work, parts, owner)
    bits = np.zeros((number, TILE_CELLS), np.uint64)
    changed = np.stack([tx[order], ty[order]], axis=1)
    return Work(planes, edges, stamps, rows, tx, ty, entries, new, changed, owner, bits)


def integrate(work: Work, sequence: int, table: TileTable, settings: Settings, space: Workspace) -> int:
    """Phase two: take up the points as ``sequence``; the newest stamp in their tiles (0 if none).

    MemoryError comes before anything is changed.
    """
    tx, ty, entries, new = work.tx, work.ty, work.entries.copy(), work.new
    tiles = space.scratch[0].tiles
    # All memory is taken before the first cell is written: what fails then has changed nothing.
    table.open(entries[entries >= 0])
    entries[new] = table.insert(tx[new], ty[new], dense=tiles.work[new] >= _DENSE_POINTS)
    table.used[entries] = sequence

    oldest, newest = table.oldest_ns[entries], table.newest_ns[entries]
    oldest[new], newest[new] = _NEVER_NS.max, _NEVER_NS.min
    address = table.pool.address[table.slot[entries]]
    parts = len(work.edges) - 1
    ends = np.array([scratch.tiles.runs for scratch in space.scratch[:parts]])

    def update(part: int, scratch: ThreadScratch) -> None:
        update_tiles(
            part,
            work.owner,
            work.edges[:-1],
            ends,
            work.planes,
            work.stamps,
            settings.rules,
            settings.min_distance,
            work.rows,
            tiles.table,
            tiles.keys[: tiles.number],
            address,
            work.bits,
            oldest,
            newest,
            scratch.lines,
            scratch.shares,
            scratch.queue,
        )

    space.run(parts, update)
    table.oldest_ns[entries] = oldest
    table.newest_ns[entries] = newest
    table.digest_known[entries] = False
    for z, level in enumerate(table.levels):
        mark_changed(z, level.table, level.keys, level.sequence, tx, ty, work.bits, sequence)
    return int(newest.max(initial=0))
