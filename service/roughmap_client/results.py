"""What the client returns: numpy arrays, and the state of the map that they show."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roughmap_schemas.messages import CellState, TileInfo

Plane = npt.NDArray[np.float32] | npt.NDArray[np.float64]


class Version(NamedTuple):
    """A state of a map: ``sequence`` counts its changes, ``epoch`` its starts and resets.

    Only versions with the same epoch and instance are comparable. ``instance`` is the process that answered ("" if not
    known); it tells a new run, which counts from 1 again, from the one before.
    """

    epoch: int
    sequence: int
    instance: str = ""


class Layers(Mapping[str, Plane]):
    """Layers over a rectangle of cells, by name: (ny, nx), row 0 at the lowest y, column 0 at the lowest x.

    Unknown cells are NaN, but 0 in `count` and `weight`.
    """

    def __init__(
        self, layers: Mapping[str, Plane], origin: tuple[float, float], cell_size: float, info: TileInfo
    ) -> None:
        self._layers = dict(layers)
        self.origin = origin
        """x and y of the lower-left corner, in metres."""
        self.cell_size = cell_size
        """The side of a cell of this level, in metres."""
        self.info = info
        """The service's TileInfo: stamps, digest, configuration, the instance that answered."""

    def __getitem__(self, name: str) -> Plane:
        return self._layers[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._layers)

    def __len__(self) -> int:
        return len(self._layers)

    @property
    def shape(self) -> tuple[int, int]:
        """(ny, nx)."""
        for layer in self._layers.values():
            return layer.shape[0], layer.shape[1]
        return 0, 0

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """xmin, ymin, xmax, ymax in metres."""
        (x, y), (ny, nx), s = self.origin, self.shape, self.cell_size
        return x, y, x + nx * s, y + ny * s

    @property
    def version(self) -> Version:
        """The state of the map."""
        return Version(self.info.epoch, self.info.map_sequence, self.info.instance)

    @property
    def sequence(self) -> int:
        """The map's sequence."""
        return self.info.map_sequence

    @property
    def epoch(self) -> int:
        """The map's epoch."""
        return self.info.epoch

    @property
    def known_cells(self) -> int:
        """The number of known cells; 0 for a tile that a reset emptied."""
        return self.info.known_cells


class Region(Layers):
    """Layers over the box of a query."""

    @property
    def level(self) -> int:
        """The level of its cells."""
        return self.info.z


class Tile(Layers):
    """One tile of 64 x 64 cells."""

    @property
    def key(self) -> tuple[int, int, int]:
        """Level, x and y."""
        return self.info.z, self.info.x or 0, self.info.y or 0


@dataclass(frozen=True, slots=True)
class Changes:
    """The tiles that changed since a version.

    If ``complete``, the tiles are the whole map and the caller must forget what it holds: the service was restarted or
    the map reset, or nothing was held yet. Otherwise they replace those with the same key.
    """

    version: Version
    tiles: list[Tile]
    complete: bool


@dataclass(frozen=True)
class Cells(Mapping[str, npt.NDArray[np.float64]]):
    """Single cells, in the order of the query's points; layers by name, (N,) float64, NaN if not known.

    ``i``, ``j`` (N,) are the level-0 cells, ``states`` their records (None if unknown), ``known`` (N,) which are known.
    """

    i: npt.NDArray[np.int64]
    j: npt.NDArray[np.int64]
    states: list[CellState | None]
    layers: Mapping[str, npt.NDArray[np.float64]]
    instance: str
    version: Version
    known: npt.NDArray[np.bool_] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "known", np.array([state is not None for state in self.states], dtype=np.bool_))

    def __getitem__(self, name: str) -> npt.NDArray[np.float64]:
        return self.layers[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.layers)

    def __len__(self) -> int:
        return len(self.layers)
