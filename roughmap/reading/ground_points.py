"""The layers of a map of the ground: where it is known, its planes, and what stands on it or hangs over it."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from roughmap.arrays import F8, U2, Flags
from roughmap.cell import SUPPORTED, TILE_CELLS
from roughmap.reading import ground
from roughmap.reading.cell_values import as_words
from roughmap.reading.frozen_tiles import FrozenTiles, children, nine
from roughmap.reading.halo import NO_COLUMN, Halo, Neighbour, surroundings
from roughmap.reading.layers import GroundLimits
from roughmap.reading.levels import merge_flags
from roughmap.reading.overhang import overhang
from roughmap.reading.passable import Passable, coarsened, rated
from roughmap.reading.plane import PlaneLayers, planes
from roughmap.reading.trust import trust_layers
from roughmap.tiles import reach

PLANE_LAYERS = frozenset(PlaneLayers.__dataclass_fields__)

PASSABLE_LAYERS = frozenset({"obstacle", "obstacle_top", "overhang_low", "traversability", "passable_share"})
"""Layers of objects and of what they and the planes mean for a robot."""


class _Terrain(NamedTuple):
    height: F8
    planes: PlaneLayers


def known_ground(tiles: FrozenTiles, x: int, y: int, clearance: float) -> Flags:
    """Return which cells of a tile of the level have a known ground, (64, 64)."""
    found: Flags = _heights(tiles, tiles.level, x, y, clearance, 0)[1] < np.inf
    return found


def terrain_layers(
    tiles: FrozenTiles, x: int, y: int, names: frozenset[str], tolerance: float, limits: GroundLimits
) -> tuple[dict[str, F8], Flags]:
    """Return the layers of planes and objects among ``names``, and which cells have a known ground."""
    level = tiles.level
    terrain = _terrain(tiles, level, x, y, limits)
    found = {name: getattr(terrain.planes, name) for name in PLANE_LAYERS & names}
    objects = PASSABLE_LAYERS & names
    if objects:
        passable = _rated(tiles, x, y, tolerance, limits, terrain) if level == 0 else None
        passable = _passable(tiles, level, x, y, tolerance, limits) if passable is None else passable
        for name in objects:
            if passable is None:
                found[name] = np.full((TILE_CELLS, TILE_CELLS), np.nan)
            else:
                found[name] = passable.share if name == "passable_share" else getattr(passable, name).copy()
    return found, terrain.height < np.inf


def _passable(tiles: FrozenTiles, z: int, x: int, y: int, tolerance: float, limits: GroundLimits) -> Passable | None:
    """Return how passable a tile of level z is: above level 0 the worst of its children; None if absent."""
    if z == 0:
        return _rated(tiles, x, y, tolerance, limits, None)

    def make() -> Passable:
        return coarsened([_passable(tiles, z - 1, *child, tolerance, limits) for child in children(x, y)])

    return tiles.cached("passable", z, x, y, (tolerance, limits), make)


def _rated(
    tiles: FrozenTiles, x: int, y: int, tolerance: float, limits: GroundLimits, terrain: _Terrain | None
) -> Passable | None:
    """Return how passable a tile of level 0 is, None if absent; ``terrain``: its terrain, if it is at hand."""
    state = tiles.state(x, y)
    if state is None:
        return None
    height, own = _terrain(tiles, 0, x, y, limits) if terrain is None else terrain
    beside = [tiles.neighbour(*tile) for tile in nine(x, y)]
    columns = tuple(NO_COLUMN if one is None else one.column for one in beside)
    gx, gy = own.gradient_x, own.gradient_y
    objects = overhang(columns, height, gx, gy, tiles.side(0), limits.step, limits.clearance)
    name = "local_confidence"
    confidence = trust_layers(state.cells, state.trust, (name,), tolerance)[name].reshape(TILE_CELLS, TILE_CELLS)
    return rated(own, confidence, objects, limits)


def _terrain(tiles: FrozenTiles, z: int, x: int, y: int, limits: GroundLimits) -> _Terrain:
    """Return the known heights, infinite elsewhere, and the planes of a tile of level z."""
    side = tiles.side(z)
    radius = reach.footprint(side)
    halo, height = _heights(tiles, z, x, y, limits.clearance, radius)
    found = planes(height, halo, side, limits.slope, limits.step)
    return _Terrain(np.ascontiguousarray(ground.inner(height)), found)


def _heights(tiles: FrozenTiles, z: int, x: int, y: int, clearance: float, radius: int) -> tuple[Halo, F8]:
    """Return what lies around a tile, and the known heights of it and ``radius`` cells around; infinite elsewhere."""
    side = tiles.side(z)
    window = reach.window(side)
    neighbours = [_neighbour(tiles, z, *tile) for tile in nine(x, y)]
    halo = surroundings(neighbours, radius + window + 1)
    height = ground.supported(halo, side) if z == 0 else ground.confirmed(halo)
    return halo, ground.standing(height, window, clearance)


def _neighbour(tiles: FrozenTiles, z: int, x: int, y: int) -> Neighbour | None:
    if z == 0:
        return tiles.neighbour(x, y)
    cells, flags = tiles.cells(z, x, y), _support(tiles, z, x, y)
    return None if cells is None or flags is None else Neighbour(*as_words(cells), flags, 0, NO_COLUMN)


def _support(tiles: FrozenTiles, z: int, x: int, y: int) -> U2 | None:
    """Return (4096, 1) flags: which cells of a tile are confirmed; above level 0, those with a confirmed child."""

    def make() -> npt.NDArray[np.uint16]:
        if z > 0:
            flags = merge_flags([_support(tiles, z - 1, *child) for child in children(x, y)])
        else:
            halo = surroundings([_neighbour(tiles, 0, *tile) for tile in nine(x, y)], 1)
            known = ground.supported(halo, tiles.side(0)) < np.inf
            flags = np.where(known, SUPPORTED, 0).astype(np.uint16).reshape(-1, 1)
        flags.flags.writeable = False
        return flags

    return tiles.cached("support", z, x, y, (), make)
