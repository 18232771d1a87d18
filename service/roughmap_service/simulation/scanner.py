"""A spinning laser scanner in the simulated world: one sweep, column after column, from a moving sensor.

A beam ends at the nearest of the ground and the solids. On the puddle, half of the beams are mirrored: their returns
lie below the ground, since the scanner knows nothing of mirrors.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from roughmap.jit import inline, kernel
from roughmap_service.simulation.ground import BLOCK, NODES, SPACING, height_at
from roughmap_service.simulation.solids import GOLDEN, meet, reach
from roughmap_service.simulation.world import NO_PUDDLE, World

Floats = npt.NDArray[np.float64]

FINE = SPACING / 2
"""Horizontal step of a ray near the ground, in metres: half a grid cell."""

HALVINGS = 12
"""Bisections of that step, to 6 micrometres: far below the range noise."""

NANOSECONDS = 1_000_000_000

MIRRORED, SEEN = 0.5, 0.7
"""Of the beams on the puddle, the first share is mirrored, up to the second the ground answers, the rest is lost."""

ABOVE_WATER = 1e-4
"""Metres over the puddle where a mirrored beam begins, so that it doesn't meet the water again."""

NEAREST_DROP = 0.6
"""Metres from the scanner to the nearest rain drop that it reports."""


@dataclass(frozen=True)
class Scanner:
    """A scanner's geometry and noise: angles in radians, lengths in metres, `rate_hz` sweeps per second."""

    rings: int = 64
    columns: int = 512
    rate_hz: float = 10.0
    lowest: float = float(np.deg2rad(-42.0))
    highest: float = float(np.deg2rad(15.0))
    max_range: float = 25.0
    range_sigma: float = 0.02
    beam_sigma: float = 0.0005

    @property
    def sweep_ns(self) -> int:
        """Duration of one sweep."""
        return round(NANOSECONDS / self.rate_hz)

    def column_offsets_ns(self) -> npt.NDArray[np.int64]:
        """Return the time of each column after the sweep's start, (columns,)."""
        return np.arange(self.columns, dtype=np.int64) * self.sweep_ns // self.columns

    def sweep(
        self, world: World, seconds: float, position: Floats, rotation: Floats, rng: np.random.Generator
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]]:
        """Return one sweep as the scanner reports it; what moves stands where it is at `seconds` after the start.

        `position` (columns, 3) and `rotation` (columns, 3, 3) are the sensor's true pose in the map at each
        column's own time. Returns points (rings * columns, 3) in the sensor frame, column after column, with 0, 0, 0
        for no return, and each point's offset from the sweep's start in nanoseconds. The true direction of a beam
        differs from the reported one by `beam_sigma`; its range has the noise `range_sigma`.
        """
        shape = (self.columns, self.rings)
        azimuth = np.linspace(np.pi, -np.pi, self.columns, endpoint=False)[:, None]
        elevation = np.linspace(self.lowest, self.highest, self.rings)[None, :]
        reported = _directions(azimuth, elevation, shape)
        true = _directions(
            azimuth + rng.normal(0, self.beam_sigma, shape) / np.cos(elevation),
            elevation + rng.normal(0, self.beam_sigma, shape),
            shape,
        )
        ranges = np.empty(shape)
        ground = (world.ground.grid, world.ground.block_top, world.ground.top)
        chances = rng.random(shape)
        _cast(ground, world.solids(seconds), world.puddle, position, rotation, true, chances, self.max_range, ranges)
        measured = ranges + rng.normal(0, self.range_sigma, shape)
        drop = NEAREST_DROP + rng.random(shape) * (np.where(np.isnan(ranges), self.max_range, ranges) - NEAREST_DROP)
        measured = np.where(rng.random(shape) < world.rain, drop, measured)
        points = np.where(np.isnan(measured), 0.0, measured)[..., None] * reported
        offsets = np.broadcast_to(self.column_offsets_ns()[:, None], shape)
        return points.reshape(-1, 3).astype(np.float32), offsets.reshape(-1).copy()


def _directions(azimuth: Floats, elevation: Floats, shape: tuple[int, int]) -> Floats:
    out = np.empty((*shape, 3))
    out[..., 0] = np.cos(elevation) * np.cos(azimuth)
    out[..., 1] = np.cos(elevation) * np.sin(azimuth)
    out[..., 2] = np.broadcast_to(np.sin(elevation), shape)
    return out


