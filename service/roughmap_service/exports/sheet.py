"""What an export writes: the layers over a rectangle of cells, handed out tile by tile, so that memory stays small."""

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from roughmap.cell import TILE_CELLS
from roughmap_schemas.faults import ReportedError

ZERO_WHERE_UNKNOWN: Final = frozenset({"count", "weight", "expected_count"})
"""Layers that are 0, not NaN, in unknown cells."""

Plane = npt.NDArray[np.float32]
CellBox = tuple[int, int, int, int]


class ExportFault(ReportedError):
    """The map can't be written as asked; one line with cause and remedy."""

    exit_code = 2


class PartOfTile(NamedTuple):
    """The cells of a tile that lie in the sheet: `values` (rows, columns, L), rows along y from the lowest.

    `i` and `j` are the numbers of the lowest cell along x and y, counted from the sheet's lower-left corner.
    """

    i: int
    j: int
    values: Plane


@dataclass(frozen=True, eq=False)
class Sheet:
    """The layers over the cells i0, j0, i1, j1 (half-open) of one state of the map.

    Attributes:
        layers: names, in the order of the values' last axis.
        cells: the rectangle, in cells of the level.
        cell_size: side of a cell, metres.
        tiles: x and y (T, 2) of the known tiles that meet it.
        draw: returns a tile's layers, (64, 64, L) float32, NaN where unknown.
        frame_id: frame of the map.
        stamp_ns: newest stamp of the map; 0 if there is none.
        crs: coordinate reference system of x and y, as WKT or "EPSG:..."; None if not known.
        title: names the map and its state.
        watch: called with the number of tiles drawn so far, and with how many there are.
        stage: called with the name of what follows after the tiles were drawn.
    """

    layers: tuple[str, ...]
    cells: CellBox
    cell_size: float
    tiles: npt.NDArray[np.int64]
    draw: Callable[[int, int], Plane]
    frame_id: str = "map"
    stamp_ns: int = 0
    crs: str | None = None
    title: str = ""
    watch: Callable[[int, int], None] = field(default=lambda *_: None)
    stage: Callable[[str], None] = field(default=lambda _: None)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows along y, columns along x."""
        i0, j0, i1, j1 = self.cells
        return j1 - j0, i1 - i0

    @property
    def ascii_title(self) -> str:
        """The title as a line of ASCII, for headers."""
        return self.title.encode("ascii", "replace").decode().replace("\n", " ")

    @property
    def low(self) -> tuple[float, float]:
        """x and y of the lower-left corner, metres."""
        return self.cells[0] * self.cell_size, self.cells[1] * self.cell_size

    @property
    def high(self) -> tuple[float, float]:
        """x and y of the upper-right corner, metres."""
        return self.cells[2] * self.cell_size, self.cells[3] * self.cell_size

    def parts(self, *, upward: bool = False) -> Iterator[PartOfTile]:
        """Yield the tiles in rows, from the highest row down (or upward), and from the lowest x up within a row."""
        rows = self.tiles[:, 1] if upward else -self.tiles[:, 1]
        i0, j0, i1, j1 = self.cells
        for done, (x, y) in enumerate(self.tiles[np.lexsort((self.tiles[:, 0], rows))].tolist(), 1):
            values = self.draw(x, y)
            left, low = max(i0 - x * TILE_CELLS, 0), max(j0 - y * TILE_CELLS, 0)
            right, top = min(i1 - x * TILE_CELLS, TILE_CELLS), min(j1 - y * TILE_CELLS, TILE_CELLS)
            yield PartOfTile(x * TILE_CELLS + left - i0, y * TILE_CELLS + low - j0, values[low:top, left:right])
            self.watch(done, len(self.tiles))

    def bands(self, *, upward: bool = False) -> Iterator[Plane]:
        """Yield bands of at most 64 whole rows, (rows, columns, L), from the top down (or upward).

        Within a band, too, the first row is the highest (or the lowest). A band is valid until the next one.
        """
        height = self.shape[0]
        at = 0
        for _, parts in itertools.groupby(self.parts(upward=upward), lambda part: part.j):
            first = next(parts)
            rows = len(first.values)
            begin = first.j if upward else height - first.j - rows
            yield from self._unknown(begin - at)
            band = self._blank(rows)
            for part in itertools.chain([first], parts):
                band[:, part.i : part.i + part.values.shape[1]] = part.values if upward else part.values[::-1]
            yield band
            at = begin + rows
        yield from self._unknown(height - at)

    def _unknown(self, rows: int) -> Iterator[Plane]:
        """Yield bands without a tile."""
        for begin in range(0, rows, TILE_CELLS):
            yield self._blank(min(TILE_CELLS, rows - begin))

    def _blank(self, rows: int) -> Plane:
        band = np.empty((rows, self.shape[1], len(self.layers)), np.float32)
        band[:] = np.array([self.unknown(name) for name in self.layers], np.float32)
        return band

    @staticmethod
    def unknown(layer: str) -> float:
        """Return a layer's value where nothing is known."""
        return 0.0 if layer in ZERO_WHERE_UNKNOWN else math.nan

    def only(self, layer: str) -> "Sheet":
        """Return the sheet of one of its layers."""
        at = self.layers.index(layer)
        return replace(self, layers=(layer,), draw=lambda x, y: self.draw(x, y)[:, :, at : at + 1])

    def check_cells(self, most: int, what: str) -> None:
        """Raise ExportFault for more than ``most`` cells."""
        rows, columns = self.shape
        if rows * columns > most:
            raise ExportFault(
                f"{what} of {columns} x {rows} cells has more than {most:,}: choose a part with --bbox, or a coarser "
                "--level"
            )
