"""Which tiles count as changed, at every level: those with a changed cell in them or in the ring of cells around.

The ring is as wide as what a tile's layers are derived from.
"""

import numpy as np

from roughmap.arrays import I4, I8, U8, Scalar
from roughmap.cell import TILE_CELLS, TILE_SHIFT
from roughmap.jit import inline, kernel
from roughmap.tiles.index import find, tile_key
from roughmap.tiles.reach import ring as ring_width

_SHIFT = np.int64(TILE_SHIFT)
_ALL = np.uint64(0xFFFFFFFFFFFFFFFF)


@inline
def _low_bits(number: Scalar) -> Scalar:
    """Return a word with the lowest ``number`` bits set; ``number`` is clipped to 0 .. 64."""
    if number <= 0:
        return np.uint64(0)
    if number >= TILE_CELLS:
        return _ALL
    return (np.uint64(1) << np.uint64(number)) - np.uint64(1)


def rings(surface: str, cell_size: float, levels: int) -> tuple[int, ...]:
    """Return the width of the ring at each level, in its cells.

    Slope needs the next cell. The ground's layers need the plane's radius, the overhang's and one cell more. Above
    level 0 the worst of a cell's level-0 cells needs their ring too, which is never wider than that of the level.
    """
    if surface == "all":
        return (1,) * levels
    return tuple(ring_width(cell_size * (1 << level)) for level in range(levels))


@kernel
def mark_changed(level: int, ring: int, table: I4, keys: U8, sequence: I8, tx: I4, ty: I4, bits: U8, now: int) -> None:
    """Set the sequence ``now`` for the tiles of a level that changed, or whose ring of 1 to 63 cells changed.

    ``tx``, ``ty`` (T,), ``bits`` (T, 64): level-0 tiles with their changed cells. A changed cell lies in a neighbour's
    ring if it is within ``ring`` cells of this level, of 2^level cells of level 0 each, of the common border.
    """
    reach = np.int64(ring) << level
    far = (np.int64(TILE_CELLS) << level) - reach
    for n in range(len(tx)):
        x = np.int64(tx[n]) >> level
        y = np.int64(ty[n]) >> level
        # Offset of the tile in its ancestor, which is 64 * 2^level level-0 cells wide, in level-0 cells.
        left = (np.int64(tx[n]) - (x << level)) << _SHIFT
        foot = (np.int64(ty[n]) - (y << level)) << _SHIFT
        west = _low_bits(reach - left)
        east = ~_low_bits(far - left)
        inner = np.uint64(0)
        south = np.uint64(0)
        north = np.uint64(0)
        for j in range(TILE_CELLS):
            row = bits[n, j]
            inner |= row
            south |= row if foot + j < reach else np.uint64(0)
            north |= row if foot + j >= far else np.uint64(0)
        for dy in range(-1, 2):
            band = inner
            band = south if dy < 0 else band
            band = north if dy > 0 else band
            for dx in range(-1, 2):
                hit = band
                hit = band & west if dx < 0 else hit
                hit = band & east if dx > 0 else hit
                if hit != 0:
                    entry = find(table, keys, tile_key(x + dx, y + dy))
                    if entry >= 0:
                        sequence[entry] = now
