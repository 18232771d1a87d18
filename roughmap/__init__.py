"""roughmap: a 2.5D map of rough ground with its uncertainty, built point by point.

Arrays in, arrays out; no I/O, no network. `RoughMap` is the map; `Scan`, `Trajectory`, `Noise` and `Limits` say how
points come into it; `georeference` places them without a map.
"""

from roughmap.cell import CELL_DTYPE, STATE_VERSION, TILE_CELLS, PointReason, TooManyTiles
from roughmap.georeference import georeference
from roughmap.integrate import AddReport
from roughmap.map import RoughMap
from roughmap.region import Region
from roughmap.scan import Limits, Noise, Scan
from roughmap.trajectory import Trajectory

__all__ = [
    "CELL_DTYPE",
    "STATE_VERSION",
    "TILE_CELLS",
    "AddReport",
    "Limits",
    "Noise",
    "PointReason",
    "Region",
    "RoughMap",
    "Scan",
    "TooManyTiles",
    "Trajectory",
    "georeference",
]
