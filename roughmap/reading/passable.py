"""Where a robot can drive: the worst of what is known, at level 0 and above."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from roughmap.arrays import F8
from roughmap.cell import TILE_CELLS
from roughmap.jit import kernel
from roughmap.reading.layers import GroundLimits
from roughmap.reading.overhang import Overhang
from roughmap.reading.plane import PlaneLayers


class Passable(NamedTuple):
    """Layers of a tile, each (64, 64) float64, NaN where unknown; above level 0 the worst of the known children.

    ``passable``, ``rated``: numbers of level-0 cells with traversability above 0, and with any.
    """

    obstacle: F8
    obstacle_top: F8
    overhang_low: F8
    traversability: F8
    passable: F8
    rated: F8

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays."""
        return sum(plane.nbytes for plane in self)

    @property
    def share(self) -> F8:
        """The part of a cell's rated level-0 cells that can be passed; NaN if there are none."""
        share = np.full(self.rated.shape, np.nan)
        np.divide(self.passable, self.rated, out=share, where=self.rated > 0.0)
        return share


@kernel
def _rate(
    slope: F8, step: F8, roughness: F8, confidence: F8, obstacle: F8, limits: tuple[float, float, float, float], out: F8
) -> None:
    for j in range(out.shape[0]):
        for i in range(out.shape[1]):
            a, b, c = 1.0 - slope[j, i] / limits[0], 1.0 - step[j, i] / limits[1], 1.0 - roughness[j, i] / limits[2]
            d = confidence[j, i] / limits[3]
            least = 1.0 if d > 1.0 else d
            least = b if b < least else least
            blocked = least <= 0.0 or obstacle[j, i] > 0.0
            # a NaN of slope or roughness stays
            least = a if not a > least else least
            least = c if not c > least else least
            least = 0.0 if blocked or least < 0.0 else least
            out[j, i] = least if b == b else np.nan  # noqa: PLR0124 - a step height is NaN where nothing is known


def rated(planes: PlaneLayers, confidence: F8, overhang: Overhang, limits: GroundLimits) -> Passable:
    """Return how passable the cells of a level-0 tile are: the least of 1 - value / limit over slope, step and
    roughness, and of confidence / limit, between 0 and 1.

    An obstacle gives 0. A cell without a plane is 0 if there is an obstacle or a step, else NaN.
    """
    out = np.empty((TILE_CELLS, TILE_CELLS))
    terms = planes.slope, planes.step_height, planes.roughness, confidence, overhang.obstacle
    _rate(*terms, (limits.slope, limits.step, limits.roughness, limits.confidence), out)
    top, low = overhang.obstacle_top, overhang.overhang_low
    return Passable(overhang.obstacle, top, low, out, (out > 0.0).astype(np.float64), (out >= 0.0).astype(np.float64))


def coarsened(children: Sequence[Passable | None]) -> Passable:
    """Return the same for a tile above level 0 from its four children, None where there is none.

    ``children``: (2x, 2y), (2x+1, 2y), (2x, 2y+1), (2x+1, 2y+1). The highest top, the lowest overhang, the least
    traversability, and the sums of the numbers.
    """
    ways = np.fmax, np.fmax, np.fmin, np.fmin, np.add, np.add
    out = Passable(*(np.full((TILE_CELLS, TILE_CELLS), 0.0 if way is np.add else np.nan) for way in ways))
    half = TILE_CELLS // 2
    for place, child in enumerate(children):
        if child is not None:
            j, i = (place >> 1) * half, (place & 1) * half
            for way, plane, below in zip(ways, out, child, strict=True):
                rows = way(below[0::2], below[1::2])
                way(rows[:, 0::2], rows[:, 1::2], out=plane[j : j + half, i : i + half])
    return out
