"""The tiles that a reset emptied, so that readers of the map before it learn which of theirs are gone."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roughmap import RoughMap

Tiles = npt.NDArray[np.int32]
Sequences = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Gone:
    """What resets had emptied up to one moment."""

    level0: Tiles
    emptied: Sequences
    """(T,) of each of them, the map's sequence that its last reset made."""
    sequence: int
    """The map's sequence that the last reset made; 0 without one."""

    def tiles(self, level: int, present: Tiles, after: int = -1) -> Tiles:
        """(T, 2) tiles of a level that a reset later than sequence ``after`` emptied, and that are not among
        ``present``, ascending by (x, y)."""
        level0 = self.level0[self.emptied > after]
        return without(np.unique(level0 >> level, axis=0), present) if len(level0) else level0


class Emptied:
    """Level-0 tiles known before a reset, 8 bytes each, at most ``limit`` of them: beyond it those are forgotten that
    the earliest resets emptied. Whoever asks with an epoch from before those gets all tiles, as after a restart.

    ``note`` is called with the map held, right before `RoughMap.reset`; ``now`` is read with the map held too, so that
    it is of the same moment as a reading of the map.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._resets: list[tuple[int, Tiles]] = []
        self.now = Gone(np.empty((0, 2), np.int32), np.empty(0, np.int64), 0)

    def note(self, rough_map: RoughMap) -> None:
        """Remember the tiles that the map holds now, beside those of earlier resets."""
        tiles, sequence = rough_map.tile_sequences()[0], rough_map.sequence + 1
        # Each tile stands with the last reset that emptied it.
        resets = [(when, left) for when, earlier in self._resets if len(left := without(earlier, tiles))]
        resets.append((sequence, tiles))
        while len(resets) > 1 and sum(len(those) for _, those in resets) > self._limit:
            del resets[0]
        self._resets = resets
        level0 = np.concatenate([those for _, those in resets])
        emptied = np.repeat([when for when, _ in resets], [len(those) for _, those in resets])
        order = np.lexsort((level0[:, 1], level0[:, 0]))
        self.now = Gone(level0[order], emptied[order], sequence)


def without(tiles: Tiles, others: Tiles) -> Tiles:
    """The rows of the first (T, 2) that are no rows of the second, in their order."""
    if not len(tiles) or not len(others):
        return tiles
    return tiles[~np.isin(_packed(tiles), _packed(others))]


def _packed(tiles: Tiles) -> npt.NDArray[np.int64]:
    wide: npt.NDArray[np.int64] = tiles.astype(np.int64)
    packed: npt.NDArray[np.int64] = (wide[:, 0] << 32) | (wide[:, 1] & 0xFFFFFFFF)
    return packed
