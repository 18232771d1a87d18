"""Tiles that were emptied, by a reset or because they were forgotten: readers who hold them must learn of it."""

from dataclasses import dataclass

import numpy as np

from roughmap.arrays import I4
from roughmap.tiles.index import packed

MOST_PARTS = 64
"""After so many changes their tiles are put together, each with the last change that emptied it."""


@dataclass(frozen=True, slots=True, eq=False)
class EmptiedTiles:
    """What had been emptied by one moment.

    ``parts``: the map's sequence after a change that emptied level-0 tiles, and these (T, 2); ascending. ``sequence``:
    of the last such change; 0 if there was none.
    """

    parts: tuple[tuple[int, I4], ...] = ()
    sequence: int = 0

    def tiles(self, level: int, present: I4, after: int = -1) -> I4:
        """Return the (T, 2) tiles of a level that were emptied later than sequence ``after`` and are not among
        ``present``, ascending by (x, y)."""
        level0 = [tiles for sequence, tiles in self.parts if sequence > after]
        if not level0:
            return np.empty((0, 2), np.int32)
        return _without(np.unique(np.concatenate(level0) >> level, axis=0), present)


class EmptiedHistory:
    """Remembers the level-0 tiles that each change emptied: about ``limit`` tiles of 8 bytes.

    Beyond the limit the earliest changes are forgotten. `note` is called with the map held. `now` may be read at any
    time after what it is compared with: tiles that were emptied since then are present there.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self.now = EmptiedTiles()

    def note(self, tiles: I4, sequence: int) -> None:
        """Remember (T, 2) tiles that are empty from ``sequence`` on."""
        parts = [*self.now.parts, (sequence, tiles)]
        if len(parts) > MOST_PARTS or sum(len(those) for _, those in parts) > self._limit:
            parts = self._together(parts)
        self.now = EmptiedTiles(tuple(parts), sequence)

    def _together(self, parts: list[tuple[int, I4]]) -> list[tuple[int, I4]]:
        """Keep each tile once, with its last change, and at most `limit` tiles; in half as many parts."""
        kept: list[tuple[int, I4]] = []
        later = np.empty((0, 2), np.int32)
        for sequence, tiles in reversed(parts):
            left = _without(tiles, later)
            if kept and len(later) + len(left) > self._limit:
                break
            kept.append((sequence, left))
            later = np.concatenate((later, left))
        kept.reverse()
        return [_joined(kept[at : at + 2]) for at in range(0, len(kept), 2)]


def _joined(parts: list[tuple[int, I4]]) -> tuple[int, I4]:
    """Put parts together under the sequence of the last: readers then learn of some tiles once more than they need."""
    return parts[-1][0], np.concatenate([tiles for _, tiles in parts])


def _without(tiles: I4, others: I4) -> I4:
    """Return the rows of the first (T, 2) that are not rows of the second, in their order."""
    if not len(tiles) or not len(others):
        return tiles
    return tiles[~np.isin(packed(tiles[:, 0], tiles[:, 1]), packed(others[:, 0], others[:, 1]))]
