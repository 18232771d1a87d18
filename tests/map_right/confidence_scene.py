"""A ground of which every cell's true height is known, and scans of it whose errors are drawn as they are declared."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter

A = 0.1
"""Side of a cell, metres."""

SIDE = 9
"""Cells along the side of the patch that is seen of each tile."""

SPOTS = 10
"""Heights along the side of a cell: the ground is known each centimetre."""

FIRST = 20
"""Cells from a tile's corner to the patch."""

ACROSS = 0.01
"""Sigma of a point's own place along x and along y, metres."""

POINTS = (1, 1, 2, 3, 6, 12, 25, 50, 100)
"""How often beams meet a cell, along x: as with the distance from a sensor, neighbours are met alike."""

WINDOWS = (1, 1, 1, 4, 4, 4, 20, 20, 20)
"""In how many scans in a row, along y."""

SCANS = 20


class Poses(NamedTuple):
    """What is wrong with each of the scans.

    ``stamp_s`` (SCANS,). ``error`` (T, SCANS): of the heights, metres, by tile and scan. ``variance`` (SCANS,): its
    true variance, which the robot declares. ``mount_error`` (T, SCANS), ``mount``: the same from the mounting.
    ``time``: seconds in which the error is forgotten, declared as `pose_error_time`.
    """

    stamp_s: np.ndarray
    error: np.ndarray
    variance: np.ndarray
    mount_error: np.ndarray
    mount: float
    time: float


class Scene(NamedTuple):
    """Points by scan, and the truth.

    ``points`` (N, 3), ``scan`` (N,), ascending; ``own``: sigma of a point's own height, metres. ``truth`` (T, SIDE,
    SIDE): mean height of each cell of the patches, rows along y; ``met``: how many scans met it. Tile t is in column t
    of a row of tiles.
    """

    points: np.ndarray
    scan: np.ndarray
    own: float
    truth: np.ndarray
    met: np.ndarray
    poses: Poses

    def scans(self) -> Iterator[tuple[int, slice]]:
        """Yield the number of each scan and the rows of its points."""
        edges = np.searchsorted(self.scan, np.arange(SCANS + 1))
        for k in range(SCANS):
            yield k, slice(int(edges[k]), int(edges[k + 1]))

    def covariance(self, k: int) -> np.ndarray:
        """Return the covariance (3, 3) of each point of a scan: its own error, the pose's and the mounting's."""
        return np.diag([ACROSS**2, ACROSS**2, self.own**2 + self.poses.variance[k] + self.poses.mount])


def _independent(rng: np.random.Generator, tiles: int) -> Poses:
    """Each scan has an error of its own: 3 cm, forgotten long before the next scan."""
    error = rng.normal(0.0, 0.03, (tiles, SCANS))
    return Poses(np.arange(SCANS) * 1.0, error, np.full(SCANS, 0.03**2), np.zeros((tiles, SCANS)), 0.0, 0.2)


def _walking(rng: np.random.Generator, tiles: int) -> Poses:
    """A random walk from 1 cm to 4.5 cm, never forgotten."""
    error = np.cumsum(rng.normal(0.0, 0.01, (tiles, SCANS)), axis=1)
    variance = 0.01**2 * np.arange(1, SCANS + 1)
    return Poses(np.arange(SCANS) * 0.5, error, variance, np.zeros((tiles, SCANS)), 0.0, 1e4)


def _fading(rng: np.random.Generator, tiles: int, stamp_s: np.ndarray, time: float = 5.0) -> np.ndarray:
    """Return errors of 3 cm whose correlation falls as exp(-t / time)."""
    error = np.empty((tiles, len(stamp_s)))
    error[:, 0] = rng.normal(0.0, 0.03, tiles)
    for k in range(1, len(stamp_s)):
        keep = np.exp(-(stamp_s[k] - stamp_s[k - 1]) / time)
        error[:, k] = keep * error[:, k - 1] + rng.normal(0.0, 0.03 * np.sqrt(1.0 - keep * keep), tiles)
    return error


def _correlated(rng: np.random.Generator, tiles: int) -> Poses:
    """3 cm, forgotten in 5 s; two scans a second."""
    stamp_s = np.arange(SCANS) * 0.5
    error = _fading(rng, tiles, stamp_s)
    return Poses(stamp_s, error, np.full(SCANS, 0.03**2), np.zeros((tiles, SCANS)), 0.0, 5.0)


