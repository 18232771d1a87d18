"""Records and trust of many cells at once, and what they say of the mean's error: numpy formulas of their own."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from confidence_scene import FIRST, SIDE, A, Scene
from scipy.special import stdtr, stdtrit

from roughmap.reference.batch_shares import cells_of_bodies, cells_of_points

COVERAGE, MIN_RADIUS, MIN_SHARE = 2.0, 1e-3, 0.05


class State(NamedTuple):
    """What is kept of each cell (M,), by tiles: tile, i along all tiles, j; count; W, W2, mean, m2; V, C, M."""

    tile: np.ndarray
    i: np.ndarray
    j: np.ndarray
    count: np.ndarray
    W: np.ndarray
    W2: np.ndarray
    mean: np.ndarray
    m2: np.ndarray
    V: np.ndarray
    C: np.ndarray
    M: np.ndarray


def run(scene: Scene, model: str) -> State:
    """Return the cells of a scene, updated point by point in float64: all cells' n-th points together."""
    poses, scan = scene.poses, scene.scan
    if model == "point":
        pairs, _ = cells_of_points(scene.points, A)
    else:
        zz = scene.own**2 + poses.variance[scan] + poses.mount
        radius = np.full((len(scan), 2), COVERAGE * 0.01)
        density = A / (radius.prod(axis=1) * COVERAGE * np.sqrt(zz))
        pairs, _ = cells_of_bodies(scene.points, radius, None, density, A, MIN_SHARE)
    key = pairs.i * 4096 + pairs.j
    order = np.argsort(key, kind="stable")  # pairs are in the order of the points
    known, first, count = np.unique(key[order], return_index=True, return_counts=True)
    busiest = np.argsort(-count, kind="stable")
    known, first, count = known[busiest], first[busiest], count[busiest]
    W, W2, mean, m2, V, L, C, M, last = np.zeros((9, len(known)))
    for n in range(count[0]):
        live = np.s_[: np.searchsorted(-count, -n)]  # cells with more than n points
        pair = order[first[live] + n]
        point = pairs.point[pair]
        h, q, k = scene.points[point, 2], pairs.density[pair], scan[point]
        w, c, now = pairs.share[pair] * q, poses.variance[k], poses.stamp_s[k]
        g = w / (W[live] + w)
        r = 1.0 - g
        delta = h - mean[live]
        m2[live] += W[live] * g * delta**2
        mean[live] += g * delta
        W[live] += w
        W2[live] += w * q
        L[live] *= np.maximum(0.0, 1.0 - np.abs(now - last[live]) / (4.0 * poses.time)) ** 4
        V[live] = r * r * V[live] + 2.0 * r * g * L[live] + g * g * c
        L[live] = r * L[live] + g * c
        C[live] += g * (c - C[live])
        M[live] += g * (np.sqrt(poses.mount) - M[live])
        last[live] = now
    i, j = known // 4096, known % 4096
    by_tile = np.lexsort((i, j, i // 64))
    return State(*(values[by_tile] for values in (i // 64, i, j, count, W, W2, mean, m2, V, C, M)))


def stated(cells: State, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the stated probability that the mean is no farther from the truth than ``error``: ours, and the paper's.

    The paper's is NaN where it is not known.
    """
    sigma, freedom = whole(cells)
    ours = _within(error / sigma, freedom)
    n = cells.W**2 / cells.W2
    with np.errstate(divide="ignore", invalid="ignore"):
        std_dev = np.sqrt(cells.m2 / (cells.W - cells.W2 / cells.W))
        paper = _within(error * np.sqrt(n) / std_dev, np.full(len(n), 1e9))
    paper[(cells.count < 2) | (n <= 1.0 + 1e-6)] = np.nan
    return ours, paper


def local(cells: State, error: np.ndarray) -> np.ndarray:
    """Return the same, of the points' own heights alone."""
    own, freedom = own_variance(cells)
    return _within(error / np.sqrt(own), freedom)


def whole(cells: State) -> tuple[np.ndarray, np.ndarray]:
    """Return the standard deviation of the mean, and its degrees of freedom."""
    own, freedom = own_variance(cells)
    var = own + cells.V + cells.M**2
    return np.sqrt(var), var**2 / (own**2 / freedom)


def interval_95(cells: State) -> np.ndarray:
    """Return half the width of the interval that holds the truth with 95 %."""
    sigma, freedom = whole(cells)
    return sigma * stdtrit(freedom, 0.975)


def own_variance(cells: State) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean's variance from the points' own heights, and its degrees of freedom."""
    n = cells.W**2 / cells.W2
    ne = (n + cells.count) / 2.0
    f = np.maximum(ne - 1.0, 0.0)
    safe = np.where(f > 0.0, f, 1.0)
    D = ne * np.maximum(cells.C - cells.V, 0.0)
    T = ne * cells.m2 / cells.W

    def part(s0: np.ndarray) -> np.ndarray:
        return np.where(f > 0.0, (s0 / (s0 + D / safe)) ** 2, 0.0)

    s0, f0 = np.full(len(n), 0.03**2), np.full(len(n), 2.0)
    strong = part(s0) * f >= 4.0
    for tile in _runs(cells.tile):
        values = np.sort(((T - D) / safe)[tile][strong[tile]])
        if len(values) >= 20:
            s0[tile], f0[tile] = max(values[(len(values) - 1) // 2], 0.005**2), 4.0
    b = part(s0)
    freedom = f0 + b * f
    s2 = np.maximum((f0 * s0 + b * (T - D)) / freedom, s0 / 10.0)
    return s2 * (1.0 / ne + 0.05 * (1.0 - np.minimum(n / cells.count, 1.0))), freedom


def _runs(values: np.ndarray) -> list[slice]:
    """Return the runs of equal values."""
    edges = [0, *(np.flatnonzero(np.diff(values)) + 1).tolist(), len(values)]
    return [slice(a, b) for a, b in pairwise(edges)]


def _within(t: np.ndarray, freedom: np.ndarray) -> np.ndarray:
    """Return P(|T| <= t) for Student's T."""
    return 2.0 * stdtr(freedom, t) - 1.0


def patch(cells: State) -> np.ndarray:
    """Whether each cell is one of the patch, which the scene knows the truth of."""
    i, j = cells.i % 64 - FIRST, cells.j - FIRST
    return (i >= 0) & (j >= 0) & (i < SIDE) & (j < SIDE)
