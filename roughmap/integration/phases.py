"""The two phases of an `add`.

Phase one computes the geometry of the points, finds the tiles that they touch and brings them into memory. Phase two
inserts new tiles, updates the cells in the order of the points, and marks what changed. Only phase two changes the map.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from roughmap.arrays import I4, I8, U1, U8
from roughmap.cell import REASON_NAMES, TILE_CELLS, TooManyTiles
from roughmap.integration.clearing import Sight, clear, prepare_clearing, with_columns
from roughmap.integration.drains import TILE_WORDS
from roughmap.integration.geometry import Geometry, PointInput
from roughmap.integration.tile_update import collect_odd, update_tiles
from roughmap.integration.workspace import Planes, ThreadScratch, TouchedTiles, Workspace, blocks_of
from roughmap.jit import kernel
from roughmap.points.place import BLOCK
from roughmap.settings import MapSettings, Rules
from roughmap.tiles.index import find, find_or_add
from roughmap.tiles.table import ReaderLock, TileTable

_DENSE_POINTS = 8
"""A new tile with at least this many points of one scan will soon be mostly known."""

_NEVER_NS = np.iinfo(np.int64)


@dataclass(frozen=True, eq=False)
class AddReport:
    """The result of adding points.

    ``accepted``: number of points used. ``rejected``: {reason: number of points}, without zeros. ``tiles``: (T, 2)
    int32, the level-0 tiles that the points touched or that were cleared, ascending by (x, y). ``cleared``: number of
    height bins whose hits were halved, because the scan saw through them.
    """

    accepted: int
    rejected: dict[str, int] = field(default_factory=dict)
    tiles: I4 = field(default_factory=lambda: np.zeros((0, 2), np.int32))
    cleared: int = 0


class Work(NamedTuple):
    """What phase one leaves for phase two.

    ``planes``, ``stamps``, ``pose_error_time``: see `PointInput`. ``parts``: number of threads. ``edges`` (Q + 1,):
    where the ranges of points begin and end. ``rows`` (Q, R): see `_merge_ranges`. For each tile of the merged table,
    ``tx``, ``ty`` (T,): its numbers; ``entries`` (T,): its entry in the map's table, or -1; ``owner`` (T,): the part
    that updates it; ``bits`` (T, 64): room for its changed cells. ``there``: the rows of tiles that exist, or will
    because a point in them can be ground. ``changed`` (U, 2): these tiles, ascending. ``sight``: what the scan saw, if
    it clears.
    """

    planes: Planes
    parts: int
    edges: I8
    stamps: I8
    pose_error_time: float
    rows: I4
    tx: I4
    ty: I4
    entries: I4
    there: I8
    changed: I4
    owner: U1
    bits: U8
    sight: Sight | None = None


@dataclass(frozen=True, eq=False)
class Prepared:
    """The result of phase one. The map has not changed yet.

    ``accepted``, ``rejected``: as in `AddReport`. ``work``: the input of phase two, or None if there is nothing to do.
    ``version``: the version of the map for which it was prepared.
    """

    accepted: int
    rejected: dict[str, int]
    work: Work | None = None
    version: tuple[int, ...] = ()


@kernel
def _find_all(table: I4, keys: U8, wanted: U8, entries: I4) -> None:
    for n in range(len(wanted)):
        entries[n] = find(table, keys, wanted[n])


@kernel
def _merge(table: I4, keys: U8, work: I8, founded: U1, number: int, found: U8, points: I8, low: U1, rows: I4) -> int:
    """Add the tiles of a range to the merged ones; set ``rows`` to their rows there and return the number of tiles."""
    for n in range(len(found)):
        row, number = find_or_add(table, keys, work, found[n], number)
        work[row] += points[n]
        founded[row] |= low[n]
        rows[n] = row
    return number


@kernel
def _assign_owners(order: I8, work: I8, parts: int, owner: U1) -> None:
    """Give each tile, the busiest first, to the part with the least work."""
    load = np.zeros(parts, np.int64)
    for n in order:
        least = np.argmin(load)
        owner[n] = least
        load[least] += work[n]


def find_tiles(
    start: int, stop: int, planes: Planes, rules: Rules, scratch: ThreadScratch, tiles: TouchedTiles, geometry: Geometry
) -> None:
    """Compute the ``geometry`` of a range of points and collect its tiles."""
    tiles.clear()
    at, state = start, (0, start, start)
    while at < stop:
        at, state = geometry(at, stop, scratch.block, tiles, state)
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


def _merge_ranges(ranges: list[TouchedTiles]) -> I4:
    """Merge the tiles of all ranges into the first one's table; return the (Q, R) rows there of each range's tiles."""
    first, *others = ranges
    rows = np.empty((len(ranges), max(first.number, *(other.number for other in others), 1)), np.int32)
    rows[0, : first.number] = np.arange(first.number)
    for n, other in enumerate(others, 1):
        while 2 * (first.number + other.number) > len(first.table):
            first.double()
        found, points = other.keys[: other.number], other.work[: other.number]
        first.number = _merge(
            first.table, first.keys, first.work, first.founded, first.number, found, points, other.founded, rows[n]
        )
    return rows


def phase_one(
    points: PointInput,
    version: tuple[int, ...],
    table: TileTable,
    settings: MapSettings,
    space: Workspace,
    max_new_tiles: int | None,
    max_tiles: int | None,
    reader_lock: ReaderLock,
) -> Prepared:
    """Compute the geometry of the points, find the tiles that they touch, and bring these into memory.

    `TooManyTiles` comes before any tile is brought back; for ``reader_lock`` and other errors see
    `TileTable.bring_back`.
    """
    planes, geometry = points.planes, points.geometry
    number = len(points.points)
    parts = space.parts(number)
    edges = _edges(number, parts)
    ranges = space.tiles(len(edges) - 1)

    def find(part: int, scratch: ThreadScratch) -> None:
        # The first and the last range, the second and the last but one, and so on. Points mostly come ring by ring, and
        # the more distant the ring, the more cells has a point: parts of one range each would differ in work.
        for n in sorted({part, len(ranges) - 1 - part}):
            find_tiles(int(edges[n]), int(edges[n + 1]), planes, settings.rules, scratch, ranges[n], geometry)

    space.run(parts, find)
    counts = np.sum([tiles.rejected for tiles in ranges], axis=0)
    accepted = number - int(counts.sum())
    rejected = {name: n for name, n in zip(REASON_NAMES, counts.tolist(), strict=True) if n}
    if not accepted:
        return Prepared(0, rejected)
    work = _work(points, parts, edges, table, ranges, max_new_tiles, max_tiles)
    needed = work.entries[work.entries >= 0]
    if points.look is not None:
        sight = prepare_clearing(points.look, planes, table, settings.cell_size, space)
        needed = np.union1d(needed, sight.entries)
        work = work._replace(sight=sight)
    table.bring_back(needed, reader_lock)
    return Prepared(accepted, rejected, work, (*version, space.uses))


def _edges(number: int, parts: int) -> I8:
    """Cut the points into ranges of whole blocks, two for each of several parts; return where they begin and end."""
    ranges = 2 * parts if parts > 1 else 1
    return np.array([min(blocks_of(number) * n // ranges * BLOCK, number) for n in range(ranges + 1)])


def _work(
    points: PointInput,
    parts: int,
    edges: I8,
    table: TileTable,
    ranges: list[TouchedTiles],
    max_new_tiles: int | None,
    max_tiles: int | None,
) -> Work:
    """Merge the tiles of the ranges, look them up and assign them. `TooManyTiles` if too many are new."""
    rows = _merge_ranges(ranges)
    tiles = ranges[0]
    number = tiles.number
    keys, work = tiles.keys[:number], tiles.work[:number]
    entries = np.empty(number, np.int32)
    base = table.levels[0]
    _find_all(base.table, base.keys, keys, entries)
    founded = tiles.founded[:number] != 0
    new = int(np.count_nonzero(founded & (entries < 0)))
    allowed = new if max_new_tiles is None else max_new_tiles
    if max_tiles is not None:
        allowed = min(allowed, max(max_tiles - table.size, 0))
    if new > allowed:
        raise TooManyTiles(new, allowed)
    tx = (keys >> np.uint64(32)).astype(np.uint32).view(np.int32)
    ty = keys.astype(np.uint32).view(np.int32)
    there = np.flatnonzero(founded | (entries >= 0))
    order = there[np.lexsort((ty[there], tx[there]))]
    owner = np.zeros(number, np.uint8)
    if parts > 1:
        _assign_owners(np.argsort(-work, kind="stable"), work, parts, owner)
    bits = np.zeros((number, TILE_CELLS), np.uint64)
    changed = np.stack([tx[order], ty[order]], axis=1)
    return Work(
        points.planes, parts, edges, points.stamps, points.pose_error_time, rows, tx, ty, entries, there, changed,
        owner, bits,
    )  # fmt: skip


@contextmanager
def _to_its_end() -> Iterator[None]:
    """Make a MemoryError in a change that has begun a RuntimeError: after the former, a caller goes on with the map."""
    try:
        yield
    except MemoryError as error:
        raise RuntimeError("memory ran out while the map changed: it can't be used any more") from error


def phase_two(
    work: Work, sequence: int, table: TileTable, settings: MapSettings, space: Workspace
) -> tuple[int, int, I4]:
    """Update the tiles with the points, as ``sequence``, and clear what they show to be gone.

    Returns the newest stamp in the tiles with points (0 if none), in ns; the number of hits cleared; and the (T, 2)
    tiles that changed, ascending.

    A MemoryError comes before anything has changed; later, where it takes far less memory, it is a RuntimeError.
    """
    number = len(work.tx)
    ranges = space.tiles(len(work.edges) - 1)
    tiles = ranges[0]  # of all, merged
    there = work.there
    known = work.entries[there] >= 0
    tx, ty, dense = work.tx[there], work.ty[there], tiles.work[there] >= _DENSE_POINTS
    # All memory is allocated before the first cell is written, so that a failure changes nothing.
    oldest, newest = np.full(number, _NEVER_NS.max), np.full(number, _NEVER_NS.min)
    begun, homes = np.zeros(number, np.uint8), np.zeros((number, TILE_WORDS), np.uint64)
    ends = np.array([touched.runs for touched in ranges])
    measures = settings.min_distance, settings.band, float(work.pose_error_time)
    if work.sight is not None:
        table.make_writable(with_columns(table, work.sight.entries))
    entries, lent = table.open(work.entries[there], tx, ty, dense, columns=settings.ground_only)
    with _to_its_end():
        slots = table.slot[entries]
        table.used[entries] = sequence
        # By row; nothing is read of rows without a tile.
        oldest[there[known]], newest[there[known]] = table.oldest_ns[entries[known]], table.newest_ns[entries[known]]
        begun[there] = known
        homes[there, 0], homes[there, 1] = table.pool.address[slots], table.pool.column_address[slots]

        def update(part: int, scratch: ThreadScratch) -> None:
            update_tiles(
                part,
                work.owner,
                work.edges[:-1],
                ends,
                work.planes,
                work.stamps,
                settings.rules,
                measures,
                work.rows,
                tiles.table,
                tiles.keys[: tiles.number],
                homes,
                begun,
                work.bits,
                oldest,
                newest,
                scratch.lines,
                scratch.shares,
                scratch.queue,
            )

        space.run(work.parts, update)
        table.pool.drop_columns(np.setdiff1d(lent, slots[homes[there, 2] != 0]))
        table.oldest_ns[entries] = oldest[there]
        table.newest_ns[entries] = newest[there]
        table.mark_changed(entries, tx, ty, work.bits[there], sequence)
        newest_ns = int(newest.max(initial=0))
        if work.sight is None:
            return newest_ns, 0, work.changed
        cleared, changed = clear(work.sight, table, settings.cell_size, space, sequence)
        return newest_ns, cleared, np.unique(np.concatenate([work.changed, changed]), axis=0)
