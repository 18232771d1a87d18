"""The frozen map: what a reader holds."""

from collections.abc import Iterable, Mapping

import numpy as np
import numpy.typing as npt

from roughmap.arrays import F8, Flags
from roughmap.cell import TILE_CELLS, TRUST_DTYPE
from roughmap.reading import all_points, ground_points, layers
from roughmap.reading.cell_values import cell_layers, packed_cell_layers
from roughmap.reading.frozen_tiles import FrozenTiles
from roughmap.reading.trust import trust_layers

SHAPE = (TILE_CELLS, TILE_CELLS)

UNKNOWN_TRUST = np.zeros(SHAPE, TRUST_DTYPE)
UNKNOWN_TRUST.flags.writeable = False


class FrozenMap(FrozenTiles):
    """The tiles of one level as they were when the map was frozen, and the layers over them.

    A map of the ground has heights only where the ground is known, and that depends on the limit ``clearance``: what is
    higher than that above other ground near it hangs over it.
    """

    def check(
        self, names: Iterable[str], height_tolerance: float, limits: Mapping[str, float] | None
    ) -> tuple[str, ...]:
        """Return ``names`` as a tuple. ValueError if `tile_layers` would not accept one of these."""
        layers.check_tolerance(height_tolerance)
        if self.surface == "ground":
            layers.check_ground_limits(limits)
        else:
            layers.check_limits(limits)
        return layers.check_names(names, self.surface)

    def tile_layers(
        self,
        x: int,
        y: int,
        names: Iterable[str],
        height_tolerance: float = 0.05,
        limits: Mapping[str, float] | None = None,
    ) -> dict[str, F8]:
        """Return layers of a tile of the level, in the order of ``names``, each (64, 64) float64; see
        ``layers.LAYERS``.

        ``height_tolerance``: full width of the interval of the confidences, metres. ``limits``: those of
        ``traversability``; None for ``layers.DEFAULT_LIMITS``. In a map of the ground all other layers depend on them
        too. ValueError for unknown names and invalid values.
        """
        names = self.check(names, height_tolerance, limits)
        tolerance, wanted = float(height_tolerance), frozenset(names)
        records = self.records(x, y)
        found = cell_layers(records, [n for n in names if n in layers.CELL_LAYERS], tolerance, self.newest_updated)
        if trusted := [name for name in names if name in layers.TRUST_LAYERS]:
            trust = self.trust(self.level, x, y)
            found |= trust_layers(records, UNKNOWN_TRUST if trust is None else trust, trusted, tolerance)
        if self.surface == "ground":
            terrain, known = self._ground_layers(x, y, wanted, tolerance, limits)
            for name, plane in found.items():
                plane[~known] = layers.unknown_value(name)
            found |= terrain
        elif not wanted <= found.keys():
            found |= all_points.neighbour_layers(self, x, y, names, tolerance, layers.check_limits(limits))
        return {name: found[name] for name in names}

    def packed_layers(
        self,
        x: int,
        y: int,
        names: Iterable[str],
        height_tolerance: float = 0.05,
        limits: Mapping[str, float] | None = None,
    ) -> npt.NDArray[np.float32]:
        """Return what `tile_layers` does as one array, (64, 64, L) float32: all layers of a cell together.

        Values that float32 can't hold are infinite.
        """
        names = self.check(names, height_tolerance, limits)
        if all(name in layers.CELL_LAYERS for name in names):
            packed = packed_cell_layers(self.records(x, y), names, float(height_tolerance), self.newest_updated)
            if self.surface == "ground":
                _, known = self._ground_layers(x, y, frozenset(), float(height_tolerance), limits)
                packed[~known] = [layers.unknown_value(name) for name in names]
            return packed
        packed = np.empty((*SHAPE, len(names)), np.float32)
        with np.errstate(over="ignore"):
            for number, plane in enumerate(self.tile_layers(x, y, names, height_tolerance, limits).values()):
                packed[:, :, number] = plane
        return packed

    def _ground_layers(
        self, x: int, y: int, wanted: frozenset[str], tolerance: float, limits: Mapping[str, float] | None
    ) -> tuple[dict[str, F8], Flags]:
        """Return the layers of planes and objects among those wanted, and which cells have a known ground."""
        bounds = layers.check_ground_limits(limits)
        if wanted.isdisjoint(ground_points.PLANE_LAYERS | ground_points.PASSABLE_LAYERS):
            return {}, ground_points.known_ground(self, x, y, bounds.clearance)
        return ground_points.terrain_layers(self, x, y, wanted, tolerance, bounds)
