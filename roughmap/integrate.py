"""From bounded points to changed tiles: collect, make room, update in order, mark."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from roughmap.arrays import I4, I8, U1, U8
from roughmap.blocks import State
from roughmap.cell import TILE_CELLS, TooManyTiles
from roughmap.changes import mark_changed
from roughmap.fused import collect_odd, update_tiles
from roughmap.index import find, row_of
from roughmap.jit import kernel
from roughmap.settings import Rules, Settings
from roughmap.tiles import TileTable
from roughmap.workspace import Planes, ThreadScratch, Workspace

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


def integrate(
    planes: Planes,
    edges: I8,
    stamps: I8,
    sequence: int,
    table: TileTable,
    settings: Settings,
    space: Workspace,
    max_new_tiles: int | None,
    max_tiles: int | None,
) -> tuple[I4, int]:
    """Take up the points in ``planes`` (with ``stamps``, one or one a point) as ``sequence``.

    ``edges`` (P + 1,): the ranges of points whose tiles the first P threads' scratch holds. Returns the changed tiles
    (T, 2), ascending, and the newest stamp in them (0 if none). `TooManyTiles` and MemoryError come before anything is
    changed; so does what goes wrong when tiles are brought back from the shelf.
    """
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
    # All memory is taken before the first cell is written: what fails then has changed nothing.
    bits = np.zeros((number, TILE_CELLS), np.uint64)
    order = np.lexsort((ty, tx))
    changed = np.stack([tx[order], ty[order]], axis=1)
    table.open(entries[entries >= 0])
    entries[new] = table.insert(tx[new], ty[new], dense=work[new] >= _DENSE_POINTS)
    table.used[entries] = sequence

    oldest, newest = table.oldest_ns[entries], table.newest_ns[entries]
    oldest[new], newest[new] = _NEVER_NS.max, _NEVER_NS.min
    address = table.pool.address[table.slot[entries]]
    owner = np.zeros(number, np.uint8)
    _share_out(np.argsort(-work, kind="stable"), work, parts, owner)

    ends = np.array([scratch.tiles.runs for scratch in space.scratch[:parts]])

    def update(part: int, scratch: ThreadScratch) -> None:
        update_tiles(
            part,
            owner,
            edges[:-1],
            ends,
            planes,
            stamps,
            settings.rules,
            settings.min_distance,
            rows,
            tiles.table,
            keys,
            address,
            bits,
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
        mark_changed(z, level.table, level.keys, level.sequence, tx, ty, bits, sequence)
    return changed, int(newest.max(initial=0))
