"""A map built from sweeps and read as a planner reads it, with either surface."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

import roughmap
from roughmap import Limits, Noise, RoughMap, Scan, Trajectory

SURFACES = ("all", "ground")
"""The paper's record of every point, and the ground under what hangs over it."""

LIMITS = {
    "all": {"slope": 0.5, "step": 0.2, "std_dev": 0.1, "confidence": 0.9},
    "ground": {"slope": 0.5, "step": 0.2, "roughness": 0.1, "confidence": 0.9, "clearance": 2.0},
}
"""The vehicle: it climbs 28.6 degrees and 20 cm, and is less than 2 m high. The same in both, as far as it can be."""

Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class Sweep:
    """A scan with all that places it. ``clear``: what it sees through is cleared."""

    scan: Scan
    trajectory: Trajectory
    noise: Noise
    limits: Limits
    clear: bool = True


@dataclass(frozen=True)
class Grid:
    """The cells of a box: x, y of their centres, each (ny, nx), and their side, metres."""

    x: np.ndarray
    y: np.ndarray
    cell: float

    def where(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of the cells of the points (N, 2 or 3); they may lie outside."""
        i = np.floor((points[:, 0] - self.x[0, 0]) / self.cell + 0.5).astype(int)
        j = np.floor((points[:, 1] - self.y[0, 0]) / self.cell + 0.5).astype(int)
        return j, i

    def sums(self, points: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Sum of the values (N,) of the points in each cell."""
        ny, nx = self.x.shape
        j, i = self.where(points)
        inside = (i >= 0) & (j >= 0) & (i < nx) & (j < ny)
        return np.bincount(j[inside] * nx + i[inside], values[inside], nx * ny).reshape(ny, nx)

    def hits(self, points: np.ndarray) -> np.ndarray:
        """How many of the points lie in each cell."""
        return self.sums(points, np.ones(len(points))).astype(int)


def grid(box: Box, cell: float = 0.1) -> Grid:
    """The cells of a box whose borders are cells' borders."""
    nx, ny = round((box[2] - box[0]) / cell), round((box[3] - box[1]) / cell)
    y, x = (np.mgrid[0:ny, 0:nx] + 0.5) * cell
    return Grid(x + box[0], y + box[1], cell)


@dataclass(frozen=True)
class Seen:
    """Layers over a grid, each (ny, nx)."""

    grid: Grid
    traversability: np.ndarray
    height: np.ndarray
    slope: np.ndarray

    @property
    def free(self) -> np.ndarray:
        """Known, and a planner may drive there."""
        return self.traversability > 0.0

    @property
    def forbidden(self) -> np.ndarray:
        """Known, and a planner must not drive there."""
        return self.traversability == 0.0

    @property
    def known(self) -> np.ndarray:
        """The ground's height is known."""
        return np.isfinite(self.height)


def make_map(surface: str, model: str = "cuboid", cell_size: float = 0.1) -> RoughMap:
    """A map as a newcomer gets it, but for its surface and error model."""
    return roughmap.RoughMap(surface=surface, error_model=model, cell_size=cell_size, threads=1)


def built(surface: str, sweeps: Iterable[Sweep], model: str = "cuboid", cell_size: float = 0.1) -> RoughMap:
    """The map of these sweeps, in their order."""
    made = make_map(surface, model, cell_size)
    for sweep in sweeps:
        add(made, surface, sweep)
    return made


def add(to: RoughMap, surface: str, sweep: Sweep) -> None:
    """One sweep more. The paper's method knows no clearing."""
    to.add_scan(sweep.scan, sweep.trajectory, sweep.noise, sweep.limits, clear=sweep.clear and surface == "ground")


def seen(of: RoughMap, surface: str, box: Box, limits: dict[str, float] | None = None) -> Seen:
    """What a planner with the usual limits reads over ``box`` (metres)."""
    layers = ["traversability", "mean_height", "slope"]
    region = of.region(box, layers, limits=LIMITS[surface] if limits is None else limits)
    return Seen(grid(box, of.cell_size), *(np.asarray(region[layer]) for layer in layers))


def still(pose: np.ndarray, stamps: Sequence[int], sigma: float, angle_sigma: float) -> Trajectory:
    """A trajectory of poses (M, 4, 4) at these stamps, each with the same standard errors."""
    S = np.diag([sigma**2] * 3 + [angle_sigma**2] * 3)
    rotations = Rotation.from_matrix(pose[:, :3, :3]).as_quat()
    return Trajectory(np.array(stamps), pose[:, :3, 3], rotations, np.broadcast_to(S, (len(pose), 6, 6)))
