"""roughmap: a 2.5D map of rough ground with its uncertainty, built point by point.

Arrays in, arrays out; no I/O, no network. `RoughMap` is the map; `Scan`, `Trajectory`, `Noise` and `Limits` say how
points come into it; `georeference` places them without a map.
"""

from roughmap.cell import CELL_DTYPE, STATE_VERSION, TILE_CELLS, PointReason, TooManyTiles
from roughmap.integration.integrate import AddReport
from roughmap.map import RoughMap
from roughmap.points.georeference import georeference
from roughmap.points.scan import Limits, Noise, Scan
from roughmap.points.trajectory import Trajectory
from roughmap.reading.region import Region

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
