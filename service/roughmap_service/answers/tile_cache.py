"""Tiles as they were encoded for one reader, kept for the next: each state of a tile is read and encoded once."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from roughmap.cell import TILE_CELLS
from roughmap_schemas.messages import TileInfo, model_bytes

ENTRY_BYTES = 4096
"""What an entry costs beside its payload: the key, the info and its JSON, the bits, the objects."""


@dataclass(frozen=True, slots=True, eq=False)
class DrawnTile:
    """One state of a tile as a Grid's bytes, and what is said of that state."""

    payload: bytes
    info: TileInfo
    """With map_sequence and answer_tiles 0: they are the answer's and not the tile's."""
    attachment: tuple[bytes, bytes]
    """That in JSON, what stands before and behind these two."""
    known: bytes
    """A bit a cell, row by row, as `numpy.packbits` makes them."""

    def told(self, map_sequence: int, answer_tiles: int) -> bytes:
        """The attachment in an answer."""
        before, behind = self.attachment
        return b'%b"map_sequence":%d,"answer_tiles":%d%b' % (before, map_sequence, answer_tiles, behind)

    def known_among(self, rows: slice, columns: slice) -> int:
        """How many cells of a part are known."""
        if rows == columns == slice(0, TILE_CELLS):
            return self.info.known_cells
        bits = np.unpackbits(np.frombuffer(self.known, np.uint8)).reshape(TILE_CELLS, TILE_CELLS)
        return int(np.count_nonzero(bits[rows, columns]))


def drawn_tile(payload: bytes, info: TileInfo, known: npt.NDArray[np.bool_]) -> DrawnTile:
    """A tile as drawn; ``info`` with map_sequence and answer_tiles 0, ``known`` (64, 64)."""
    before, behind = model_bytes(info).split(b'"map_sequence":0,"answer_tiles":0')
    return DrawnTile(payload, info, (before, behind), np.packbits(known).tobytes())


class TileCache:
    """At most ``limit`` bytes of drawn tiles, shared by all readers; what was not asked for the longest goes first.

    Keys tell the state of the tile and the form that was asked for, so that no entry is ever outdated.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._tiles: OrderedDict[Hashable, DrawnTile] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()

    @property
    def nbytes(self) -> int:
        """Bytes held now."""
        return self._bytes

    def get(self, key: Hashable, draw: Callable[[], DrawnTile]) -> DrawnTile:
        """The tile kept under ``key``, else what ``draw`` gives, which is then kept. ``draw`` runs outside the lock:
        two readers may draw the same tile at once, and one of the two is kept."""
        with self._lock:
            found = self._tiles.get(key)
            if found is not None:
                self._tiles.move_to_end(key)
                return found
        drawn = draw()
        with self._lock:
            if key not in self._tiles:
                self._tiles[key] = drawn
                self._bytes += _cost(drawn)
            while self._bytes > self._limit:
                self._bytes -= _cost(self._tiles.popitem(last=False)[1])
        return drawn


def _cost(drawn: DrawnTile) -> int:
    return len(drawn.payload) + ENTRY_BYTES
