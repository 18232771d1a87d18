"""A spinning laser scanner on the synthetic ground: one sweep, column after column, from a moving sensor."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from roughmap.jit import inline, kernel
from roughmap_service.simulation.ground import BLOCK, NODES, SPACING, Ground, height_at

Floats = npt.NDArray[np.float64]

FINE = SPACING / 2
"""Horizontal step of a ray near the ground, in metres: half a grid cell."""

HALVINGS = 12
"""Bisections of that step, to 6 micrometres: far below the range noise."""

NANOSECONDS = 1_000_000_000


@dataclass(frozen=True)
class Scanner:
    """A scanner's geometry and noise: angles in radians, lengths in metres, `rate_hz` sweeps per second."""

    rings: int = 64
    columns: int = 512
    rate_hz: float = 10.0
    lowest: float = float(np.deg2rad(-42.0))
    highest: float = float(np.deg2rad(8.0))
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
        self, ground: Ground, position: Floats, rotation: Floats, rng: np.random.Generator
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]]:
        """Return one sweep as the scanner reports it.

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
        _cast(ground.grid, ground.block_top, ground.top, position, rotation, true, self.max_range, ranges)
        measured = ranges + rng.normal(0, self.range_sigma, shape)
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
    grid: Any, block_top: Any, top: float, position: Any, rotation: Any, directions: Any, max_range: float, out: Any
) -> None:
    """Compute the range to the ground of every beam of every column; NaN beyond `max_range`."""
    for c in range(out.shape[0]):
        r = rotation[c]
        for k in range(out.shape[1]):
            a, b, e = directions[c, k, 0], directions[c, k, 1], directions[c, k, 2]
            dx = r[0, 0] * a + r[0, 1] * b + r[0, 2] * e
            dy = r[1, 0] * a + r[1, 1] * b + r[1, 2] * e
            dz = r[2, 0] * a + r[2, 1] * b + r[2, 2] * e
            out[c, k] = _range(
                grid, block_top, top, position[c, 0], position[c, 1], position[c, 2], dx, dy, dz, max_range
            )


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
