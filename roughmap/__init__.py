"""roughmap: a 2.5D map of rough ground with its uncertainty, built point by point.

Arrays in, arrays out; no I/O, no network. `RoughMap` is the map. `Scan`, `Trajectory`, `Noise` and `Limits` describe
the points that go into it; `georeference` places points without a map and returns them as `Placed`.
"""

from roughmap.cell import CELL_DTYPE, COLUMN_DTYPE, STATE_VERSION, TILE_CELLS, TRUST_DTYPE, PointReason, TooManyTiles
from roughmap.integration.phases import AddReport, Prepared
from roughmap.map import RoughMap
from roughmap.points.georeference import Placed, georeference
from roughmap.points.scan import Limits, Noise, Scan
from roughmap.points.trajectory import Trajectory
from roughmap.reading.region import Region

__all__ = [
    "CELL_DTYPE",
    "COLUMN_DTYPE",
    "STATE_VERSION",
    "TILE_CELLS",
    "TRUST_DTYPE",
    "AddReport",
    "Limits",
    "Noise",
    "Placed",
    "PointReason",
    "Prepared",
    "Region",
    "RoughMap",
    "Scan",
    "TooManyTiles",
    "Trajectory",
    "georeference",
]
