"""The tiles that resets emptied, so that readers who hold tiles from before a reset learn which are gone."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roughmap import RoughMap

Tiles = npt.NDArray[np.int32]
Sequences = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class EmptiedTiles:
    """What resets had emptied by one moment."""

    level0: Tiles
    emptied: Sequences
    """(T,) the map's sequence at the last reset that emptied each tile."""
    sequence: int
    """The map's sequence at the last reset; 0 if there was none."""

    def tiles(self, level: int, present: Tiles, after: int = -1) -> Tiles:
        """Return the (T, 2) tiles of a level that a reset later than sequence ``after`` emptied and that are not among
        ``present``, ascending by (x, y)."""
        level0 = self.level0[self.emptied > after]
        return _without(np.unique(level0 >> level, axis=0), present) if len(level0) else level0


class ResetHistory:
    """Remembers the level-0 tiles that each reset emptied: at most ``limit`` tiles of 8 bytes.

    Beyond the limit the earliest resets are forgotten. A query with an epoch from before those gets all tiles, as after
    a restart. `note` is called with the map held, right before `RoughMap.reset`. `now` must be read with the map held
    too, so that it belongs to the same moment as what is read of the map.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._resets: list[tuple[int, Tiles]] = []
        self.now = EmptiedTiles(np.empty((0, 2), np.int32), np.empty(0, np.int64), 0)

    def note(self, rough_map: RoughMap) -> None:
        """Remember the tiles of the map, which the next reset empties."""
        tiles, sequence = rough_map.tile_sequences()[0], rough_map.sequence + 1
        # Each tile is kept once, with the last reset that emptied it.
        resets = [(when, left) for when, earlier in self._resets if len(left := _without(earlier, tiles))]
        resets.append((sequence, tiles))
        while len(resets) > 1 and sum(len(those) for _, those in resets) > self._limit:
            del resets[0]
        self._resets = resets
        level0 = np.concatenate([those for _, those in resets])
        emptied = np.repeat([when for when, _ in resets], [len(those) for _, those in resets])
        order = np.lexsort((level0[:, 1], level0[:, 0]))
        self.now = EmptiedTiles(level0[order], emptied[order], sequence)


def _without(tiles: Tiles, others: Tiles) -> Tiles:
    """Return the rows of the first (T, 2) that are not rows of the second, in their order."""
    if not len(tiles) or not len(others):
        return tiles
    return tiles[~np.isin(_packed(tiles), _packed(others))]


def _packed(tiles: Tiles) -> npt.NDArray[np.int64]:
    wide: npt.NDArray[np.int64] = tiles.astype(np.int64)
    packed: npt.NDArray[np.int64] = (wide[:, 0] << 32) | (wide[:, 1] & 0xFFFFFFFF)
    return packed
