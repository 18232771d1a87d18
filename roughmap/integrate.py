"""From bounded points to changed tiles: collect, make room, update in order, mark."""

from dataclasses import dataclass, field

import numpy as np

from roughmap.arrays import I4, I8, U1, U8
from roughmap.cell import TILE_CELLS, TooManyTiles
from roughmap.fused import collect_tiles, mark_changed, update_tiles
from roughmap.index import find
from roughmap.jit import kernel
from roughmap.settings import Settings
from roughmap.tiles import TileTable
from roughmap.workspace import Planes, ThreadScratch, Workspace

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
def _share_out(order: I8, work: I8, parts: int, owner: U1) -> None:
    """Give each tile, the busiest first, to the part that has the least to do."""
    load = np.zeros(parts, np.int64)
    for n in order:
        least = np.argmin(load)
        owner[n] = least
        load[least] += work[n]


def _collect(planes: Planes, settings: Settings, space: Workspace) -> int:
    """Fill ``space.tiles`` and ``planes.home``; the number of tiles in which points take part."""
    tiles, scratch = space.tiles, space.scratch[0]
    tiles.clear()
    start, number = 0, 0
    while True:
        start, number = collect_tiles(
            start,
            settings.model,
            planes.x,
            planes.y,
            planes.reason,
            planes.cells,
            planes.body,
            settings.cell_size,
            settings.window,
            settings.min_share,
            planes.home,
            tiles.table,
            tiles.keys,
            tiles.work,
            number,
            scratch.lines,
            scratch.shares,
        )
        if start == len(planes.x):
            return number
        tiles.double(number)


def integrate(
    planes: Planes,
    stamps: I8,
    sequence: int,
    table: TileTable,
    settings: Settings,
    space: Workspace,
    max_new_tiles: int | None,
    max_tiles: int | None,
) -> tuple[I4, int]:
    """Take up the bounded points in ``planes`` (with ``stamps``, one or one a point) as ``sequence``.

    Returns the changed tiles (T, 2), ascending, and the newest stamp in them (0 if none). `TooManyTiles` and
    MemoryError come before anything is changed; so does what goes wrong when tiles are brought back from the shelf.
    """
    number = _collect(planes, settings, space)
    keys, work = space.tiles.keys[:number], space.tiles.work[:number]
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
    bits = np.zeros((number, TILE_CELLS), np.uint64)
    table.open(entries[entries >= 0])
    entries[new] = table.insert(tx[new], ty[new])
    table.used[entries] = sequence

    oldest, newest = table.oldest_ns[entries], table.newest_ns[entries]
    oldest[new], newest[new] = _NEVER_NS.max, _NEVER_NS.min
    address = table.pool.address[table.slot[entries]]
    owner = np.zeros(number, np.uint8)
    parts = space.parts(len(planes.x))
    _share_out(np.argsort(-work, kind="stable"), work, parts, owner)

    def update(part: int, scratch: ThreadScratch) -> None:
        update_tiles(
            part,
            owner,
            settings.model,
            planes.x,
            planes.y,
            planes.z,
            planes.reason,
            planes.cells,
            planes.body,
            stamps,
            settings.cell_size,
            settings.window,
            settings.min_share,
            settings.min_distance,
            planes.home,
            space.tiles.table,
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
    order = np.lexsort((ty, tx))
    return np.stack([tx[order], ty[order]], axis=1), int(newest.max(initial=0))
