"""What the cuboid kernel is measured against: the same job in C, built with gcc at -O3 for the benchmark alone.

`core.c` has placed points and their radii given, and one dense grid for a map: shares and the ordered update, a floor
under any kernel. `whole.c` begins where `add_scan` begins, and must do what it must do. Both end in the same cells.
"""

import ctypes
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Self

import numpy as np
import numpy.typing as npt
from scans import (
    CELL_SIZE,
    COVERAGE,
    MIN_DISTANCE,
    MIN_RADIUS,
    MIN_SHARE,
    NOISE,
    POSE_VARIANCE,
    START_NS,
    WIDEST,
    Drive,
)

from roughmap import CELL_DTYPE, RoughMap, georeference

Tiles = dict[tuple[int, int], npt.NDArray[np.void]]
"""(64, 64) records a tile, rows along y."""

# Contraction and reassociation stay off: the bits of a sum are part of the job. Without errno and traps sqrt and floor
# are instructions, as they are in the kernel.
FLAGS = ["-O3", "-march=native", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math", "-shared", "-fPIC"]
SECOND = START_NS // 1_000_000_000


class NoCompiler(Exception):
    """There is no gcc here."""


def _library(name: str, folder: Path) -> ctypes.CDLL:
    gcc = shutil.which("gcc")
    if gcc is None:
        raise NoCompiler
    built = folder / f"{name}.so"
    source = Path(__file__).with_name(f"{name}.c")
    subprocess.run([gcc, *FLAGS, str(source), "-o", str(built), "-lm"], check=True)
    return ctypes.CDLL(str(built))


def _address(array: npt.NDArray[np.generic]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def c_core(folder: Path, drive: Drive) -> Callable[[], Tiles]:
    """The core over a drive that was placed before; the run returns what it made, of which only a view is taken."""
    entry = _library("core", folder).integrate
    entry.restype = None
    placed = [georeference(scan, drive.way, NOISE) for scan in drive.scans]
    points = np.concatenate([p.points[p.reason == 0] for p in placed])
    variance = np.concatenate([np.diagonal(p.covariance, axis1=1, axis2=2)[p.reason == 0] for p in placed])
    sigmas = COVERAGE * np.sqrt(variance)
    kept = sigmas[:, :2].max(axis=1) <= WIDEST
    points, radii = points[kept], np.maximum(sigmas[kept], MIN_RADIUS)
    density = CELL_SIZE / (radii[:, 0] * radii[:, 1] * radii[:, 2])
    low = np.floor((points[:, :2] - radii[:, :2]).min(axis=0) / CELL_SIZE).astype(int) >> 6
    high = np.floor((points[:, :2] + radii[:, :2]).max(axis=0) / CELL_SIZE).astype(int) >> 6
    across, along = (high - low + 1).tolist()
    planes = [np.ascontiguousarray(plane) for plane in (*points.T, radii[:, 0], radii[:, 1], density)]
    numbers = [ctypes.c_double(v) for v in (CELL_SIZE, MIN_SHARE, MIN_DISTANCE)]
    corner = [ctypes.c_long(v) for v in (*(low * 64).tolist(), across * 64)]

    def run() -> Tiles:
        grid = np.zeros((along * 64, across * 64), CELL_DTYPE)
        addresses = [_address(plane) for plane in planes]
        entry(ctypes.c_long(len(points)), *addresses, *numbers, *corner, ctypes.c_uint32(SECOND), _address(grid))
        return {
            (low[0] + i, low[1] + j): grid[64 * j : 64 * j + 64, 64 * i : 64 * i + 64]
            for j in range(along)
            for i in range(across)
        }

    return run


class CMap:
    """A map of `whole.c`; a context manager."""

    def __init__(self, library: ctypes.CDLL, points: int) -> None:
        self._library = library
        library.map_new.restype = ctypes.c_void_p
        library.map_tiles.restype = ctypes.c_long
        self._map = ctypes.c_void_p(library.map_new(ctypes.c_long(points)))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._library.map_free(self._map)

    def add_scan(self, settings: npt.NDArray[np.float64], points: npt.NDArray[np.float32]) -> None:
        """One scan in the sensor's frame."""
        number = ctypes.c_long(len(points))
        self._library.map_add_scan(self._map, _address(settings), number, _address(points), ctypes.c_uint32(SECOND))

    def tiles(self) -> Tiles:
        """Copies of all tiles."""
        found: Tiles = {}
        number = np.zeros(2, np.int32)
        for t in range(self._library.map_tiles(self._map)):
            cells = np.empty((64, 64), CELL_DTYPE)
            self._library.map_tile(self._map, ctypes.c_long(t), _address(number), _address(cells))
            found[int(number[0]), int(number[1])] = cells
        return found


def c_whole(folder: Path, drive: Drive) -> Callable[..., Tiles | None]:
    """The whole way over a still drive; with ``keep`` the run returns the tiles."""
    library = _library("whole", folder)
    unturned = np.eye(3).ravel()
    upper = np.triu_indices(3)
    spread = [
        *POSE_VARIANCE[:3, :3][upper], *POSE_VARIANCE[:3, 3:].ravel(), *POSE_VARIANCE[3:, 3:][upper], *np.zeros(6)
    ]  # fmt: skip
    settings = []
    for k in range(len(drive.scans)):
        noise = [NOISE.range_sigma, NOISE.range_sigma_per_m, NOISE.beam_sigma]
        limits = [0.0, np.inf, np.inf, 0.0]
        mount, pose = [*unturned, 0.0, 0.0, 0.0], [*unturned, *drive.way.position[k]]
        first = [CELL_SIZE, COVERAGE, MIN_RADIUS, WIDEST, MIN_SHARE, MIN_DISTANCE]
        settings.append(np.array([*first, *noise, *limits, *mount, *pose, *spread]))
    most = max(len(scan.points) for scan in drive.scans)

    def run(*, keep: bool = False) -> Tiles | None:
        with CMap(library, most) as made:
            for one, scan in zip(settings, drive.scans, strict=True):
                made.add_scan(one, scan.points)
            return made.tiles() if keep else None

    return run


def check_equal(tiles: Tiles, built: RoughMap) -> None:
    """AssertionError unless the reference's cells are the map's.

    Up to 1e-9: the references add up the parts of a covariance in another order than the map does, and a cell's squares
    and products carry a last bit of it on.
    """
    known = {number: cells for number, cells in tiles.items() if cells["count"].any()}
    with built.freeze() as frozen:
        assert set(known) == {tuple(number) for number in frozen.tiles.tolist()}, "other tiles than the map's"
        for (tx, ty), cells in known.items():
            ours = frozen.records(tx, ty).reshape(64, 64)
            assert (ours["count"] == cells["count"]).all(), f"tile ({tx}, {ty}): other counts than the map's"
            for name in CELL_DTYPE.names or ():
                if name != "updated":  # the references give all scans one second
                    np.testing.assert_allclose(
                        cells[name], ours[name], rtol=1e-9, atol=1e-12, err_msg=f"{tx},{ty} {name}"
                    )