def _mounted(rng: np.random.Generator, tiles: int) -> Poses:
    """The same, and a mounting that is off by 2 cm."""
    mount = np.repeat(rng.normal(0.0, 0.02, (tiles, 1)), SCANS, axis=1)
    return _correlated(rng, tiles)._replace(mount_error=mount, mount=0.02**2)


def _two_in_turn(rng: np.random.Generator, tiles: int) -> Poses:
    """Two robots, the second a minute after the first, each with its own error of the pose."""
    half = np.arange(SCANS // 2) * 0.5
    error = np.concatenate([_fading(rng, tiles, half), _fading(rng, tiles, half)], axis=1)
    stamp_s = np.concatenate([half, half + 60.0])
    return _correlated(rng, tiles)._replace(error=error, stamp_s=stamp_s)


def _two_at_once(rng: np.random.Generator, tiles: int) -> Poses:
    """Two robots side by side, whose scans take turns."""
    stamp_s = np.arange(SCANS // 2) * 0.5
    error = np.stack([_fading(rng, tiles, stamp_s), _fading(rng, tiles, stamp_s)], axis=2).reshape(tiles, SCANS)
    return _correlated(rng, tiles)._replace(error=error, stamp_s=np.repeat(stamp_s, 2))


POSES: dict[str, Callable[[np.random.Generator, int], Poses]] = {
    "independent": _independent,
    "walking": _walking,
    "correlated": _correlated,
    "correlated, mounting": _mounted,
    "two robots in turn": _two_in_turn,
    "two robots at once": _two_at_once,
}

GROUNDS = {"smooth": 0.01, "rough": 0.02}
"""Kinds of ground, and the sigma of a beam's own height on it."""


def _ground(rng: np.random.Generator, kind: str, tiles: int) -> np.ndarray:
    """Return heights (T, SIDE * SPOTS, SIDE * SPOTS) at every centimetre.

    Smooth ground: 2 mm of grain and slopes of up to 3 degrees. Rough ground: grain, clods of 4 cm and mounds of 30 cm.
    """
    shape = (tiles, SIDE * SPOTS, SIDE * SPOTS)
    if kind == "smooth":
        place = (np.arange(SIDE * SPOTS) / SPOTS - SIDE / 2) * A
        slope = np.tan(np.radians(rng.uniform(-3.0, 3.0, (2, tiles, 1, 1))))
        return rng.normal(0.0, 0.002, shape) + slope[0] * place + slope[1] * place[:, None]
    height = rng.normal(0.0, 0.02, shape)
    for width, sigma in ((4, 0.02), (30, 0.03)):
        blurred = uniform_filter(rng.normal(size=shape), (0, width, width), mode="wrap")
        height += sigma * width * blurred
    return height


def scene(seed: int, kind: str, poses: str, tiles: int) -> Scene:
    """Return a scene of that many tiles on that kind of ground."""
    rng = np.random.default_rng(seed)
    ground = _ground(rng, kind, tiles)
    truth = ground.reshape(tiles, SIDE, SPOTS, SIDE, SPOTS).mean(axis=(2, 4))
    wrong = POSES[poses](rng, tiles)
    shape = (tiles, SIDE, SIDE)
    number, window = np.broadcast_to(POINTS, shape), np.broadcast_to(np.array(WINDOWS)[:, None], shape)
    begin = np.broadcast_to(rng.integers(0, SCANS, (tiles, 1, 1)) % (SCANS - window + 1), shape)
    cell = np.repeat(np.arange(truth.size), number.ravel())
    scan = begin.ravel()[cell] + rng.integers(0, window.ravel()[cell])
    order = np.argsort(scan, kind="stable")
    cell, scan = cell[order], scan[order]
    t, j, i = np.unravel_index(cell, shape)
    u, v = rng.uniform(0.0, 1.0, (2, len(cell)))
    spot = ground[t, j * SPOTS + (v * SPOTS).astype(int), i * SPOTS + (u * SPOTS).astype(int)]
    own = GROUNDS[kind]
    z = spot + rng.normal(0.0, own, len(cell)) + wrong.error[t, scan] + wrong.mount_error[t, scan]
    x = (t * 64 + FIRST + i + u) * A + rng.normal(0.0, ACROSS, len(cell))
    y = (FIRST + j + v) * A + rng.normal(0.0, ACROSS, len(cell))
    pairs = np.unique(cell * SCANS + scan)
    met = np.bincount(pairs // SCANS, minlength=truth.size).reshape(shape)
    return Scene(np.column_stack([x, y, z]), scan, own, truth, met, wrong)