@kernel
def _cast(
    ground: Any,
    solids: Any,
    puddle: Any,
    position: Any,
    rotation: Any,
    directions: Any,
    chances: Any,
    max_range: float,
    out: Any,
) -> None:
    """Compute the range of every beam of every column; NaN where nothing comes back from within `max_range`."""
    rings = out.shape[1]
    turned = np.empty((rings, 3))
    ahead = np.empty(solids.size, dtype=np.int64)
    for c in range(out.shape[0]):
        x, y, z = position[c, 0], position[c, 1], position[c, 2]
        for k in range(rings):
            for axis in range(3):
                turned[k, axis] = (
                    rotation[c, axis, 0] * directions[c, k, 0]
                    + rotation[c, axis, 1] * directions[c, k, 1]
                    + rotation[c, axis, 2] * directions[c, k, 2]
                )
        count = _find_ahead(solids, x, y, turned, max_range, ahead)
        for k in range(rings):
            dx, dy, dz = turned[k, 0], turned[k, 1], turned[k, 2]
            chance = chances[c, k]
            t, wet = _beam(ground, solids, ahead[:count], puddle, x, y, z, dx, dy, dz, chance, max_range)
            if wet:
                fate = (chance * 997.0) % 1.0
                if fate < MIRRORED:
                    rest, _ = _beam(
                        ground,
                        solids,
                        ahead[:count],
                        NO_PUDDLE,
                        x + t * dx,
                        y + t * dy,
                        z + t * dz + ABOVE_WATER,
                        dx,
                        dy,
                        -dz,
                        chance,
                        max_range - t,
                    )
                    t += rest
                elif fate > SEEN:
                    t = np.nan
            out[c, k] = t


@inline
def _find_ahead(solids: Any, x: float, y: float, turned: Any, max_range: float, ahead: Any) -> int:
    """Write into `ahead` which solids the beams of one column may meet; return how many.

    Seen from above, the beams fill a wedge around the middle one, narrow unless the sensor is tilted.
    """
    middle = turned[turned.shape[0] // 2]
    size = np.hypot(middle[0], middle[1])
    hx, hy = middle[0] / size, middle[1] / size
    widest = 0.0
    for k in range(turned.shape[0]):
        aside = abs(hx * turned[k, 1] - hy * turned[k, 0])
        widest = max(widest, aside / np.hypot(turned[k, 0], turned[k, 1]))
    along = np.sqrt(1.0 - widest * widest)
    count = 0
    for n in range(solids.size):
        radius = reach(solids[n])
        ox, oy = solids[n].x - x, solids[n].y - y
        forward = ox * hx + oy * hy
        outside = abs(hx * oy - hy * ox) * along - forward * widest
        if forward > -radius and outside < radius and forward < max_range + radius:
            ahead[count] = n
            count += 1
    return count


@kernel
def _beam(
    ground: Any,
    solids: Any,
    ahead: Any,
    puddle: Any,
    x: float,
    y: float,
    z: float,
    dx: float,
    dy: float,
    dz: float,
    chance: float,
    limit: float,
) -> tuple[float, bool]:
    """Return the range of one beam, NaN if it meets nothing before `limit`, and whether it ends on the puddle."""
    nearest = np.inf
    for n in ahead:
        nearest = min(nearest, meet(solids[n], x, y, z, dx, dy, dz, (chance + n * GOLDEN) % 1.0))
    grid, block_top, top = ground
    t = _range(grid, block_top, top, x, y, z, dx, dy, dz, min(limit, nearest))
    if np.isnan(t):
        return (nearest, False) if nearest < limit else (np.nan, False)
    u, v = x + t * dx - puddle[0], y + t * dy - puddle[1]
    a, b = puddle[2], puddle[3]
    return t, (u * b) ** 2 + (v * a) ** 2 < (a * b) ** 2


@inline
def _range(
    grid: Any, block_top: Any, top: float, x: float, y: float, z: float, dx: float, dy: float, dz: float, limit: float
) -> float:
    """Return the range of one beam: skip the blocks that it passes above, step through the others."""
    side = BLOCK * SPACING
    mask = NODES // BLOCK - 1
    step = FINE / max(np.hypot(dx, dy), 0.05)
    t = 0.0
    while t < limit:
        if dz >= 0 and z + t * dz > top:
            return np.nan
        bx = np.floor((x + t * dx) / side)
        by = np.floor((y + t * dy) / side)
        leave = limit
        if dx > 0:
            leave = min(leave, ((bx + 1) * side - x) / dx)
        elif dx < 0:
            leave = min(leave, (bx * side - x) / dx)
        if dy > 0:
            leave = min(leave, ((by + 1) * side - y) / dy)
        elif dy < 0:
            leave = min(leave, (by * side - y) / dy)
        leave = max(leave, t) + 1e-9  # past the border, into the next block
        if min(z + t * dz, z + leave * dz) <= block_top[np.int64(by) & mask, np.int64(bx) & mask]:
            while t < leave:
                ahead = min(t + step, leave)
                if z + ahead * dz <= height_at(grid, x + ahead * dx, y + ahead * dy):
                    return _meet(grid, x, y, z, dx, dy, dz, t, ahead)
                t = ahead
        t = leave
    return np.nan


@inline
def _meet(
    grid: Any, x: float, y: float, z: float, dx: float, dy: float, dz: float, above: float, below: float
) -> float:
    """Return the range at which the beam meets the ground, between `above` and `below`, by bisection."""
    for _ in range(HALVINGS):
        middle = 0.5 * (above + below)
        if z + middle * dz <= height_at(grid, x + middle * dx, y + middle * dy):
            below = middle
        else:
            above = middle
    return 0.5 * (above + below)
